"""The least-squares problem behind `solve_pose_graph`: its order, its local models, its adjoint.

An edge's error is e = log(E) with E = X S_ji^-1, X = S_j S_i^-1. Nodes moved by exp(xi) from the left move E to
exp(xi_j) exp(-Ad(X) xi_i) E: to first order by eta = xi_j - Ad(X) xi_i, from the left too, so that the derivative of e
is the inverse left Jacobian of the group. To second order the product adds half of a bracket. An edge's share in the
normal equations therefore follows from its gradient and Hessian in eta alone.

Rotations are similarities without translation and scale: optimized as such, every step would cost (6 / 3)^3
times as much for the same result.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchslam.geometry.lie import (
    sim3_adjoint,
    sim3_inverse,
    sim3_left_jacobian_inverse,
    sim3_log,
    skew,
    so3_exp,
    so3_left_jacobian_inverse,
    so3_log,
)
from torchslam.geometry.robust import Kernel, Robustified, robustify
from torchslam.optim._core.implicit import Ndims, Tensors
from torchslam.optim._core.levenberg_marquardt import minimize_batch, select_models
from torchslam.optim._core.linear import (
    BlockStructure,
    Groups,
    build_block_structure,
    diagonal_floor,
    factorize_sparse,
)
from torchslam.optim._core.residuals import ROUNDINGS, flat_along
from torchslam.optim._core.tangent import pull_back_sim3, push, retract_sim3
from torchslam.utils.indexing import connected_parts


@dataclass(frozen=True)
class Similarities:
    """Sim(3), or with six dimensions its elements of fixed scale; matrices (..., n, n), tangent vectors (..., D)."""

    dims: int

    def inverse(self, S: Tensor) -> Tensor:
        return sim3_inverse(S)

    def log(self, S: Tensor) -> Tensor:
        """D numbers that are an edge's error, and then those that stay as they are."""
        return sim3_log(S)

    def left_jacobian_inverse(self, log: Tensor) -> Tensor:
        """(..., D, D) the derivative of log(exp(xi) S) in xi at zero."""
        return sim3_left_jacobian_inverse(log)[..., : self.dims, : self.dims]

    def adjoint(self, S: Tensor) -> Tensor:
        """(..., D, D) Ad with S exp(xi) = exp(Ad xi) S."""
        return sim3_adjoint(S)[..., : self.dims, : self.dims]

    def bracket(self, force: Tensor) -> Tensor:
        """(..., D, D) half of force . [a, b] as a bilinear form a^T M b of tangent vectors."""
        v, omega = skew(force[..., :3]), skew(force[..., 3:6])
        M = torch.cat((torch.cat((torch.zeros_like(v), -v), -1), torch.cat((-v, -omega), -1)), dim=-2)
        if self.dims == 7:
            M = torch.nn.functional.pad(M, (0, 1, 0, 1))
            M[..., 6, :3], M[..., :3, 6] = force[..., :3], -force[..., :3]
        return 0.5 * M

    def retract(self, S: Tensor, xi: Tensor) -> Tensor:
        """exp(xi) S."""
        return retract_sim3(S, xi)

    def push(self, S: Tensor, xi: Tensor) -> Tensor:
        """The change of S, to first order, when it moves along xi."""
        return push(S, xi)

    def pull_back(self, S: Tensor, grad_S: Tensor) -> Tensor:
        """The gradient in xi, at zero, of a loss with gradient `grad_S` at exp(xi) S."""
        return pull_back_sim3(S, grad_S)[..., : self.dims]


@dataclass(frozen=True)
class Rotations(Similarities):
    """SO(3), with the operations of `Similarities`."""

    dims: int = 3

    def inverse(self, S: Tensor) -> Tensor:
        return S.mT

    def log(self, S: Tensor) -> Tensor:
        return so3_log(S)

    def left_jacobian_inverse(self, log: Tensor) -> Tensor:
        return so3_left_jacobian_inverse(log)

    def adjoint(self, S: Tensor) -> Tensor:
        return S

    def bracket(self, force: Tensor) -> Tensor:
        return -0.5 * skew(force)

    def retract(self, S: Tensor, xi: Tensor) -> Tensor:
        return so3_exp(xi) @ S

    def push(self, S: Tensor, xi: Tensor) -> Tensor:
        return skew(xi) @ S

    def pull_back(self, S: Tensor, grad_S: Tensor) -> Tensor:
        return torch.linalg.cross(S, grad_S, dim=-2).sum(-1)


def group_of(dims: int) -> Similarities:
    """The group whose tangent vectors have this number of dimensions: 3, 6 or 7."""
    return Rotations() if dims == 3 else Similarities(dims)


