"""Pose graph optimization over similarities, rigid poses or rotations: sparse, robust, batched, differentiable.

An edge's error is e = log(E) with E = X S_ji^-1, X = S_j S_i^-1. Nodes moved by exp(xi) from the left move E to
exp(xi_j) exp(-Ad(X) xi_i) E: to first order by eta = xi_j - Ad(X) xi_i, from the left too, so that the derivative of e
is the inverse left Jacobian of the group. To second order the product adds half of a bracket. An edge's share in the
normal equations therefore follows from its gradient and Hessian in eta alone.

Rotations are similarities without translation and scale: optimized as such, every step would cost (6 / 3)^3
times as much for the same result.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Shaped
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
from torchslam.geometry.precision import full_precision
from torchslam.geometry.robust import Kernel, Robustified, kernel_scale, robustify
from torchslam.optim._core.implicit import Minimization, Ndims, Tensors, find_minimum
from torchslam.optim._core.levenberg_marquardt import (
    POSE_GRAPH_OPTIONS,
    Convergence,
    Outcome,
    SolverOptions,
    check_minimum,
    minimize_batch,
    select_models,
    warned,
)
from torchslam.optim._core.linear import (
    BlockStructure,
    Groups,
    build_block_structure,
    diagonal_floor,
    factorize_sparse,
)
from torchslam.optim._core.residuals import ROUNDINGS, flat_along
from torchslam.optim._core.tangent import pull_back_sim3, push, retract_sim3
from torchslam.utils.indexing import connected_parts, row_mask


@dataclass(frozen=True)
class PoseGraph:
    """Nodes with measured relative similarities, rigid poses or rotations; a batch shares the edges.

    Attributes:
        S_cw: similarities from the world to the nodes, the start, with n = 4; or rotations, with n = 3.
        edges: nodes (i, j).
        S_ji: measurements, from node i to node j.
        information: inverse covariances of log(S_j S_i^-1 S_ji^-1), symmetric, with D = 7:
            translation, rotation, log scale; D = 6 without scale, D = 3 for rotations. Or (B, E) or (E,) weights of
            the identity; one if None.
        fixed: rows of nodes, or a (B, K) or (K,) bool mask. Without any, the first node of every connected part stays,
            and the gradient is right for losses that do not depend on the gauge.
        mask: edges that count, all if None.
        with_scale: free the scales of the nodes. If False, the log scale is not part of the error either. Rotations
            have none.
    """

    S_cw: Float[Tensor, "*#batch K n n"]
    edges: Int[Tensor, "E 2"]
    S_ji: Float[Tensor, "*#batch E n n"]
    information: Float[Tensor, "*#batch E D D"] | Float[Tensor, "*#batch E"] | None = None
    fixed: Shaped[Tensor, "..."] | Sequence[int] = (0,)
    mask: Bool[Tensor, "*#batch E"] | None = None
    with_scale: bool = True


@dataclass(frozen=True)
class PoseGraphSolution(Outcome):
    """The minimum of a pose graph; without the B where the graph had none.

    Attributes:
        cost: half the sum of robustified squared whitened errors, detached.
        success: some node is free, and all free nodes are determined. If False, the estimate is the best
            one found, but it has no gradient.
        moved: Nodes that are fixed, not finite, or not connected with a node that stays by counted edges stayed
            at their start (the identity where that is not a similarity), with a gradient to that start only.
        convergence: iterations and convergence per element of the batch.
    """

    S_cw: Float[Tensor, "*batch K n n"]
    cost: Float[Tensor, "*batch"]
    success: Bool[Tensor, "*batch"]
    moved: Bool[Tensor, "*batch K"]
    convergence: Convergence


@full_precision
def solve_pose_graph(graph: PoseGraph, *, options: SolverOptions = POSE_GRAPH_OPTIONS) -> PoseGraphSolution:
    """Minimize the robust errors log(S_j S_i^-1 S_ji^-1) of the edges over the nodes by Levenberg-Marquardt.

    Edges that are not finite, have no weight or touch a node that is not finite do not count. The implicit gradient is
    zero where the exact Hessian is not positive definite. Memory and time grow with the fill-in of the graph, for
    trajectories about linearly in the nodes.
    Source: Strasdat, Montiel and Davison, "Scale drift-aware large scale monocular SLAM", 2010.

    Args:
        options: how to minimize; gradients reach S_ji, information, scale and fixed nodes, but not the start of free
            ones.

    Raises:
        ValueError: a shape or an index does not fit, or a name is unknown.
        ConvergenceError: with `options.strict`.
    """
    inputs = _sanitized(graph, options.scale)
    minimization = PoseGraphMinimization(inputs.information.shape[-1], options)
    found = find_minimum(minimization, inputs, options.backward)
    solution, success, moving, *how = found
    convergence = Convergence(*how, limit=options.iterations)
    if options.strict:
        check_minimum(success, convergence.converged, "pose graphs")
    at_minimum = torch.where(moving[..., None, None], solution.detach(), inputs.S_cw)
    if options.backward == "implicit":
        solution = torch.where(moving[..., None, None], solution, inputs.S_cw)
    elif options.backward == "truncated":
        solution = minimization.last_step(at_minimum, inputs, success)
    if options.backward != "detached":
        solution = torch.where(success[:, None, None, None], solution, at_minimum)
    solution = warned(solution, success, convergence, "pose graphs")
    row = slice(None) if graph.S_cw.ndim == 4 else 0
    return PoseGraphSolution(solution[row], convergence.cost[row], success[row], moving[row], convergence)


def _sanitized(graph: PoseGraph, scale: Tensor | float) -> PoseGraphInputs:
    """The tensors of a graph, all batched and finite."""
    S_cw, S_ji, edges = graph.S_cw, graph.S_ji, graph.edges
    if S_cw.ndim not in (3, 4) or S_cw.shape[-1] not in (4, 3):
        raise ValueError(f"S_cw must be (B, K, 4, 4) or (K, 4, 4), or 3 by 3, not {tuple(S_cw.shape)}")
    S_cw = S_cw if S_cw.ndim == 4 else S_cw[None]
    (batch, num_nodes, n, _), num_edges = S_cw.shape, len(edges)
    if num_edges and not 0 <= int(edges.min()) <= int(edges.max()) < num_nodes:
        raise ValueError(f"edges must lie in 0 ... {num_nodes - 1}")
    if (edges[:, 0] == edges[:, 1]).any():
        raise ValueError("an edge must join two nodes, not one with itself")
    S_ji = S_ji.expand(batch, num_edges, n, n)
    information = _information(graph, S_cw, batch, num_edges)

    nodes, measured = is_similarity(S_cw), is_similarity(S_ji)
    diagonal = information.detach().diagonal(dim1=-2, dim2=-1)
    weighted = torch.isfinite(information).flatten(2).all(-1) & (diagonal >= 0).all(-1)
    counted = measured & weighted & (diagonal > 0).any(-1) & nodes[:, edges].all(-1)
    if graph.mask is not None:
        counted = counted & graph.mask
    eye = torch.eye(n, dtype=S_cw.dtype, device=S_cw.device)
    rows = counted[..., None, None]
    return PoseGraphInputs(
        torch.where(nodes[..., None, None], S_cw, eye),
        torch.where(rows, S_ji, eye),
        torch.where(rows, information, 0.0),
        kernel_scale(scale, S_cw)[..., None],
        counted,
        row_mask("fixed", graph.fixed, nodes),
        edges,
    )


def _information(graph: PoseGraph, S_cw: Tensor, batch: int, num_edges: int) -> Tensor:
    """Symmetric (B, E, D, D) from any of the forms it may be given in."""
    dims = 3 if S_cw.shape[-1] == 3 else 7 if graph.with_scale else 6
    eye = torch.eye(dims, dtype=S_cw.dtype, device=S_cw.device)
    given = S_cw.new_ones(num_edges) if graph.information is None else graph.information
    if given.ndim in (1, 2) and given.shape[-1] == num_edges:
        given = given[..., None, None] * eye
    elif given.ndim not in (3, 4) or given.shape[-3:] != (num_edges, dims, dims):
        raise ValueError(
            f"information must be (E,), (B, E), (E, {dims}, {dims}) or (B, E, {dims}, {dims}) with E = {num_edges}, "
            f"not {tuple(given.shape)}"
        )
    return (0.5 * (given + given.mT)).expand(batch, num_edges, dims, dims)


def is_similarity(S: Float[Tensor, "*batch n n"]) -> Bool[Tensor, "*batch"]:
    """Whether matrices are finite and have a scale."""
    return torch.isfinite(S).flatten(-2).all(-1) & (S.detach()[..., 0, :3].norm(dim=-1) > 0)


class Group(NamedTuple):
    """Similarities, rigid motions or rotations: matrices (..., n, n) with tangent vectors (..., D), D = `dims`.

    log: D numbers that are an edge's error, and then those that stay as they are
    left_jacobian_inverse: (..., D, D) the derivative of log(exp(xi) S) in xi at zero
    adjoint: (..., D, D) Ad with S exp(xi) = exp(Ad xi) S
    bracket: (..., D, D) half of force . [a, b] as a bilinear form a^T M b of tangent vectors
    retract: exp(xi) S; push: its change of S, to first order
    pull_back: the gradient in xi, at zero, of a loss with a gradient at exp(xi) S
    """

    dims: int
    inverse: Callable[[Tensor], Tensor]
    log: Callable[[Tensor], Tensor]
    left_jacobian_inverse: Callable[[Tensor], Tensor]
    adjoint: Callable[[Tensor], Tensor]
    bracket: Callable[[Tensor], Tensor]
    retract: Callable[[Tensor, Tensor], Tensor]
    push: Callable[[Tensor, Tensor], Tensor]
    pull_back: Callable[[Tensor, Tensor], Tensor]


def group_of(dims: int) -> Group:
    """The group whose tangent vectors have this number of dimensions: 3, 6 or 7."""
    if dims == 3:
        return Group(
            dims,
            inverse=lambda S: S.mT,
            log=so3_log,
            left_jacobian_inverse=so3_left_jacobian_inverse,
            adjoint=lambda S: S,
            bracket=lambda force: -0.5 * skew(force),
            retract=lambda S, xi: so3_exp(xi) @ S,
            push=lambda S, xi: skew(xi) @ S,
            pull_back=lambda S, grad_S: torch.linalg.cross(S, grad_S, dim=-2).sum(-1),
        )
    return Group(
        dims,
        inverse=sim3_inverse,
        log=sim3_log,
        left_jacobian_inverse=lambda log: sim3_left_jacobian_inverse(log)[..., :dims, :dims],
        adjoint=lambda S: sim3_adjoint(S)[..., :dims, :dims],
        bracket=_bracket,
        retract=retract_sim3,
        push=push,
        pull_back=lambda S, grad_S: pull_back_sim3(S, grad_S)[..., :dims],
    )


def _bracket(force: Tensor) -> Tensor:
    v, omega = skew(force[..., :3]), skew(force[..., 3:6])
    M = torch.cat((torch.cat((torch.zeros_like(v), -v), -1), torch.cat((-v, -omega), -1)), dim=-2)
    if force.shape[-1] == 7:
        M = torch.nn.functional.pad(M, (0, 1, 0, 1))
        M[..., 6, :3], M[..., :3, 6] = force[..., :3], -force[..., :3]
    return 0.5 * M


@dataclass(frozen=True)
class PoseGraphLayout:
    """The discrete part of a pose graph: moving nodes, and the order of elimination.

    Attributes:
        moving: nodes that counted edges join with one that stays
        linking: edges that, in some element, join two moving nodes
        transposed: whether the block of the pair of nodes is the transpose of the edge's
        by_pair: the edges of each pair; by_node: the edges' ends, first all i, then all j, of each node
    """

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
        moving,
        linking,
        j[linking] == high,
        Groups.of(positions, len(pairs)),
        Groups.of(torch.cat((i, j)), num_nodes),
        build_block_structure(num_nodes, dims, pairs),
    )


class PoseGraphInputs(NamedTuple):
    """All that gradients may flow to, then which edges count, which nodes are fixed, and the edges (i, j)."""

    S_cw: Float[Tensor, "B K n n"]
    S_ji: Float[Tensor, "B E n n"]
    information: Float[Tensor, "B E D D"]
    scale: Tensor
    counted: Bool[Tensor, "B E"]
    fixed: Bool[Tensor, "B K"]
    edges: Int[Tensor, "E 2"]


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
        S_cw, S_ji, information = (part.detach() for part in self.inputs[:3])
        size = torch.cat((S_cw.flatten(1), S_ji.flatten(1)), dim=-1).abs().amax(-1)
        # A start along a tree of edges without a loop is off the minimum by these alone.
        rounding = ROUNDINGS * torch.finfo(size.dtype).eps * size
        return 0.5 * information.diagonal(dim1=-2, dim2=-1).sum((1, 2)) * rounding.square()

    def evaluate(self, S_cw: Tensor, use_curvature: Tensor) -> PoseGraphModel:
        lin = self._linearize(S_cw)
        _, weight, curvature = lin.kernel
        along = flat_along(weight, 2 * curvature, lin.squared, use_curvature[:, None])
        outer = lin.weighted_residual[..., :, None] * lin.weighted_residual[..., None, :]
        curve = weight[..., None, None] * self.inputs.information + along[..., None, None] * outer
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
        return linearize_edges(S_cw, self.inputs, self.group, self.kernel)

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
        both = layout.moving[:, self.inputs.edges].all(-1)[:, linking, None, None]
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
        return torch.where(self.inputs.counted[..., None, None], 0.5 * (hessian + hessian.mT), 0.0)


def linearize_edges(
    S_cw: Float[Tensor, "B K n n"],
    inputs: PoseGraphInputs,
    group: Group,
    kernel: Kernel,
) -> EdgeLinearization:
    """Errors of the edges from nodes i to j, and how they change."""
    i, j = inputs.edges.unbind(-1)
    relative = S_cw.index_select(1, j) @ group.inverse(S_cw).index_select(1, i)
    full = group.log(relative @ group.inverse(inputs.S_ji))
    error, rest = full.tensor_split((group.dims,), dim=-1)
    weighted_residual = (inputs.information @ error[..., None]).squeeze(-1)
    squared = (error * weighted_residual).sum(-1)
    robust = robustify(squared, kernel, inputs.scale)
    robust = Robustified(*(torch.where(inputs.counted, x, 0.0) for x in robust))
    J, carry = group.left_jacobian_inverse(full), group.adjoint(relative)
    return EdgeLinearization(error, J, carry, weighted_residual, squared, robust, rest)


class PoseGraphMinimization(Minimization):
    """A pose graph of inputs `PoseGraphInputs`. Found are nodes, `success`, what moved (B, K), and how it went; vectors
    are (B, K, D)."""

    num_unknowns = 1
    num_vectors = 1
    ndims: tuple[Ndims, Ndims, Ndims] = ((2,), (3, 0, 1, 0, 0, 0, 0), (3, 3, 3, 1, 1, 1, 2))

    def __init__(self, dims: int, options: SolverOptions) -> None:
        self.group, self.options = group_of(dims), options
        self._last: tuple[tuple[Tensor, Tensor], PoseGraphLayout] | None = None

    def minimize(self, inputs: Tensors) -> Tensors:
        problem = self._problem(inputs)
        options = self.options
        model, convergence = minimize_batch(problem, inputs[0], options.iterations, options.tolerance)
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
        given, (xi,) = PoseGraphInputs(*inputs), direction
        S_cw = torch.where(found[2][..., None, None], found[0], given.S_cw)
        lin = linearize_edges(S_cw, given, self.group, self.options.kernel)
        xi_i, xi_j = (xi.index_select(1, nodes)[..., None] for nodes in given.edges.unbind(-1))
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
        given = PoseGraphInputs(*inputs)
        key = given.counted, given.fixed
        if self._last is None or not all(map(torch.equal, self._last[0], key)):  # the last layout is cached
            self._last = key, build_pose_graph_layout(given.edges, *key, self.group.dims)
        return PoseGraphProblem(self._last[1], given, self.options.kernel)
