"""Points that are one: found again in keyframes that see the same place, and merged."""

from __future__ import annotations

import torch
from torch import Tensor

from torchslam.config import Config
from torchslam.geometry import Camera, fits, squared_reprojection_errors, transform
from torchslam.tracking.correspondences import match_near, project_points
from torchslam.world.map import Map


def fuse(slam_map: Map, keyframe: int, neighbours: Tensor, camera: Camera, config: Config) -> None:
    """Find the points of this keyframe in its neighbours and theirs in it; merge what turns out to be one point."""
    own = slam_map.points_seen_by(slam_map.ids(keyframe))
    merge(slam_map, [find_in(slam_map, neighbour, own, camera, config) for neighbour in neighbours.tolist()])
    merge(slam_map, [find_in(slam_map, keyframe, slam_map.points_seen_by(neighbours), camera, config)])


def find_in(
    slam_map: Map, keyframe: int, point_ids: Tensor, camera: Camera, config: Config
) -> tuple[Tensor, Tensor]:
    """Match points (n,) that a keyframe does not see yet to its keypoints.

    Free keypoints see them from now on. Returns pairs (m,), (m,) of points that are one: found at a keypoint that
    sees another point already.
    """
    seen = slam_map.keyframes["point_ids"][keyframe]
    new = point_ids[~torch.isin(point_ids, seen)]
    view, T_cw = slam_map.view(keyframe), slam_map.T_cw[keyframe]
    projected = project_points(
        slam_map, new, T_cw, camera, config.tracking.max_view_angle_deg, view.scale_range
    )
    ids, keypoints = match_near(slam_map, projected, view, 3.0, config.matching, ratio=None)
    points_c = transform(T_cw, slam_map.positions_w[ids])
    errors = squared_reprojection_errors(points_c, view.keypoints[keypoints], camera)
    agrees = fits(errors, view.scales[keypoints], config.measurement.chi_square)
    ids, keypoints = ids[agrees], keypoints[agrees]
    taken = seen[keypoints]
    is_free = taken < 0
    slam_map.observe(keyframe, keypoints[is_free], ids[is_free])
    return ids[~is_free], taken[~is_free]


def merge(slam_map: Map, pairs: list[tuple[Tensor, Tensor]]) -> None:
    """Merge pairs of points (m,), (m,): of those that are one, the one with most observations stays."""
    observed = slam_map.points["times_observed"]
    heir: dict[int, int] = {}

    def last_heir(point: int) -> int:
        while point in heir:
            point = heir[point]
        return point

    for found, there in pairs:
        for pair in zip(found.tolist(), there.tolist(), strict=True):
            one, other = (last_heir(point) for point in pair)
            if one != other:
                old, kept = (one, other) if observed[one] <= observed[other] else (other, one)
                heir[old] = kept
    if heir:
        last = [last_heir(point) for point in heir.values()]
        slam_map.replace(observed.new_tensor(list(heir)), observed.new_tensor(last))