@dataclass(frozen=True)
class PoseGraphLayout:
    """The discrete part of a pose graph: counted edges, moving nodes, and the order of elimination.

    Attributes:
        moving: nodes that counted edges join with one that stays
        linking: edges that, in some element, join two moving nodes
        transposed: whether the block of the pair of nodes is the transpose of the edge's
        by_pair: the edges of each pair; by_node: the edges' ends, first all i, then all j, of each node
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
    """Find the moving nodes and the order of elimination."""
    i, j = edges.unbind(-1)
    num_nodes = fixed.shape[1]
    part = connected_parts(edges, num_nodes, counted)
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


class PoseGraphInputs(NamedTuple):
    """All that gradients may flow to: S_cw (B, K, n, n), S_ji (B, E, n, n), information (B, E, D, D), scale."""

    S_cw: Float[Tensor, "B K n n"]
    S_ji: Float[Tensor, "B E n n"]
    information: Float[Tensor, "B E D D"]
    scale: Tensor


class EdgeLinearization(NamedTuple):
    """Errors of the edges and how they change.

    Attributes:
        J: d error / d eta; carry: Ad(X), so that eta = xi_j - carry xi_i
        weighted_residual: information @ error; squared: error^T information error
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
    """The local model of the cost at nodes; the Hessian is the identity where nothing moves."""

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
        # A start along a tree of edges without a loop is off the minimum by these alone.
        rounding = ROUNDINGS * torch.finfo(size.dtype).eps * size
        return 0.5 * information.diagonal(dim1=-2, dim2=-1).sum((1, 2)) * rounding.square()

    def evaluate(self, S_cw: Tensor, use_curvature: Tensor) -> PoseGraphModel:
        lin = self._linearize(S_cw)
        _, weight, curvature = lin.kernel
        curvature_term = flat_along(weight, 2 * curvature, lin.squared, use_curvature[:, None])[
            ..., None, None
        ]
        outer = lin.weighted_residual[..., :, None] * lin.weighted_residual[..., None, :]
        curve = weight[..., None, None] * self.inputs.information + curvature_term * outer
        return self._assemble(S_cw, lin, lin.J.mT @ curve @ lin.J, None)

    def step(self, model: PoseGraphModel, damping: Tensor) -> tuple[Tensor, Tensor]:
        # A long loop resists bending as a whole by a tiny share of what its edges do; damped as these, it creeps.
        damping = 1e-4 * damping
        factor = factorize_sparse(self.layout.structure, model.diagonal, model.across, damping, strict=False)
        xi = factor.solve(model.gradient)
        predicted_reduction = 0.5 * (xi * model.gradient).sum((-2, -1))
        moved = self.group.retract(model.S_cw, -xi)
        moved = torch.where(self.layout.moving[..., None, None], moved, model.S_cw)
        return moved, torch.where(factor.definite, predicted_reduction, torch.inf)

    select = staticmethod(select_models)

    def exact_model(self, S_cw: Tensor) -> PoseGraphModel:
        """The model with the exact Hessian of the cost in the left perturbations."""
        lin = self._linearize(S_cw)
        return self._assemble(S_cw, lin, self._exact_hessian(lin), self.group.bracket(lin.gradient_wrt_eta))

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
            squared = (error * weighted_residual).sum(-1)
            slope = robustify(squared, self.kernel, self.inputs.scale.detach()).weight
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
    group: Similarities,
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
    """A pose graph; its inputs are those of `PoseGraphInputs`, edges that count (B, E), fixed nodes (B, K), and the
    edges (E, 2). Found are nodes, `success`, what moved (B, K), and how it went; vectors are (B, K, D)."""

    num_unknowns = 1
    num_vectors = 1
    ndims: tuple[Ndims, Ndims, Ndims] = ((2,), (3, 0, 1, 0, 0, 0, 0), (3, 3, 3, 1, 1, 1, 2))

    def __init__(self, dims: int, kernel: Kernel, iterations: int, tolerance: float) -> None:
        self.group, self.kernel = group_of(dims), kernel
        self.iterations, self.tolerance = iterations, tolerance
        self._last: tuple[tuple[Tensor, Tensor], PoseGraphLayout] | None = None

    def minimize(self, inputs: Tensors) -> Tensors:
        problem = self._problem(inputs)
        model, convergence = minimize_batch(problem, inputs[0], self.iterations, self.tolerance)
        with torch.no_grad():
            factor = factorize_sparse(problem.layout.structure, model.diagonal, model.across)
        success = problem.solvable & factor.definite
        return model.S_cw, success, problem.layout.moving, *convergence.tensors

    def factorized(self, found: Tensors, inputs: Tensors) -> Callable[[Tensors], Tensors]:
        S_cw, success, moving, *_ = found
        problem, use = self._problem(inputs), (moving & success[:, None])[..., None]
        with torch.no_grad():
            model = problem.exact_model(S_cw)
            factor = factorize_sparse(problem.layout.structure, model.diagonal, model.across)

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
