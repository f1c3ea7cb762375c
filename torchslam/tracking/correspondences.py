"""Data association with the configured thresholds: views with views, map points with views."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchslam.config import MatchingConfig
from torchslam.features import match
from torchslam.geometry import Camera, transform
from torchslam.map.map import Map
from torchslam.tracking.matcher import DescriptorMatcher, max_distance, run_matcher
from torchslam.types import FrameFeatures, Matcher, MatchIndices, MatchPrior


@dataclass(frozen=True)
class Projected:
    """Map points predicted to be visible: ids (n,), pixels (n, 2), predicted scales (n,), last observed angles (n,)."""

    ids: Tensor
    pixels: Tensor
    scales: Tensor
    angles: Tensor


def match_views(
    view_1: FrameFeatures, view_2: FrameFeatures, settings: MatchingConfig
) -> tuple[Tensor, Tensor]:
    """(m,), (m,) keypoints of two views that match by their descriptors: mutual, by ratio, one to one."""
    pairs = run_matcher(DescriptorMatcher(settings), view_1, view_2)
    return pairs.first, pairs.second


def project_points(
    slam_map: Map,
    ids: Tensor,
    T_cw: Tensor,
    camera: Camera,
    max_view_angle_deg: float,
    scale_range: tuple[float, float],
) -> Projected:
    """The valid points of ids (n,) in front of the camera, in the image and seen from a similar direction as before.

    Predicted scales are clamped to `scale_range`, the scales of the detector.
    """
    pixels, scales, visible = predict_observations(
        slam_map, ids, T_cw, camera, max_view_angle_deg, scale_range
    )
    kept = torch.nonzero(visible)[:, 0]
    ids = ids[kept]
    return Projected(ids, pixels[kept], scales[kept], slam_map.points["angles"][ids])


def predict_observations(
    slam_map: Map,
    ids: Tensor,
    T_cw: Tensor,
    camera: Camera,
    max_view_angle_deg: float,
    scale_range: tuple[float, float] | tuple[Tensor, Tensor],
) -> tuple[Tensor, Tensor, Tensor]:
    """Predicted pixels (..., n, 2), scales (..., n) and visibility (..., n) of points (n,) in cameras (..., 4, 4).

    Args:
        scale_range: as in `project_points`, numbers or (..., 1)
    """
    points = slam_map.points
    positions_w = points["positions_w"][ids]
    pixels, valid = camera.project(transform(T_cw, positions_w))
    rays_w = positions_w + (T_cw[..., :3, :3].mT @ T_cw[..., :3, 3:]).mT
    distance = torch.linalg.vector_norm(rays_w, dim=-1).clamp(min=1e-12)
    cosine = (rays_w * points["view_directions_w"][ids]).sum(-1) / distance
    least = math.cos(math.radians(max_view_angle_deg))
    valid &= points["is_valid"][ids]  # the local map may contain points that were removed since
    scales = (points["scale_distance"][ids] / distance).clamp(*scale_range)
    return pixels, scales, valid & camera.in_image(pixels) & (cosine > least)


def match_projected_points(
    slam_map: Map,
    projected: Projected,
    view: FrameFeatures,
    radius_px: float,
    matcher: Matcher,
    ratio: float | None,
) -> MatchIndices:
    """Point ids and keypoints that match within a radius around the projection, one to one.

    The radius is in pixels of the pyramid level that is predicted for the point.
    """
    if len(projected.ids) == 0:
        return MatchIndices(projected.ids, projected.ids)
    expected = expected_view(slam_map, projected, view)
    pairs = run_matcher(matcher, expected, view, MatchPrior(radius_px * projected.scales, ratio))
    return replace(pairs, first=projected.ids[pairs.first])


def expected_view(slam_map: Map, projected: Projected, view: FrameFeatures) -> FrameFeatures:
    """Projected map points as a view, with their predicted pixels and scales and their last descriptors."""
    return FrameFeatures(
        view.index,
        view.timestamp,
        keypoints=projected.pixels,
        scales=projected.scales,
        angles=projected.angles,
        descriptors=slam_map.points["descriptors"][projected.ids],
        mask=torch.ones_like(projected.ids, dtype=torch.bool),
        session=view.session,
    )


def match_points(slam_map: Map, ids: Tensor, view: FrameFeatures, settings: MatchingConfig) -> MatchIndices:
    """Point ids and keypoints that match by descriptor alone, in the whole image."""
    if len(ids) == 0:
        return MatchIndices(ids, ids)
    matches = match(
        slam_map.point_features(ids),
        view.features,
        ratio=settings.max_ratio,
        mutual=True,
        max_distance=max_distance(view.descriptors, settings),
    )
    found = matches.mask[0]
    return MatchIndices(ids[matches.indices_1[0][found]], matches.indices_2[0][found])


def match_keyframe(slam_map: Map, keyframe: int, view: FrameFeatures, matcher: Matcher) -> MatchIndices:
    """Points of a keyframe and keypoints of a view, matched by the keyframe's own descriptors."""
    seen = slam_map.frame_features(keyframe)
    point_ids = slam_map.keyframes["point_ids"][keyframe]
    pairs = run_matcher(matcher, replace(seen, mask=seen.mask & (point_ids >= 0)), view)
    return replace(pairs, first=point_ids[pairs.first])
