"""Landmark fusion: data association of map points with covisible keyframes, and merging of duplicates."""

from __future__ import annotations

import torch
from torch import Tensor

from torchslam.config import Config
from torchslam.features import match_by_projection
from torchslam.geometry import Camera, passes_gate
from torchslam.map.map import Map
from torchslam.tracking.correspondences import predict_observations
from torchslam.tracking.matcher import max_distance

RADIUS_PX = 3.0  # around the projection, at the finest pyramid level


def fuse(slam_map: Map, keyframe: int, neighbors: Tensor, camera: Camera, config: Config) -> None:
    """Match the points of a keyframe in its covisible keyframes and theirs in it, and merge duplicates."""
    here = slam_map.ids(keyframe)
    own = slam_map.points_seen_by(here)
    merge_points(slam_map, *match_in_keyframes(slam_map, neighbors, own, camera, config))
    merge_points(
        slam_map, *match_in_keyframes(slam_map, here, slam_map.points_seen_by(neighbors), camera, config)
    )


def match_in_keyframes(
    slam_map: Map, keyframes: Tensor, point_ids: Tensor, camera: Camera, config: Config
) -> tuple[Tensor, Tensor]:
    """Match points (n,) by projection into keyframes (k,) that do not observe them yet.

    Matches with free keypoints become observations. Returns the other matches as pairs (m,), (m,) of duplicate points:
    the matched point and the one that the keypoint already observes.
    """
    if len(keyframes) == 0 or len(point_ids) == 0:
        return point_ids[:0], point_ids[:0]
    table, points, angle = slam_map.keyframes, slam_map.points, config.tracking.max_view_angle_deg
    features = slam_map.features(keyframes)
    T_cw, sizes = slam_map.T_cw[keyframes], slam_map.scale_ranges(keyframes)
    pixels, scales, visible = predict_observations(slam_map, point_ids, T_cw, camera, angle, sizes)
    visible &= ~slam_map.sees(keyframes, point_ids)
    somewhere = torch.nonzero(visible.any(0))[:, 0]
    point_ids = point_ids[somewhere]
    pixels, scales, visible = (x.index_select(1, somewhere) for x in (pixels, scales, visible))
    matches = match_by_projection(
        points["descriptors"][point_ids].expand(len(keyframes), -1, -1),
        pixels,
        RADIUS_PX * scales,
        features,
        mask=visible,
        scales=scales,
        max_distance=max_distance(features.descriptors, config.matching),
        ratio=None,
    )
    which, row = torch.nonzero(matches.mask, as_tuple=True)
    ids, keyframe, keypoint = point_ids[row], keyframes[which], matches.indices_2[which, row]
    errors = slam_map.noise(keyframe, keypoint).squared(
        pixels[which, row] - table["keypoints"][keyframe, keypoint]
    )
    agrees = passes_gate(errors, config.measurement.max_chi_square)
    ids, keyframe, keypoint = ids[agrees], keyframe[agrees], keypoint[agrees]
    taken = table["point_ids"][keyframe, keypoint]
    is_free = taken < 0
    slam_map.observe(keyframe[is_free], keypoint[is_free], ids[is_free])
    return ids[~is_free], taken[~is_free]


def merge_points(slam_map: Map, found: Tensor, there: Tensor) -> None:
    """Merge pairs of points (m,), (m,); of each group of duplicates the point with most observations stays."""
    pairs = torch.stack([found, there], dim=1)
    counts = slam_map.points["times_observed"][pairs]
    observed = dict(zip(pairs.flatten().tolist(), counts.flatten().tolist(), strict=True))
    replacement: dict[int, int] = {}

    def follow_merges(point: int) -> int:
        while point in replacement:
            point = replacement[point]
        return point

    often = zip(found.tolist(), there.tolist(), strict=True)  # a pair may be found in several keyframes
    for pair in dict.fromkeys(often):
        one, other = (follow_merges(point) for point in pair)
        if one != other:
            old, kept = (one, other) if observed[one] <= observed[other] else (other, one)
            replacement[old] = kept
    if replacement:
        last = [follow_merges(point) for point in replacement.values()]
        slam_map.replace(found.new_tensor(list(replacement)), found.new_tensor(last))
