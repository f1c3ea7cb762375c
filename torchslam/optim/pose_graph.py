"""Pose graph optimization over similarities, rigid poses or rotations: sparse, robust, batched, differentiable."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from torchslam.geometry.precision import full_precision
from torchslam.geometry.robust import kernel_scale
from torchslam.optim._core.implicit import find_minimum
from torchslam.optim._core.levenberg_marquardt import (
    POSE_GRAPH_OPTIONS,
    Convergence,
    Outcome,
    SolverOptions,
    check_minimum,
)
from torchslam.optim._pose_graph_problem import PoseGraphInputs, PoseGraphMinimization
from torchslam.utils.indexing import row_mask


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
        graph: the pose graph, or a batch.
        options: how to minimize; gradients reach S_ji, information, scale and fixed nodes, but not the start of free
            ones.

    Returns:
        The nodes at the minimum, differentiable.

    Raises:
        ValueError: a shape or an index does not fit, or a name is unknown.
        ConvergenceError: with `options.strict`.
    """
    counted, fixed, inputs = _sanitized(graph, options.scale)
    dims = inputs.information.shape[-1]
    minimization = PoseGraphMinimization(dims, options.kernel, options.iterations, options.tolerance)
    tensors = (*inputs, counted, fixed, graph.edges)
    found = find_minimum(minimization, tensors, options.backward)
    solution, success, moving, *how = found
    convergence = Convergence(*how, limit=options.iterations)
    if options.strict:
        check_minimum(success, convergence.converged, "pose graphs")
    at_minimum = torch.where(moving[..., None, None], solution.detach(), inputs.S_cw)
    if options.backward == "implicit":
        solution = torch.where(moving[..., None, None], solution, inputs.S_cw)
    elif options.backward == "truncated":
        solution = minimization.last_step(at_minimum, tensors, success)
    if options.backward != "detached":
        solution = torch.where(success[:, None, None, None], solution, at_minimum)
    row = slice(None) if graph.S_cw.ndim == 4 else 0
    return PoseGraphSolution(solution[row], convergence.cost[row], success[row], moving[row], convergence)


def _sanitized(graph: PoseGraph, scale: Tensor | float) -> tuple[Tensor, Tensor, PoseGraphInputs]:
    """Edges that count (B, E), fixed nodes (B, K), and the tensors, all batched and finite."""
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
    fixed = row_mask("fixed", graph.fixed, nodes)
    eye = torch.eye(n, dtype=S_cw.dtype, device=S_cw.device)
    rows = counted[..., None, None]
    inputs = PoseGraphInputs(
        torch.where(nodes[..., None, None], S_cw, eye),
        torch.where(rows, S_ji, eye),
        torch.where(rows, information, 0.0),
        kernel_scale(scale, S_cw)[..., None],
    )
    return counted, fixed, inputs


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
