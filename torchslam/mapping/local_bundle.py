"""Bundle adjustment of a part of the map: which keyframes are free, which are fixed, what happens to outliers."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchslam.config import BundleAdjustmentConfig
from torchslam.geometry import CHI_SQUARE_95, Camera, fits, transform
from torchslam.map.map import Map
from torchslam.map.observation_index import most
from torchslam.optim import BundleProblem, bundle_adjust
from torchslam.optim.bundle.local_numpy import adjust_local_bundle
from torchslam.optim.bundle.schur import Marginals
from torchslam.optim.core.levenberg_marquardt import Progress
from torchslam.types import Observations
from torchslam.utils.indexing import distinct, is_among, ranks_among, true_indices

NEGLIGIBLE = 1e-4  # share of the cost that a step must promise: the next keyframe moves the map by more
HUBER = CHI_SQUARE_95**0.5  # where a residual leaves the quadratic part


@dataclass(frozen=True)
class Part:
    """A part of the map that is adjusted at once.

    keyframes: (k,) rows, ascending; point_ids: (p,) rows; seen: the observations of these by those
    problem:   the same as a problem of its own
    """

    keyframes: Tensor
    point_ids: Tensor
    seen: Observations
    problem: BundleProblem


@dataclass(frozen=True)
class Adjusted:
    """Where a part belongs: T_cw (k, 4, 4), points_w (p, 3), and how certain that is, where it was asked for."""

    T_cw: Tensor
    points_w: Tensor
    marginals: Marginals | None


def adjust(
    slam_map: Map, keyframe: int, camera: Camera, settings: BundleAdjustmentConfig, covariances: bool = False
) -> None:
    """Adjust what is around a keyframe; if `covariances`, the map learns how certain all this is."""
    part = around(slam_map, keyframe, camera, settings)
    if part is not None:
        take(slam_map, part, solve_around(part.problem, settings.local_iterations, covariances), camera)


def around(slam_map: Map, keyframe: int, camera: Camera, settings: BundleAdjustmentConfig) -> Part | None:
    """A keyframe, the ones that see most of its points, and all points that these see; None where that is nothing.

    Other keyframes that see these points take part with fixed poses, and so does the first keyframe of the map.
    """
    near = slam_map.covisible(keyframe, settings.local_window - 1)
    free = torch.cat([near.new_tensor([keyframe]), near])
    free = free[free != 0]
    shared = slam_map.observers(slam_map.points_seen_by(free))
    shared[free] = 0
    return part_of(slam_map, free, most(shared, settings.max_fixed_keyframes, least=1), camera)


def solve_around(problem: BundleProblem, iterations: int, covariances: bool) -> Adjusted:
    """Adjust what is around a keyframe, as exactly as the next one leaves it; what is fixed is taken as exact."""
    if covariances:
        return solve(problem, iterations, covariances, tolerance=NEGLIGIBLE)
    return Adjusted(*adjust_local_bundle(problem, HUBER, iterations, NEGLIGIBLE)[:2], None)


def adjust_all(
    slam_map: Map, camera: Camera, settings: BundleAdjustmentConfig, progress: Progress | None = None
) -> None:
    """Adjust the whole map, the first keyframe fixed.

    progress: called before each iteration; if it raises, the map stays as it was.
    """
    everyone = torch.arange(slam_map.num_keyframes, device=slam_map.T_cw.device)
    adjust_keyframes(
        slam_map, everyone[1:], everyone[:1], camera, settings.global_iterations, progress=progress
    )


def adjust_keyframes(
    slam_map: Map,
    free: Tensor,
    fixed: Tensor,
    camera: Camera,
    iterations: int,
    covariances: bool = False,
    progress: Progress | None = None,
) -> None:
    """Move the free keyframes (k,) and the points they see to the least reprojection error, then drop outliers."""
    part = part_of(slam_map, free, fixed, camera)
    if part is not None:
        take(slam_map, part, solve(part.problem, iterations, covariances, progress), camera)


def part_of(slam_map: Map, free: Tensor, fixed: Tensor, camera: Camera) -> Part | None:
    """The free keyframes (k,), what they see, and the fixed ones that see some of it; None where that is nothing."""
    keyframes = torch.sort(torch.cat([free, fixed])).values
    seen = slam_map.observations(keyframes)
    rows = true_indices(is_among(seen.point_index, slam_map.points_seen_by(free)))
    ids = seen.point_index.index_select(0, rows)
    which = ranks_among(ids, distinct(ids))
    seen = select(seen, rows[torch.bincount(which)[which] >= 2])
    if len(seen) == 0:
        return None
    point_ids = distinct(seen.point_index)
    problem = BundleProblem(
        slam_map.T_cw[keyframes],
        slam_map.positions_w[point_ids],
        torch.searchsorted(keyframes, seen.keyframe_index),
        ranks_among(seen.point_index, point_ids),
        seen.pixels,
        camera,
        weights=seen.noise.weights,
        fixed_frames=torch.isin(keyframes, fixed),
    )
    return Part(keyframes, point_ids, seen, problem)


def solve(
    problem: BundleProblem,
    iterations: int,
    covariances: bool = False,
    progress: Progress | None = None,
    tolerance: float = 1e-8,
) -> Adjusted:
    """The least reprojection error of a part. A pure function: it may be called anywhere."""
    solution = bundle_adjust(
        problem,
        kernel="huber",
        scale=HUBER,
        backward="detached",
        iterations=iterations,
        tolerance=tolerance,
        progress=progress,
        check=False,
    )
    return Adjusted(solution.T_cw, solution.points_w, solution.covariance() if covariances else None)


def take(slam_map: Map, part: Part, adjusted: Adjusted, camera: Camera) -> None:
    """Put a part of the map to where it belongs, and forget what disagrees with that.

    The map must be as it was when the part was taken from it, but for what frames count in it.
    """
    slam_map.keyframes["T_cw"][part.keyframes] = adjusted.T_cw
    slam_map.points["positions_w"][part.point_ids] = adjusted.points_w
    if adjusted.marginals is not None:
        slam_map.take_covariances(part.keyframes, part.point_ids, adjusted.marginals)
    drop_outliers(slam_map, part.seen, camera)
    slam_map.refresh(part.keyframes)


def drop_outliers(slam_map: Map, seen: Observations, camera: Camera) -> None:
    """Forget observations that disagree with the map, and kill points that fewer than two keyframes still see."""
    points_c = transform(slam_map.T_cw[seen.keyframe_index], slam_map.positions_w[seen.point_index][:, None])
    wrong = ~fits(seen.noise.squared_reprojection(points_c[:, 0], seen.pixels, camera))
    slam_map.drop(seen, wrong)


def select(seen: Observations, rows: Tensor) -> Observations:
    """Some of the observations, by index."""
    columns = (getattr(seen, name) for name in Observations.__dataclass_fields__)
    return Observations(*(column.index_select(0, rows) for column in columns))
