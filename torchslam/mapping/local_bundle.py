"""Bundle adjustment of a part of the map: which keyframes are free, which are fixed, what happens to outliers."""

from __future__ import annotations

import torch
from torch import Tensor

from torchslam.config import BundleConfig
from torchslam.geometry import CHI_SQUARE_95, Camera, fits, transform
from torchslam.solvers import BundleProblem, bundle_adjust
from torchslam.solvers.levenberg import Progress
from torchslam.values import Observations
from torchslam.world.map import Map
from torchslam.world.observers import most

NEGLIGIBLE = 1e-4  # share of the cost that a step must promise: the next keyframe moves the map by more
HUBER = CHI_SQUARE_95**0.5  # where a residual leaves the quadratic part


def adjust(
    slam_map: Map, keyframe: int, camera: Camera, settings: BundleConfig, covariances: bool = False
) -> None:
    """Adjust a keyframe, the ones that see most of its points, and all points that these see.

    Other keyframes that see these points take part with fixed poses, and so does the first keyframe of the map.
    If `covariances`, the map learns how certain all this is, what is fixed taken as exact.
    """
    near = slam_map.covisible(keyframe, settings.window - 1)
    free = torch.cat([near.new_tensor([keyframe]), near])
    free = free[free != 0]
    shared = slam_map.observers(slam_map.points_seen_by(free))
    shared[free] = 0
    fixed = most(shared, settings.max_fixed, least=1)
    adjust_keyframes(slam_map, free, fixed, camera, settings.iterations, covariances, tolerance=NEGLIGIBLE)


def adjust_all(
    slam_map: Map, camera: Camera, settings: BundleConfig, progress: Progress | None = None
) -> None:
    """Adjust the whole map, the first keyframe fixed.

    progress: called before each iteration; if it raises, the map stays as it was.
    """
    everyone = torch.arange(slam_map.num_keyframes, device=slam_map.T_cw.device)
    adjust_keyframes(
        slam_map,
        everyone[1:],
        everyone[:1],
        camera,
        settings.final_iterations,
        covariances=False,
        progress=progress,
    )


def adjust_keyframes(
    slam_map: Map,
    free: Tensor,
    fixed: Tensor,
    camera: Camera,
    iterations: int,
    covariances: bool,
    progress: Progress | None = None,
    tolerance: float = 1e-8,
) -> None:
    """Move the free keyframes (k,) and the points they see to the least reprojection error, then drop outliers."""
    keyframes = torch.sort(torch.cat([free, fixed])).values
    seen = slam_map.observations(keyframes)
    seen = select(seen, torch.isin(seen.point_index, slam_map.points_seen_by(free)))
    _, which, counts = torch.unique(seen.point_index, return_inverse=True, return_counts=True)
    seen = select(seen, counts[which] >= 2)
    if len(seen) == 0:
        return
    point_ids, point_index = torch.unique(seen.point_index, return_inverse=True)
    problem = BundleProblem(
        slam_map.T_cw[keyframes],
        slam_map.positions_w[point_ids],
        torch.searchsorted(keyframes, seen.keyframe_index),
        point_index,
        seen.pixels,
        camera,
        weights=seen.noise.weights,
        fixed_frames=torch.isin(keyframes, fixed),
    )
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
    slam_map.keyframes["T_cw"][keyframes] = solution.T_cw
    slam_map.points["positions_w"][point_ids] = solution.points_w
    if covariances:
        slam_map.take_covariances(keyframes, point_ids, solution.covariance())
    drop_outliers(slam_map, seen, camera)
    slam_map.refresh(keyframes)


def drop_outliers(slam_map: Map, seen: Observations, camera: Camera) -> None:
    """Forget observations that disagree with the map, and kill points that fewer than two keyframes still see."""
    points_c = transform(slam_map.T_cw[seen.keyframe_index], slam_map.positions_w[seen.point_index][:, None])
    wrong = ~fits(seen.noise.squared_reprojection(points_c[:, 0], seen.pixels, camera))
    slam_map.drop(seen, wrong)


def select(seen: Observations, rows: Tensor) -> Observations:
    """Some of the observations, by mask or index."""
    return Observations(*(getattr(seen, name)[rows] for name in Observations.__dataclass_fields__))
