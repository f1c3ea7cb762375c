"""The least-squares problem behind `solve_pose_graph`: its order, its local models, its adjoint.

An edge's error is e = log(E) with E = X S_ji^-1, X = S_j S_i^-1. Nodes moved by exp(xi) from the left move E to
exp(xi_j) exp(-Ad(X) xi_i) E: to first order by eta = xi_j - Ad(X) xi_i, from the left too, so that the derivative of e
is the inverse left Jacobian of the group. To second order the product adds half of a bracket. An edge's share in the
normal equations therefore follows from its gradient and Hessian in eta alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchslam.geometry.robust import Kernel, Robustified, robustify
from torchslam.optim._core.implicit import Ndims, Tensors
from torchslam.optim._core.levenberg_marquardt import minimize_batch, select_models
from torchslam.optim._core.linear import diagonal_floor
from torchslam.optim.pose_graph._groups import Group, group_of
from torchslam.optim.pose_graph._sparse_cholesky import (
    BlockStructure,
    SparseFactor,
    build_block_structure,
    factorize_sparse,
)
from torchslam.utils.indexing import connected_parts


@dataclass(frozen=True)
class Groups:
    """Rows that are summed by group, in a fixed order."""

    order: Tensor
    counts: Tensor

    @staticmethod
    def of(index: Tensor, count: int) -> Groups:
        return Groups(torch.argsort(index, stable=True), torch.bincount(index, minlength=count))

    def sum(self, values: Float[Tensor, "B N ..."]) -> Float[Tensor, "B G ..."]:
        """Sums over the rows of each of G groups."""
        shape = (len(self.counts), values.shape[0], *values.shape[2:])
        flat = values.transpose(0, 1).index_select(0, self.order).flatten(1)
        total = torch.segment_reduce(flat, "sum", lengths=self.counts, unsafe=True)
        return total.view(shape).transpose(0, 1)


@dataclass(frozen=True)
class PoseGraphLayout:
    """The discrete part of a pose graph: counted edges, moving nodes, and the order of elimination.

    Attributes:
        i, j: (E,) int64 nodes of the edges
        moving: nodes that counted edges join with one that stays
        linking: edges that, in some element, join two moving nodes; transposed: (L,) bool, whether the block
            of the pair of nodes is the transpose of the edge's
        by_pair: the edges of each pair
        by_node: the edges' ends, first all i, then all j, of each node
    """

    i: Int[Tensor, " E"]
    j: Int[Tensor, " E"]
    counted: Bool[Tensor, "B E"]
    moving: Bool[Tensor, "B K"]
    linking: Int[Tensor, " L"]
    transposed: Bool[Tensor, " L"]
    by_pair: Groups
    by_node: Groups
    structure: BlockStructure


def build_pose_graph_layout(
    edges: Int[Tensor, "E 2"], counted: Bool[Tensor, "B E"], fixed: Bool[Tensor, "B K"], dims: int
) -> PoseGraphLayout:
    """Find the moving nodes and the order of elimination. edges: (E, 2); counted: (B, E); fixed: (B, K)."""
    i, j = edges.unbind(-1)
    num_nodes = fixed.shape[1]
    part = connected_parts(edges, fixed.shape[1], counted)
    is_first = part == torch.arange(num_nodes, device=part.device)
    stays = torch.where(fixed.any(1, keepdim=True), fixed, is_first)
    reached = torch.zeros_like(part).scatter_reduce(1, part, stays.long(), "amax").gather(1, part) > 0
    moving = reached & ~stays
    linking = (counted & moving[:, i] & moving[:, j]).any(0).nonzero().squeeze(-1)
    low, high = edges[linking].amin(-1), edges[linking].amax(-1)
    keys, positions = torch.unique(low * num_nodes + high, return_inverse=True)
    pairs = torch.stack((keys // num_nodes, keys % num_nodes), dim=-1)
    return PoseGraphLayout(
        i,
        j,
        counted,
        moving,
        linking,
        j[linking] == high,
        Groups.of(positions, len(pairs)),
        Groups.of(torch.cat((i, j)), num_nodes),
        build_block_structure(num_nodes, dims, pairs),
    )


# A long loop resists bending as a whole by a tiny share of what its edges do; damped relative to these, it creeps.
_DAMPING_SHARE = 1e-4
# Bound on the rounding error of an edge, in roundings of the largest coordinate. A start along a tree of
# edges without a loop is off the minimum by these alone.
_ROUNDINGS = 16.0


class PoseGraphInputs(NamedTuple):
    """All that gradients may flow to: S_cw (B, K, n, n), S_ji (B, E, n, n), information (B, E, D, D), scale."""

    S_cw: Float[Tensor, "B K n n"]
    S_ji: Float[Tensor, "B E n n"]
    information: Float[Tensor, "B E D D"]
    scale: Tensor


class EdgeLinearization(NamedTuple):
    """Errors of the edges and how they change.

    Attributes:
        J: d error / d eta
        carry: Ad(X), so that eta = xi_j - carry xi_i
        weighted_residual: information @ error
        squared: error^T information error
        kernel: rho and its derivatives (B, E); zero where the edge does not count
        rest: what the logarithm has beyond the error: its log scale where scales are fixed, a constant
    """

    error: Float[Tensor, "B E D"]
    J: Float[Tensor, "B E D D"]
    carry: Float[Tensor, "B E D D"]
    weighted_residual: Float[Tensor, "B E D"]
    squared: Float[Tensor, "B E"]
    kernel: Robustified
    rest: Float[Tensor, "B E rest"]

    @property
    def gradient_wrt_eta(self) -> Float[Tensor, "B E D"]:
        """The gradient of the cost in eta."""
        return (self.J.mT @ (self.kernel.weight[..., None] * self.weighted_residual)[..., None]).squeeze(-1)


class PoseGraphModel(NamedTuple):
    """The local model of the cost (B,) at nodes S_cw (B, K, n, n).

    Attributes:
        across: the Hessian, the identity where nothing moves
    """

    S_cw: Float[Tensor, "B K n n"]
    cost: Float[Tensor, " B"]
    gradient: Float[Tensor, "B K D"]
    diagonal: Float[Tensor, "B K D D"]
    across: Float[Tensor, "B L D D"]


class PoseGraphProblem:
    """A pose graph for `minimize_batch`, with its exact Hessian."""

    def __init__(self, layout: PoseGraphLayout, inputs: PoseGraphInputs, kernel: Kernel) -> None:
        self.layout, self.inputs, self.kernel = layout, inputs, kernel
        self.group = group_of(inputs.information.shape[-1])
        self.solvable = layout.moving.any(-1)

    def rounding(self) -> Tensor:
        S_cw, S_ji, information, _ = (part.detach() for part in self.inputs)
        size = torch.cat((S_cw.flatten(1), S_ji.flatten(1)), dim=-1).abs().amax(-1)
        rounding = _ROUNDINGS * torch.finfo(size.dtype).eps * size
        return 0.5 * information.diagonal(dim1=-2, dim2=-1).sum((1, 2)) * rounding.square()

    def evaluate(self, S_cw: Tensor, use_curvature: Tensor) -> PoseGraphModel:
        lin = self._linearize(S_cw)
        # As in `residuals.flat_along`: the negative curvature along an outlier's error counts as flat.
        flat = -lin.kernel.weight / torch.where(lin.squared > 0, lin.squared, 1.0)
        curvature_term = torch.maximum(2 * lin.kernel.curvature, flat) * use_curvature[:, None]
        outer = lin.weighted_residual[..., :, None] * lin.weighted_residual[..., None, :]
        curve = (
            lin.kernel.weight[..., None, None] * self.inputs.information
            + curvature_term[..., None, None] * outer
        )
        return self._assemble(S_cw, lin, lin.J.mT @ curve @ lin.J, twist=None)

    def step(self, model: PoseGraphModel, damping: Tensor) -> tuple[Tensor, Tensor]:
        damping = _DAMPING_SHARE * damping
        factor = factorize_sparse(self.layout.structure, model.diagonal, model.across, damping, strict=False)
        xi = factor.solve(model.gradient)
        predicted_reduction = 0.5 * (xi * model.gradient).sum((-2, -1))
        moved = torch.where(
            self.layout.moving[..., None, None], self.group.retract(model.S_cw, -xi), model.S_cw
        )
        return moved, torch.where(factor.definite, predicted_reduction, torch.inf)

    def select(self, accept: Tensor, new: PoseGraphModel, old: PoseGraphModel) -> PoseGraphModel:
        return select_models(accept, new, old)

    def factorized(self, model: PoseGraphModel) -> SparseFactor:
        """The undamped equations of a model at a minimum, ready to be solved."""
        return factorize_sparse(self.layout.structure, model.diagonal, model.across)

    def exact_model(self, S_cw: Tensor) -> PoseGraphModel:
        """The model with the exact Hessian of the cost in the left perturbations."""
        lin = self._linearize(S_cw)
        return self._assemble(
            S_cw, lin, self._exact_hessian(lin), twist=self.group.bracket(lin.gradient_wrt_eta)
        )

    def _linearize(self, S_cw: Tensor) -> EdgeLinearization:
        layout = self.layout
        return linearize_edges(S_cw, layout.i, layout.j, layout.counted, self.inputs, self.group, self.kernel)

    def _assemble(
        self, S_cw: Tensor, lin: EdgeLinearization, hessian: Tensor, twist: Tensor | None
    ) -> PoseGraphModel:
        """The normal equations from edges' Hessians (B, E, D, D) in eta, and half the bracket's part of the Hessian."""
        layout, carry = self.layout, lin.carry
        gradient_wrt_eta = lin.gradient_wrt_eta
        at_i = torch.cat((carry.mT @ hessian @ carry, -carry.mT @ gradient_wrt_eta[..., None]), dim=-1)
        ends = torch.cat((at_i, torch.cat((hessian, gradient_wrt_eta[..., None]), dim=-1)), dim=1)
        moving = layout.moving[..., None]
        nodes = torch.where(moving[..., None], layout.by_node.sum(ends), 0.0)
        eye = torch.eye(self.group.dims, dtype=S_cw.dtype, device=S_cw.device)
        # Where an edge lost all its weight, its nodes stay solvable: their step is zero.
        floor = torch.where(moving[..., None], diagonal_floor(S_cw.dtype), 1.0).float() * eye

        linking = layout.linking
        both = (layout.moving[:, layout.i] & layout.moving[:, layout.j])[:, linking, None, None]
        between = hessian if twist is None else hessian + twist
        across = torch.where(both, -(between[:, linking] @ carry[:, linking]), 0.0)
        across = torch.where(layout.transposed[:, None, None], across.mT, across)
        return PoseGraphModel(
            S_cw,
            0.5 * lin.kernel.rho.sum(-1),
            nodes[..., -1],
            nodes[..., :-1] + floor,
            layout.by_pair.sum(across),
        )

    def _exact_hessian(self, lin: EdgeLinearization) -> Tensor:
        """Exact Hessians (B, E, D, D) of the edges' costs in eta, in the chart of the exponential.

        The derivative of the force J^T (rho' information error) by autograd, through the analytic Jacobian; its
        symmetric part, because J itself turns with eta.
        """
        dims, information = self.group.dims, self.inputs.information.detach()
        with torch.enable_grad():
            # One copy of every edge per row.
            error = lin.error.detach().expand(dims, *lin.error.shape).clone().requires_grad_()
            full = torch.cat((error, lin.rest.detach().expand(dims, *lin.rest.shape)), dim=-1)
            weighted_residual = (information @ error[..., None]).squeeze(-1)
            slope = robustify(
                (error * weighted_residual).sum(-1), self.kernel, self.inputs.scale.detach()
            ).weight
            J = self.group.left_jacobian_inverse(full)
            gradient_wrt_eta = (J.mT @ (slope[..., None] * weighted_residual)[..., None]).squeeze(-1)
            (rows,) = torch.autograd.grad(gradient_wrt_eta.movedim(-1, 0).diagonal().sum(), error)
        hessian = rows.movedim(0, -2) @ lin.J
        return torch.where(self.layout.counted[..., None, None], 0.5 * (hessian + hessian.mT), 0.0)


def linearize_edges(
    S_cw: Float[Tensor, "B K n n"],
    i: Int[Tensor, " E"],
    j: Int[Tensor, " E"],
    counted: Bool[Tensor, "B E"],
    inputs: PoseGraphInputs,
    group: Group,
    kernel: Kernel,
) -> EdgeLinearization:
    """Errors of the edges from nodes i to j, (E,) each, and how they change; counted: (B, E)."""
    relative = S_cw.index_select(1, j) @ group.inverse(S_cw).index_select(1, i)
    full = group.log(relative @ group.inverse(inputs.S_ji))
    error, rest = full.tensor_split((group.dims,), dim=-1)
    weighted_residual = (inputs.information @ error[..., None]).squeeze(-1)
    squared = (error * weighted_residual).sum(-1)
    robust = robustify(squared, kernel, inputs.scale)
    robust = Robustified(*(torch.where(counted, x, 0.0) for x in robust))
    J, carry = group.left_jacobian_inverse(full), group.adjoint(relative)
    return EdgeLinearization(error, J, carry, weighted_residual, squared, robust, rest)


class PoseGraphMinimization:
    """A pose graph; its inputs are those of `PoseGraphInputs`, edges that count (B, E), fixed nodes (B, K), and
    the edges (E, 2).

    Found are the nodes (B, K, n, n), `success` (B,), what moved (B, K), and how it went; vectors are (B, K, D).
    """

    num_unknowns = 1
    num_vectors = 1
    ndims: tuple[Ndims, Ndims, Ndims] | None = ((2,), (3, 0, 1, 0, 0, 0, 0), (3, 3, 3, 1, 1, 1, 2))

    def __init__(self, dims: int, kernel: Kernel, iterations: int, tolerance: float) -> None:
        self.group, self.kernel = group_of(dims), kernel
        self.iterations, self.tolerance = iterations, tolerance
        self._last: tuple[tuple[Tensor, Tensor], PoseGraphLayout] | None = None

    def minimize(self, inputs: Tensors) -> Tensors:
        problem = self._problem(inputs)
        model, convergence = minimize_batch(problem, inputs[0], self.iterations, self.tolerance)
        with torch.no_grad():
            success = problem.solvable & problem.factorized(model).definite
        how = convergence.iterations, convergence.converged, convergence.initial_cost
        return model.S_cw, success, problem.layout.moving, convergence.cost, *how

    def factorized(self, found: Tensors, inputs: Tensors) -> Callable[[Tensors], Tensors]:
        S_cw, success, moving, *_ = found
        problem, use = self._problem(inputs), (moving & success[:, None])[..., None]
        with torch.no_grad():
            factor = problem.factorized(problem.exact_model(S_cw))

        def solve(right: Tensors) -> Tensors:
            return (torch.where(use, factor.solve(torch.where(use, right[0], 0.0)), 0.0),)

        return solve

    def slope(self, found: Tensors, inputs: Tensors, direction: Tensors) -> Tensor:
        given, (xi,), (i, j) = PoseGraphInputs(*inputs[:4]), direction, inputs[6].unbind(-1)
        S_cw = torch.where(found[2][..., None, None], found[0], given.S_cw)
        lin = linearize_edges(S_cw, i, j, inputs[4], given, self.group, self.kernel)
        xi_i, xi_j = xi.index_select(1, i)[..., None], xi.index_select(1, j)[..., None]
        velocity = (lin.J @ (xi_j - lin.carry @ xi_i)).squeeze(-1)
        return (lin.kernel.weight * (lin.weighted_residual * velocity).sum(-1)).sum()

    def retracted(self, found: Tensors, direction: Tensors) -> Tensors:
        return self.group.retract(found[0], direction[0]), *found[1:]

    def push(self, found: Tensors, direction: Tensors) -> Tensors:
        return (self.group.push(found[0], direction[0]),)

    def pull_back(self, found: Tensors, gradient: Tensors) -> Tensors:
        return (self.group.pull_back(found[0], gradient[0]),)

    def last_step(self, S_cw: Tensor, inputs: Tensors, success: Tensor) -> Tensor:
        """The nodes after one more step from the minimum, with the gradient of that step."""
        problem = self._problem(inputs)
        last = problem.evaluate(S_cw, ~success)
        return problem.step(last, torch.zeros_like(last.cost))[0]

    def _problem(self, inputs: Tensors) -> PoseGraphProblem:
        return PoseGraphProblem(self._layout(*inputs[4:]), PoseGraphInputs(*inputs[:4]), self.kernel)

    def _layout(self, counted: Tensor, fixed: Tensor, edges: Tensor) -> PoseGraphLayout:
        """The layout for counted edges and fixed nodes; the last one is cached."""
        key = counted, fixed
        if self._last is None or not all(map(torch.equal, self._last[0], key)):
            self._last = key, build_pose_graph_layout(edges, counted, fixed, self.group.dims)
        return self._last[1]
