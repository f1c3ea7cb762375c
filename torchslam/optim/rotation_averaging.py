"""Rotation averaging: absolute rotations of views from measured relative ones; robust, sparse, differentiable.

The start is one that wrong edges do not spoil. One wrong edge in a spanning tree turns all that hangs on it: edges that
agree with others around triangles are joined first. From there the cost is minimized with a wide kernel, which has few
minima, and then with ever narrower ones. In the end a view that disagrees with most of its edges is turned to where
most of them agree.

When views turn in the world, R_k exp(delta_k^), the residual of an edge changes to first order by delta_j - delta_i,
in the frame of j. The equations for all views are a graph Laplacian, with one number per edge, the same for all three
axes. Half the squared angle never curves more than that, so that a step does not raise the cost.

Sources: Hartley, Trumpf, Dai and Li, "Rotation averaging", 2013 (the problem and its minima); Chatterjee and Govindu,
"Robust relative rotation averaging", 2018 (the steps); Black and Rangarajan, "On the unification of line processes",
1996, and Yang, Antonante, Tzoumas and Carlone, "Graduated non-convexity for robust spatial perception", 2020 (the
widths).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchslam.geometry.lie import so3_exp, so3_log
from torchslam.geometry.precision import full_precision
from torchslam.geometry.robust import Kernel, kernel_scale, robustify
from torchslam.optim._core.levenberg_marquardt import (
    ROTATION_OPTIONS,
    UNWEIGHTED_ROTATION_OPTIONS,
    Convergence,
    SolverOptions,
    SolverReason,
    check_minimum,
)
from torchslam.optim._core.linear import factorize_sparse
from torchslam.optim.pose_graph import (
    PoseGraph,
    PoseGraphLayout,
    PoseGraphSolution,
    build_pose_graph_layout,
    is_similarity,
    solve_pose_graph,
)
from torchslam.utils.indexing import connected_parts

# Of the squared width from one kernel to the next, as in Yang et al. With 1.1 (2.5 times slower) a few more of the
# graphs with 40 % of wrong edges end at the best minimum, with 2.0 fewer.
_NARROWING = 1.4
# Turn of a view, in radians, below which the views have settled. From there one of Newton's steps, which follow, is
# enough; from 1e-3 it takes 4, each as long as 20 of the steps here in a graph that fills in; 1e-6 gains nothing.
_SETTLED = 1e-5


@dataclass(frozen=True)
class RotationAverage:
    """Rotations of views that agree best with measured relative ones.

    Attributes:
        R_cw: world to camera; the first view of every component is the identity, or at its start.
        component: the lowest view that counted edges join with each view, over others or not.
        angles: residuals in radians, detached; infinite where an edge does not count.
        success: edges that kept some weight determine all views of the component. Elsewhere the rotations are the best
            ones found, without gradient. A view without edges is a component that needs none.
        convergence: of the last minimization, from a start that is near its end.
    """

    R_cw: Float[Tensor, "K 3 3"]
    component: Int[Tensor, " K"]
    angles: Float[Tensor, " E"]
    success: Bool[Tensor, " K"]
    convergence: Convergence

    @property
    def reasons(self) -> list[SolverReason]:
        """How the search ended, for each view."""
        return self.convergence.reasons(self.success)


@full_precision
def solve_rotations(
    edges: Int[Tensor, "E 2"],
    R_ji: Float[Tensor, "E 3 3"],
    num_views: int,
    weights: Float[Tensor, " E"] | None = None,
    start: Float[Tensor, "K 3 3"] | None = None,
    *,
    options: SolverOptions | None = None,
) -> RotationAverage:
    """Minimize the robust angles between R_j and R_ji R_i over the rotations of all views.

    A cost with a robust kernel has many minima. The search starts on a spanning forest of edges that agree with others,
    narrows a Geman-McClure kernel down to the scale, whatever the kernel, and ends with Levenberg-Marquardt. Edges
    that are not finite, have no positive weight or touch a view whose start is not finite do not count. The result does
    not depend on the order and the direction of the edges, to the last bit. With gradients, like those of
    `solve_pose_graph`: zero where the exact Hessian is not positive definite.

    Args:
        edges: views (i, j).
        R_ji: measured rotations from camera i to camera j: R_j = R_ji R_i.
        weights: inverse variances per axis, in rad^-2; one if None.
        start: rotations to begin with in place of the forest. First views stay there, with a gradient to it.
        options: how to minimize, in the end; None: `ROTATION_OPTIONS`, or without weights
            `UNWEIGHTED_ROTATION_OPTIONS`. The scale of the kernels is in radians times the root of the weight.
            Gradients reach R_ji, weights, scale and the start of first views.

    Raises:
        ValueError: a shape or an index does not fit, or a name is unknown.
        ConvergenceError: with `options.strict`.
    """
    _check(edges, num_views, start)
    if options is None:
        options = UNWEIGHTED_ROTATION_OPTIONS if weights is None else ROTATION_OPTIONS
    kernel, scale = options.kernel, kernel_scale(options.scale, R_ji)
    weights = R_ji.new_ones(len(edges)) if weights is None else weights
    eye = torch.eye(3, dtype=R_ji.dtype, device=R_ji.device).expand(num_views, 3, 3)
    known = eye[:, 0, 0] > 0 if start is None else is_similarity(start)
    given = eye if start is None else torch.where(known[:, None, None], start, eye)

    everything = RotationEdges.of(edges, R_ji, weights)
    rows, component, R_cw = _Start.apply(everything, known, given, scale, kernel, start is None)
    measured = everything.select(rows)
    first = component == torch.arange(num_views, device=component.device)
    R_cw = torch.where(first[:, None, None], given, R_cw)
    graph = PoseGraph(R_cw, measured.pairs, measured.R_ji, measured.weights, fixed=first)
    solution, determined = _minimum(graph, first, component, options.replace(scale=scale, strict=False))

    with torch.no_grad():
        error = measured.residuals(solution.S_cw)
        angles = R_ji.new_full((len(edges),), torch.inf).index_copy(0, rows, error.norm(dim=-1))
        kept = robustify(measured.weights * error.square().sum(-1), kernel, scale).weight > 0
        # All views that an edge joins are still joined by those which kept some weight.
        split = connected_parts(measured.select(kept).pairs, num_views) != component
        lost = torch.zeros_like(split).index_fill(0, component[split], True)
        success = determined & ~lost[component]
    if options.strict:
        check_minimum(success, solution.converged.expand_as(success), "views")
    R_cw = torch.where(success[:, None, None], solution.S_cw, solution.S_cw.detach())
    return RotationAverage(R_cw, component, angles, success, solution.convergence)


def _check(edges: Tensor, num_views: int, start: Tensor | None) -> None:
    """Raises ValueError where numbers and indices do not fit."""
    if num_views < 1:
        raise ValueError(f"num_views must be positive, not {num_views}")
    if len(edges) and not 0 <= int(edges.min()) <= int(edges.max()) < num_views:
        raise ValueError(f"edges must lie in 0 ... {num_views - 1}")
    if (edges[:, 0] == edges[:, 1]).any():
        raise ValueError("an edge must join two views, not one with itself")
    if start is not None and len(start) != num_views:
        raise ValueError(f"start must be (K, 3, 3) with K = {num_views}, not {tuple(start.shape)}")


class _Start(torch.autograd.Function):
    """Decisions, without gradient: the rows of the edges that count, the components, and a start (K, 3, 3)."""

    @staticmethod
    def forward(
        edges: RotationEdges, known: Tensor, given: Tensor, scale: Tensor, kernel: Kernel, on_forest: bool
    ) -> tuple[Tensor, Tensor, Tensor]:
        rows = _canonical_rows(edges, known)
        counted, num_views = edges.select(rows), len(known)
        component = connected_parts(counted.pairs, num_views)
        R_cw = spanning_forest(counted, num_views, scale) if on_forest else given.clone()
        if len(rows):
            R_cw = robust_start(R_cw, counted, component, kernel, scale)
        return rows, component, R_cw

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        ctx.mark_non_differentiable(*output)

    @staticmethod
    def backward(ctx: Any, *gradient: Tensor) -> tuple[None, ...]:
        return (None,) * 6

    @staticmethod
    def jvp(ctx: Any, *change: Any) -> tuple[None, ...]:
        return (None,) * 3

    @staticmethod
    def vmap(*args: Any) -> Any:
        raise RuntimeError(
            "solve_rotations decides which edges count and joins the views by them, which vmap cannot do: "
            "call it for one graph after the other, or join them to one of several components"
        )


def _canonical_rows(edges: RotationEdges, known: Bool[Tensor, " K"]) -> Int[Tensor, " M"]:
    """Rows of the edges that count, in an order that depends on nothing but the edges themselves."""
    i, j, R_ji, weights = edges
    counted = is_similarity(R_ji) & torch.isfinite(weights) & (weights > 0) & known[i] & known[j]
    rows = counted.nonzero().squeeze(-1)
    # Measurements of the same pair are told apart by their values.
    keys = (*R_ji.flatten(1).unbind(-1), weights, j, i)
    order = np.lexsort([key[rows].detach().cpu().numpy() for key in keys])
    return rows[torch.from_numpy(order).to(rows.device)]


def _minimum(
    graph: PoseGraph, first: Bool[Tensor, " K"], component: Int[Tensor, " K"], options: SolverOptions
) -> tuple[PoseGraphSolution, Bool[Tensor, " K"]]:
    """The minimum, and the views of components that are determined, or a single view."""
    solution = solve_pose_graph(graph, options=options)
    counts = torch.bincount(component, minlength=len(component))
    single = counts[component] == 1
    joined = (counts > 1).nonzero().flatten().tolist()
    if solution.success or len(joined) < 2:
        return solution, single | solution.success
    # One component that is not determined would cost the others their gradient: it is found alone, and stays.
    determined = single
    for label in joined:
        own = component == label
        alone = solve_pose_graph(replace(graph, fixed=first | ~own), options=options)
        determined = determined | (own & alone.success)
    return solve_pose_graph(replace(graph, fixed=first | ~determined), options=options), determined


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

    def root(view: int) -> int:
        while parent[view] != view:
            parent[view] = view = parent[parent[view]]
        return view

    for edge in order.tolist():
        a, b = root(i[edge]), root(j[edge])
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


def _triangle_support(edges: RotationEdges, num_views: int, scale: Float[Tensor, ""]) -> Float[Tensor, " E"]:
    """The information, in rad^-2, of the triangles that agree, per edge: as it follows from the other two."""
    i, j, R_ji, weights = edges
    keys = i * num_views + j
    support = torch.zeros_like(weights)
    # Edges from one view are compared with 32 following ones, ascending by the other view: in a complete graph of K
    # views there are K^3 / 6 triangles. Neighbors in a sequence have neighboring numbers.
    for reach in range(1, min(33, len(i))):
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
    """Rotations near the minimum of the robust cost, the best one that is found for each component, whose first view
    stays."""
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
    for _ in range(5):  # 1 or 2 are usual
        voted = graph.settled(graph.voted(R_cw, scale), wide, scale)
        voted_cost = costs(voted)
        is_better = voted_cost < (1 - 1e-4) * cost
        if not is_better.any():
            break
        R_cw = torch.where(is_better[component, None, None], voted, R_cw)
        cost = torch.where(is_better, voted_cost, cost)
    return R_cw if kernel == wide else graph.settled(R_cw, kernel, scale)


@dataclass(frozen=True)
class _Graph:
    """Edges and what does not change while the views turn."""

    edges: RotationEdges
    fixed: Bool[Tensor, " K"]
    layout: PoseGraphLayout

    @staticmethod
    def of(edges: RotationEdges, fixed: Bool[Tensor, " K"]) -> _Graph:
        counted = torch.ones_like(edges.i, dtype=torch.bool)
        layout = build_pose_graph_layout(edges.pairs, counted[None], fixed[None], 1)
        return _Graph(edges, fixed, layout)

    def step(
        self,
        R_cw: Float[Tensor, "K 3 3"],
        kernel: Kernel,
        scale: Float[Tensor, ""],
        weights: Float[Tensor, " E"],
    ) -> tuple[Float[Tensor, "K 3 3"], Float[Tensor, "K 3"]]:
        """The views after one step of reweighted least squares, and by how much they turned, in radians."""
        edges, fixed, layout = self.edges, self.fixed, self.layout
        error = edges.residuals(R_cw)
        squared = weights * error.square().sum(-1)
        weight = (weights * robustify(squared, kernel, scale).weight)[:, None]
        pull = weight * (R_cw[edges.j].mT @ error[..., None]).squeeze(-1)
        ends = torch.cat((torch.cat((-pull, weight), dim=-1), torch.cat((pull, weight), dim=-1)))
        gradient, diagonal = layout.by_node.sum(ends[None])[0].tensor_split((3,), dim=-1)
        gradient = torch.where(fixed[:, None], 0.0, gradient)
        # A view whose edges all lost their weight stays.
        diagonal = torch.where(fixed[:, None] | (diagonal == 0), 1.0, diagonal)
        across = layout.by_pair.sum(-weight[None, layout.linking, :, None])
        factor = factorize_sparse(layout.structure, diagonal[None, ..., None], across, strict=False)
        turn = -factor.solve(gradient.T[..., None]).squeeze(-1).T
        return R_cw @ so3_exp(turn), turn

    def settled(
        self, R_cw: Float[Tensor, "K 3 3"], kernel: Kernel, scale: Float[Tensor, ""]
    ) -> Float[Tensor, "K 3 3"]:
        """The views after as many steps as they turn."""
        for _ in range(30):  # 5 to 15 are usual
            R_cw, turn = self.step(R_cw, kernel, scale, self.edges.weights)
            if turn.abs().max() < _SETTLED:
                break
        return R_cw

    def voted(self, R_cw: Float[Tensor, "K 3 3"], scale: Float[Tensor, ""]) -> Float[Tensor, "K 3 3"]:
        """Views that disagree with most of their edges turned to that edge's rotation that suits the others best."""
        edges, fixed = self.edges, self.fixed
        order, counts = self.layout.by_node.order, self.layout.by_node.counts
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

        # All pairs of a candidate and an end of its view; with half of 32 wrong, the chance that all are is 2^-32.
        candidate = (doubtful[view] & (rank < 32)).nonzero().squeeze(-1)
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
