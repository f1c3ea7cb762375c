"""A start for rotation averaging that wrong edges do not spoil: a spanning forest, kernels of decreasing width, a vote.

One wrong edge in a spanning tree turns all that hangs on it. Edges that agree with others around triangles are
therefore joined first. From there the cost is minimized with a wide kernel, which has few minima, and then with ever
narrower ones, each from the minimum of the last. In the end a view that disagrees with most of its edges is turned to
where most of them agree.

When views turn in the world, R_k exp(delta_k^), the residual of an edge changes to first order by delta_j - delta_i,
in the frame of j. The equations for all views are a graph Laplacian, with one number per edge, the same for all three
axes. Half the squared angle never curves more than that, so that a step does not raise the cost.

Sources: Hartley, Trumpf, Dai and Li, "Rotation averaging", 2013 (the problem and its minima); Chatterjee and Govindu,
"Robust relative rotation averaging", 2018 (the steps); Black and Rangarajan, "On the unification of line processes",
1996, and Yang, Antonante, Tzoumas and Carlone, "Graduated non-convexity for robust spatial perception", 2020 (the
widths).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchslam.geometry.lie import so3_exp, so3_log
from torchslam.geometry.robust import Kernel, robustify
from torchslam.optim.pose_graph._problem import Groups
from torchslam.optim.pose_graph._sparse_cholesky import (
    BlockStructure,
    build_block_structure,
    factorize_sparse,
)

# Edges from one view are compared with this number of following ones, ascending by the other view: in a complete graph
# of K views there are K^3 / 6 triangles. Neighbors in a sequence have neighboring numbers.
_TRIANGLE_REACH = 32
# Of the squared width from one kernel to the next, as in Yang et al. With 1.1 (2.5 times slower) a few more of the
# graphs with 40 % of wrong edges end at the best minimum, with 2.0 fewer.
_NARROWING = 1.4
# Turn of a view, in radians, below which the views have settled. From there one of Newton's steps, which follow, is
# enough; from 1e-3 it takes 4, each as long as 20 of the steps here in a graph that fills in; 1e-6 gains nothing.
_SETTLED = 1e-5
# Limit of the steps for that; 5 to 15 are usual.
_SETTLING_STEPS = 30
# Limit of the rounds of votes, and the share of the cost that one has to gain; 1 or 2 are usual.
_VOTES, _GAIN = 5, 1e-4
# Edges of a view whose rotations are put to the vote: with half of them wrong, the chance that all are is 2^-32.
_CANDIDATES = 32


class RotationEdges(NamedTuple):
    """Measured relative rotations of views i < j."""

    i: Int[Tensor, " E"]
    j: Int[Tensor, " E"]
    R_ji: Float[Tensor, "E 3 3"]
    weights: Float[Tensor, " E"]

    @staticmethod
    def of(
        pairs: Int[Tensor, "E 2"], R_ji: Float[Tensor, "E 3 3"], weights: Float[Tensor, " E"]
    ) -> RotationEdges:
        """Measurements of pairs (i, j) in either order."""
        is_reversed = (pairs[:, 0] > pairs[:, 1])[:, None, None]
        R_ji = torch.where(is_reversed, R_ji.mT, R_ji)
        return RotationEdges(pairs.amin(-1), pairs.amax(-1), R_ji, weights)

    @property
    def pairs(self) -> Int[Tensor, "E 2"]:
        return torch.stack((self.i, self.j), dim=-1)

    def select(self, rows: Int[Tensor, " R"] | Bool[Tensor, " E"]) -> RotationEdges:
        return RotationEdges(*(part[rows] for part in self))

    def residuals(self, R_cw: Float[Tensor, "K 3 3"]) -> Float[Tensor, "E 3"]:
        """log(R_j R_i^T R_ji^T), in radians."""
        return so3_log(R_cw[self.j] @ R_cw[self.i].mT @ self.R_ji.mT)

    def squared(self, R_cw: Float[Tensor, "K 3 3"]) -> Float[Tensor, " E"]:
        """Squared whitened residuals."""
        return self.weights * self.residuals(R_cw).square().sum(-1)


def spanning_forest(edges: RotationEdges, num_views: int, scale: Float[Tensor, ""]) -> Float[Tensor, "K 3 3"]:
    """Rotations along the edges that agree most with others; of equal ones, those with the largest weight.

    The first view of each tree is the identity.
    """
    support = _triangle_support(edges, num_views, scale)
    order = np.lexsort([-values.cpu().numpy() for values in (edges.weights, support)])
    i, j = edges.i.tolist(), edges.j.tolist()
    parent = list(range(num_views))
    tree: list[list[tuple[int, int]]] = [[] for _ in range(num_views)]
    for edge in order.tolist():
        a, b = _root(parent, i[edge]), _root(parent, j[edge])
        if a != b:  # Kruskal: the edge joins two trees; the root is the lowest view
            parent[max(a, b)] = min(a, b)
            tree[i[edge]].append((j[edge], edge))
            tree[j[edge]].append((i[edge], edge))

    R_ji = edges.R_ji.double().cpu().numpy()
    R_cw = np.tile(np.eye(3), (num_views, 1, 1))
    for first in range(num_views):
        if parent[first] != first:
            continue
        reached = [(first, -1)]
        for view, before in reached:
            for other, edge in tree[view]:
                if other != before:
                    R_cw[other] = (R_ji[edge] if view < other else R_ji[edge].T) @ R_cw[view]
                    reached.append((other, view))
    return torch.from_numpy(R_cw).to(edges.R_ji)


def _root(parent: list[int], view: int) -> int:
    while parent[view] != view:
        parent[view] = parent[parent[view]]
        view = parent[view]
    return view


def _triangle_support(edges: RotationEdges, num_views: int, scale: Float[Tensor, ""]) -> Float[Tensor, " E"]:
    """The information, in rad^-2, of the triangles that agree, per edge: as it follows from the other two."""
    i, j, R_ji, weights = edges
    keys = i * num_views + j
    support = torch.zeros_like(weights)
    for reach in range(1, min(_TRIANGLE_REACH + 1, len(i))):
        first = (i[:-reach] == i[reach:]).nonzero().squeeze(-1)
        if len(first) == 0:
            break
        wanted = j[first] * num_views + j[first + reach]
        closing = torch.searchsorted(keys, wanted).clamp(max=len(keys) - 1)
        is_triangle = keys[closing] == wanted
        first, closing = first[is_triangle], closing[is_triangle]
        sides = torch.stack((first, closing, first + reach))
        squared_angle = _squared_angle(R_ji[closing] @ R_ji[first], R_ji[first + reach])
        information = 1 / (1 / weights[sides]).sum(0)
        agreement = robustify(information * squared_angle, "geman_mcclure", scale).weight
        support = support.index_add(0, sides.flatten(), (agreement * information).repeat(3))
    return support


def _squared_angle(
    R_1: Float[Tensor, "*batch 3 3"], R_2: Float[Tensor, "*batch 3 3"]
) -> Float[Tensor, "*batch"]:
    """Squared angles between rotations, in rad^2, from the trace: fast, and exact to the root of the rounding."""
    return torch.arccos((0.5 * (R_1 * R_2).sum((-2, -1)) - 0.5).clamp(-1, 1)).square()


def robust_start(
    R_cw: Float[Tensor, "K 3 3"],
    edges: RotationEdges,
    component: Int[Tensor, " K"],
    kernel: Kernel,
    scale: Float[Tensor, ""],
) -> Float[Tensor, "K 3 3"]:
    """Rotations near the minimum of the robust cost, the best one that is found for each component.

    component: the first view, which stays, of each view's component.
    """
    graph = _Graph.of(edges, component == torch.arange(len(component), device=component.device))
    part = component[edges.i]
    wide: Kernel = "geman_mcclure"

    def costs(R_cw: Tensor) -> Tensor:
        rho = robustify(edges.squared(R_cw), wide, scale).rho
        return rho.new_zeros(len(R_cw)).index_add(0, part, rho)

    # A wide kernel is one for large variances. These are alike: one that is wrong about its own does not rule the rest.
    variances = 1 / edges.weights
    usual = variances.median()
    # Where the kernel is convex for the largest residual.
    added = 2 * edges.residuals(R_cw).square().sum(-1).max() / scale.square()
    while added > usual:
        R_cw, _ = graph.step(R_cw, wide, scale, 1 / (variances + added))
        added = added / _NARROWING
    R_cw = graph.settled(R_cw, wide, scale)
    cost = costs(R_cw)
    for _ in range(_VOTES):
        voted = graph.settled(graph.voted(R_cw, scale), wide, scale)
        voted_cost = costs(voted)
        is_better = voted_cost < (1 - _GAIN) * cost
        if not is_better.any():
            break
        R_cw = torch.where(is_better[component, None, None], voted, R_cw)
        cost = torch.where(is_better, voted_cost, cost)
    return R_cw if kernel == wide else graph.settled(R_cw, kernel, scale)


@dataclass(frozen=True)
class _Graph:
    """Edges and what does not change while the views turn.

    Attributes:
        linking: edges that join two views that are free; by_pair: those of each pair
        by_view: the edges' ends, first all i, then all j, of each view
    """

    edges: RotationEdges
    fixed: Bool[Tensor, " K"]
    linking: Int[Tensor, " L"]
    by_pair: Groups
    by_view: Groups
    structure: BlockStructure

    @staticmethod
    def of(edges: RotationEdges, fixed: Bool[Tensor, " K"]) -> _Graph:
        i, j = edges.i, edges.j
        linking = (~fixed[i] & ~fixed[j]).nonzero().squeeze(-1)
        pairs, positions = torch.unique(edges.pairs[linking], dim=0, return_inverse=True)
        by_pair, by_view = Groups.of(positions, len(pairs)), Groups.of(torch.cat((i, j)), len(fixed))
        return _Graph(edges, fixed, linking, by_pair, by_view, build_block_structure(len(fixed), 1, pairs))

    def step(
        self,
        R_cw: Float[Tensor, "K 3 3"],
        kernel: Kernel,
        scale: Float[Tensor, ""],
        weights: Float[Tensor, " E"],
    ) -> tuple[Float[Tensor, "K 3 3"], Float[Tensor, "K 3"]]:
        """The views after one step of reweighted least squares, and by how much they turned, in radians."""
        edges, fixed = self.edges, self.fixed
        error = edges.residuals(R_cw)
        squared = weights * error.square().sum(-1)
        weight = (weights * robustify(squared, kernel, scale).weight)[:, None]
        pull = weight * (R_cw[edges.j].mT @ error[..., None]).squeeze(-1)
        ends = torch.cat((torch.cat((-pull, weight), dim=-1), torch.cat((pull, weight), dim=-1)))
        gradient, diagonal = self.by_view.sum(ends[None])[0].tensor_split((3,), dim=-1)
        gradient = torch.where(fixed[:, None], 0.0, gradient)
        # A view whose edges all lost their weight stays.
        diagonal = torch.where(fixed[:, None] | (diagonal == 0), 1.0, diagonal)
        across = self.by_pair.sum(-weight[None, self.linking, :, None])
        factor = factorize_sparse(self.structure, diagonal[None, ..., None], across, strict=False)
        turn = -factor.solve(gradient.T[..., None]).squeeze(-1).T
        return R_cw @ so3_exp(turn), turn

    def settled(
        self, R_cw: Float[Tensor, "K 3 3"], kernel: Kernel, scale: Float[Tensor, ""]
    ) -> Float[Tensor, "K 3 3"]:
        """The views after as many steps as they turn."""
        for _ in range(_SETTLING_STEPS):
            R_cw, turn = self.step(R_cw, kernel, scale, self.edges.weights)
            if turn.abs().max() < _SETTLED:
                break
        return R_cw

    def voted(self, R_cw: Float[Tensor, "K 3 3"], scale: Float[Tensor, ""]) -> Float[Tensor, "K 3 3"]:
        """Views that disagree with most of their edges turned to that edge's rotation that suits the others best."""
        edges, fixed = self.edges, self.fixed
        order, counts = self.by_view.order, self.by_view.counts
        num_edges, num_views = len(edges.i), len(counts)
        # The ends of edges, view by view, with the rotation of the view that each asks for.
        edge, at_j = order % num_edges, order >= num_edges
        R_ji, other = edges.R_ji[edge], torch.where(at_j, edges.i[edge], edges.j[edge])
        asked = torch.where(at_j[:, None, None], R_ji, R_ji.mT) @ R_cw[other]
        weights = edges.weights[edge]
        view = torch.repeat_interleave(counts)
        rank = torch.arange(len(view), device=view.device) - (counts.cumsum(0) - counts)[view]

        def cost(squared_angle: Tensor, weight: Tensor) -> Tensor:
            return robustify(weight * squared_angle, "geman_mcclure", scale).rho

        now = cost(_squared_angle(asked, R_cw[view]), weights)
        now = now.new_zeros(num_views).index_add(0, view, now)
        most = scale.square() * counts  # as an edge costs the squared scale at most
        doubtful = ~fixed & (now >= 0.5 * most)

        # All pairs of a candidate and an end of its view.
        candidate = (doubtful[view] & (rank < _CANDIDATES)).nonzero().squeeze(-1)
        voters = counts[view[candidate]]
        row = torch.repeat_interleave(voters)
        within = torch.arange(len(row), device=row.device) - (voters.cumsum(0) - voters)[row]
        voter = (candidate - rank[candidate])[row] + within
        costs = cost(_squared_angle(asked[candidate[row]], asked[voter]), weights[voter])
        costs = costs.new_zeros(len(candidate)).index_add(0, row, costs)

        # The first of the best; a view next to one that turns too may be wrong again: there will be another round.
        at = view[candidate]
        best = now.scatter_reduce(0, at, costs, "amin")
        is_best = (costs == best[at]) & (costs < now[at])
        chosen = candidate.new_full((num_views,), len(view))
        chosen = chosen.scatter_reduce(0, at[is_best], candidate[is_best], "amin")
        turns = (chosen < len(view)).nonzero().squeeze(-1)
        return R_cw.index_copy(0, turns, asked[chosen[turns]])
