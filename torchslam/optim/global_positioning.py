"""Global positioning: camera centers and points from rays in the axes of the world; robust, sparse, differentiable."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from torchslam.geometry.precision import check_dtypes, full_precision
from torchslam.optim._core.implicit import find_minimum
from torchslam.optim._core.levenberg_marquardt import Convergence, SolverReason, check_minimum
from torchslam.optim._core.options import POSITION_OPTIONS, SolverOptions
from torchslam.optim._positions import (
    PositionInputs,
    PositionMinimization,
    PositionProblem,
    search_positions,
)
from torchslam.optim.bundle._sparse import SparseLayout, build_sparse_layout
from torchslam.optim.pose_graph._problem import connected_parts

# Views that see fewer points of others are not determined, nor are points that fewer views see.
_LEAST_SEEN = 2


@dataclass(frozen=True)
class GlobalPositions:
    """Camera centers and points that agree best with rays.

    Attributes:
        centers_w: zero, or at the start, where they are not determined.
        points_w: the same.
        angles: between each ray and the direction to its point, in radians, detached; above pi / 2 the point is behind
            the camera. Infinite where the view, the point or the ray does not count.
        determined: views that are positioned; none without `success`.
        component: the lowest view that points join with each view, over others or not.
        success: the rays determine the positions of the largest component, up to one translation and one scale. If
            False, there is no gradient.
        convergence: of the last minimization, from a start that is near its end.
    """

    centers_w: Float[Tensor, "K 3"]
    points_w: Float[Tensor, "N 3"]
    angles: Float[Tensor, " O"]
    determined: Bool[Tensor, " K"]
    component: Int[Tensor, " K"]
    success: Bool[Tensor, ""]
    convergence: Convergence

    @property
    def reasons(self) -> list[SolverReason]:
        """How the search ended, for each problem, of which there is one."""
        return self.convergence.reasons(self.success)


@full_precision
def solve_positions(
    view_index: Int[Tensor, " O"],
    point_index: Int[Tensor, " O"],
    rays_w: Float[Tensor, "O 3"],
    num_views: int,
    num_points: int,
    weights: Float[Tensor, " O"] | None = None,
    start: tuple[Float[Tensor, "K 3"], Float[Tensor, "N 3"]] | None = None,
    *,
    seed: int = 0,
    options: SolverOptions = POSITION_OPTIONS,
) -> GlobalPositions:
    """Minimize the robust sines of the angles between rays and the directions from cameras to points, over both.

    It needs neither a start nor relative translations, as the search begins with distances that are unknowns of their
    own. Rays that are not finite, have no positive weight or touch what has no finite start do not count. Only the
    largest component is positioned, without points whose rays are parallel or that one view sees alone, and without
    views that see fewer than two other points. The result is that of float64 whatever the input, and does not depend
    on the order of the rays, to the last bit.

    Translation and scale are free: the first view that is positioned is the origin, and the root mean square distance
    of the centers from their mean is one; or both are those of the start. Gradients include this choice, and are zero
    for rays to points behind the camera. `success` is about rays without noise: noise alone can seem to determine the
    positions of a camera that only turns, or the lengths of a straight walk whose points two views see.
    Sources: Zhuang, Cheong and Lee, "Baseline desensitizing in translation averaging", 2018; Pan, Baráth, Pollefeys and
    Schönberger, "Global structure-from-motion revisited", 2024.

    Args:
        view_index: of each ray.
        point_index: of each ray.
        rays_w: directions from cameras to points in the axes of the world, R_cw^T times those in the camera; of any
            length.
        num_views: K.
        num_points: N.
        weights: inverse variances of the directions, in rad^-2; one if None.
        start: centers and points to begin with in place of the search.
        seed: of the random positions from which the search begins.
        options: of the last part of the search, and of the last minimization. The latter alone has the kernel, in units
            of the sine of the angle times the root of the weight: the search has Huber's, with a scale of 0.1 or more.
            Many wrong rays pull the centers with that one too: "geman_mcclure" with a few standard deviations as the
            scale leaves them behind. Gradients reach rays_w, weights and scale.

    Returns:
        Positions, differentiable.

    Raises:
        ValueError: a shape or an index does not fit, or a name is unknown.
        ConvergenceError: with `options.strict`.
    """
    kernel, backward = options.kernel, options.backward
    iterations, tolerance = options.iterations, options.tolerance
    _check(view_index, point_index, rays_w, (num_views, num_points), weights, start)
    scale = torch.as_tensor(options.scale, dtype=torch.float64, device=rays_w.device)
    if not scale > 0:
        raise ValueError(f"scale must be positive, not {float(scale)}")
    dtype, rays_w, view, point = rays_w.dtype, rays_w.double(), view_index, point_index
    weights = rays_w.new_ones(len(rays_w)) if weights is None else weights.double()
    given = rays_w.new_zeros(num_views + num_points, 3)
    if start is not None:
        given = torch.cat(start).detach().double()
    known, given = torch.isfinite(given).all(-1), torch.where(torch.isfinite(given), given, 0.0)

    with torch.no_grad():
        length = rays_w.norm(dim=-1)
        counted = torch.isfinite(length) & (length > 0) & torch.isfinite(weights) & (weights > 0)
        counted = counted & known[view] & known[num_views + point]
        component = _components(view[counted], point[counted], num_views, num_points)
        rows = counted.nonzero().squeeze(-1)
        # An order that does not depend on the given one.
        for key in (weights, *rays_w.unbind(-1), point, view):
            rows = rows[torch.argsort(key[rows], stable=True)]
        part, at = _Part.of(view, point, rows, num_views, num_points), given
        if start is None:
            at = torch.from_numpy(np.random.default_rng(seed).uniform(-1, 1, given.shape)).to(given)
        if len(part.rows):
            problem = PositionProblem(part.layout, part.inputs(rays_w, weights, scale, at), kernel)
            near, determining = search_positions(problem, iterations, tolerance, start is None)
            at = at.index_copy(0, part.placed, torch.cat(near[:2]))
            part = _Part.of(view, point, part.rows[determining], num_views, num_points)

    minimization = PositionMinimization(part.layout, kernel, iterations, tolerance)
    inputs = part.inputs(rays_w, weights, scale, at)
    found = find_minimum(minimization, inputs, backward)
    centers_w, points_w, success, steps, converged, initial_cost, cost = found
    if options.strict:
        check_minimum(success, converged, "problems")
    if backward == "truncated" and len(part.rows):
        centers_w, points_w, _ = minimization.last_step(found, inputs)
    # The gauge of the result.
    before = given.index_select(0, part.placed)
    ratio, origin = 1 / _size(centers_w), before[:1]
    if start is not None:
        ratio = ratio * _size(before[: len(centers_w)])
    moved = origin + ratio * (torch.cat((centers_w, points_w)) - centers_w[:1])
    everything = given.index_copy(0, part.placed, torch.where(success, moved, before))
    determined = torch.zeros_like(known).index_copy(0, part.placed, success.expand(len(part.placed)))
    with torch.no_grad():
        view, point, rays_w = view[rows], point[rows], rays_w[rows]
        u = everything[num_views + point] - everything[view]
        angles = torch.atan2(torch.linalg.cross(u, rays_w).norm(dim=-1), (u * rays_w).sum(-1))
        angles = torch.where(determined[view] & determined[num_views + point], angles, torch.inf)
        angles = torch.full_like(length, torch.inf).index_copy(0, rows, angles)
    centers_w, points_w = everything.to(dtype).tensor_split((num_views,))
    determined = determined[:num_views]
    return GlobalPositions(
        centers_w,
        points_w,
        angles.to(dtype),
        determined,
        component,
        success,
        Convergence(steps, converged, initial_cost, cost, options.iterations),
    )


def _check(
    view_index: Tensor,
    point_index: Tensor,
    rays_w: Tensor,
    counts: tuple[int, int],
    weights: Tensor | None,
    start: tuple[Tensor, Tensor] | None,
) -> None:
    """Raises ValueError where shapes, indices or types do not fit."""
    centers_w, points_w = (None, None) if start is None else start
    shapes = (
        ("start centers", centers_w, (counts[0], 3)),
        ("start points", points_w, (counts[1], 3)),
    )
    for name, tensor, shape in shapes:
        if tensor is not None and tensor.shape != shape:
            raise ValueError(f"{name} must be {shape}, not {tuple(tensor.shape)}")
    for name, index, count in zip(("view", "point"), (view_index, point_index), counts, strict=True):
        if count < 1:
            raise ValueError(f"num_{name}s must be positive, not {count}")
        if len(index) and not 0 <= int(index.min()) <= int(index.max()) < count:
            raise ValueError(f"{name}_index must lie in 0 ... {count - 1}")
    check_dtypes(rays_w=rays_w, weights=weights, centers_w=centers_w, points_w=points_w)


@dataclass(frozen=True)
class _Part:
    """Rays to minimize, in the order of a layout of their own.

    Attributes:
        placed: the views that they join, then num_views and more for the points.
    """

    rows: Int[Tensor, " M"]
    placed: Int[Tensor, " A"]
    layout: SparseLayout

    @staticmethod
    def of(view: Tensor, point: Tensor, rows: Int[Tensor, " R"], num_views: int, num_points: int) -> _Part:
        """Of these rays, those of the component with most views, without what too few rays determine."""
        rows = rows[_largest_part(view[rows], point[rows], num_views, num_points)]
        views, view = torch.unique(view[rows], return_inverse=True)
        points, point = torch.unique(point[rows], return_inverse=True)
        rays, frames, marks = (torch.ones_like(x, dtype=torch.bool) for x in (rows, views, points))
        layout = build_sparse_layout(
            view, point, rays, frames, marks, torch.zeros_like(views), 1, frame_dims=3
        )
        placed = torch.cat((views, num_views + points[layout.point_order]))
        return _Part(rows[layout.observations], placed, layout)

    def inputs(self, rays_w: Tensor, weights: Tensor, scale: Tensor, at: Tensor) -> PositionInputs:
        """Of these rays, and of positions (A, 3) of views, then of points."""
        centers_w, points_w = at.index_select(0, self.placed).tensor_split((len(self.layout.free_frames),))
        unit = normalize(rays_w.index_select(0, self.rows), dim=-1)
        return PositionInputs(unit, weights.index_select(0, self.rows), scale, centers_w, points_w)


def _components(view: Tensor, point: Tensor, num_views: int, num_points: int) -> Int[Tensor, " K"]:
    """The lowest view that points join, over others or not, with each view."""
    edges = torch.stack((view, num_views + point), dim=-1)
    counted = torch.ones(1, len(edges), dtype=torch.bool, device=view.device)
    return connected_parts(edges, counted, counted.new_zeros(1, num_views + num_points))[0, :num_views]


def _largest_part(view: Tensor, point: Tensor, num_views: int, num_points: int) -> Bool[Tensor, " O"]:
    """The rays of the component with most views, without what too few rays determine."""
    pairs, pair = torch.unique(view * num_points + point, return_inverse=True)
    view, point = pairs // num_points, pairs % num_points
    used = torch.ones_like(pairs, dtype=torch.bool)
    while True:
        views_of = torch.bincount(point[used], minlength=num_points)
        points_of = torch.bincount(view[used], minlength=num_views)
        still = used & (views_of[point] >= _LEAST_SEEN) & (points_of[view] >= _LEAST_SEEN)
        if torch.equal(still, used):
            break
        used = still
    component = _components(view[used], point[used], num_views, num_points)
    largest = torch.bincount(component, minlength=num_views).argmax()
    return (used & (component == largest)[view])[pair]


def _size(centers_w: Float[Tensor, "k 3"]) -> Float[Tensor, ""]:
    """The root mean square distance from the mean, not zero, where it would have no gradient."""
    squared = (centers_w - centers_w.mean(0)).square().sum(-1).mean()
    return squared.clamp_min(torch.finfo(squared.dtype).tiny).sqrt()
