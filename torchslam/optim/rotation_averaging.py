"""Rotation averaging: absolute rotations of views from measured relative ones; robust, sparse, differentiable."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchslam.geometry.precision import check_dtypes, full_precision
from torchslam.geometry.robust import Kernel, kernel_scale, robustify
from torchslam.optim._core.levenberg_marquardt import Convergence, SolverReason, check_minimum
from torchslam.optim._core.options import ROTATION_OPTIONS, UNWEIGHTED_ROTATION_OPTIONS, SolverOptions
from torchslam.optim._rotation_start import RotationEdges, robust_start, spanning_forest
from torchslam.optim.pose_graph._api import PoseGraph, PoseGraphSolution, is_similarity, solve_pose_graph
from torchslam.utils.indexing import connected_parts


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
    Sources: Hartley, Trumpf, Dai and Li, "Rotation averaging", 2013; Chatterjee and Govindu, "Robust relative rotation
    averaging", 2018; Yang et al., "Graduated non-convexity for robust spatial perception", 2020.

    Args:
        edges: views (i, j).
        R_ji: measured rotations from camera i to camera j: R_j = R_ji R_i.
        num_views: K.
        weights: inverse variances per axis, in rad^-2; one if None.
        start: rotations to begin with in place of the forest. First views stay there, with a gradient to it.
        options: how to minimize, in the end; None: `ROTATION_OPTIONS`, or without weights
            `UNWEIGHTED_ROTATION_OPTIONS`. The scale of the kernels is in radians times the root of the weight.
            Gradients reach R_ji, weights, scale and the start of first views.

    Returns:
        Rotations, differentiable.

    Raises:
        ValueError: a shape or an index does not fit, or a name is unknown.
        ConvergenceError: with `options.strict`.
    """
    _check(edges, R_ji, num_views, weights, start)
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


def _check(edges: Tensor, R_ji: Tensor, num_views: int, weights: Tensor | None, start: Tensor | None) -> None:
    """Raises ValueError where shapes, indices or types do not fit."""
    num_edges = len(edges)
    if edges.shape[1:] != (2,) or R_ji.shape != (num_edges, 3, 3):
        raise ValueError(
            f"edges and R_ji must be (E, 2) and (E, 3, 3), not {tuple(edges.shape)} and {tuple(R_ji.shape)}"
        )
    if weights is not None and weights.shape != (num_edges,):
        raise ValueError(f"weights must be (E,) with E = {num_edges}, not {tuple(weights.shape)}")
    if start is not None and start.shape != (num_views, 3, 3):
        raise ValueError(f"start must be (K, 3, 3) with K = {num_views}, not {tuple(start.shape)}")
    if num_views < 1:
        raise ValueError(f"num_views must be positive, not {num_views}")
    if num_edges and not 0 <= int(edges.min()) <= int(edges.max()) < num_views:
        raise ValueError(f"edges must lie in 0 ... {num_views - 1}")
    if (edges[:, 0] == edges[:, 1]).any():
        raise ValueError("an edge must join two views, not one with itself")
    check_dtypes(R_ji=R_ji, weights=weights, start=start)


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
