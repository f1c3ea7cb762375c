"""Data association: views with views, map points with views, and the selection and weighting of matches for a pose.

Mature points come first, and the matches of a pose are spread evenly over the image.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchslam.config import MatchingConfig
from torchslam.features import match
from torchslam.features.matching.by_projection import PROJECTION_RATIO
from torchslam.features.selection import ranks_within
from torchslam.geometry import Camera, transform
from torchslam.map.map import Map
from torchslam.tracking.matcher import DescriptorMatcher, max_distance, run_matcher
from torchslam.types import FrameFeatures, Matcher, MatchIndices, MatchPrior
from torchslam.utils.indexing import is_among

MAX_VIEW_ANGLE_DEG = 60.0
"""Largest angle between the current and the last viewing direction of a point, degrees: ORB-SLAM's. Tried at this value
only."""
GRID = (8, 6)
"""Columns and rows of the image cells: squares at 4:3, 80 px wide at 640 x 480. Tried at this value only."""
MAX_MATCHES_PER_CELL = 5
"""Matches of a cell that RANSAC samples from: 240 in all, so that a textured corner does not decide. Tried at this
value only."""
MAX_CELL_WEIGHT = 8
"""Largest sum of the weights of the matches in a cell, in weights of one match; for the same reason. Tried at this
value only."""
MIN_COVERAGE_CELLS = 5
"""Cells with mature points, of 48, below which no coverage ratio is computed: it would be 0, 1 or near. Tried at this
value only."""
MATURE_OBSERVATIONS = 10
"""Frames with certain poses that found a point, from which on it is mature: a third of a second at 30 Hz, by when
it has passed the culling of recent points. Tried at this value only."""


@dataclass(frozen=True)
class Projected:
    """Map points predicted to be visible: their rows, predicted pixels and scales, and their last angles, radians."""

    ids: Int[Tensor, " N"]
    pixels: Float[Tensor, "N 2"]
    scales: Float[Tensor, " N"]
    angles: Float[Tensor, " N"]


def match_views(
    view_1: FrameFeatures, view_2: FrameFeatures, settings: MatchingConfig
) -> tuple[Int[Tensor, " M"], Int[Tensor, " M"]]:
    """Keypoints of two views that match by their descriptors: mutual, by ratio, one to one."""
    pairs = run_matcher(DescriptorMatcher(settings), view_1, view_2)
    return pairs.first, pairs.second


def project_points(
    slam_map: Map,
    ids: Int[Tensor, " M"],
    T_cw: Float[Tensor, "4 4"],
    camera: Camera,
    scale_range: tuple[float, float],
) -> Projected:
    """The valid points in front of the camera, in the image and seen from a similar direction as before.

    Predicted scales are clamped to `scale_range`, the scales of the detector.
    """
    pixels, scales, visible = predict_observations(slam_map, ids, T_cw, camera, scale_range)
    kept = torch.nonzero(visible)[:, 0]
    ids = ids[kept]
    return Projected(ids, pixels[kept], scales[kept], slam_map.points["angles"][ids])


def predict_observations(
    slam_map: Map,
    ids: Int[Tensor, " N"],
    T_cw: Float[Tensor, "*batch 4 4"],
    camera: Camera,
    scale_range: tuple[float, float] | tuple[Float[Tensor, "*batch 1"], Float[Tensor, "*batch 1"]],
) -> tuple[Float[Tensor, "*batch N 2"], Float[Tensor, "*batch N"], Bool[Tensor, "*batch N"]]:
    """Predicted pixels, scales and visibility of points in cameras; `scale_range` as in `project_points`."""
    points = slam_map.points
    positions_w = points["positions_w"][ids]
    pixels, valid = camera.project(transform(T_cw, positions_w))
    rays_w = positions_w + (T_cw[..., :3, :3].mT @ T_cw[..., :3, 3:]).mT
    distance = torch.linalg.vector_norm(rays_w, dim=-1).clamp(min=1e-12)
    cosine = (rays_w * points["view_directions_w"][ids]).sum(-1) / distance
    least = math.cos(math.radians(MAX_VIEW_ANGLE_DEG))
    valid &= points["is_valid"][ids]  # the local map may contain points that were removed since
    scales = (points["scale_distance"][ids] / distance).clamp(*scale_range)
    return pixels, scales, valid & camera.in_image(pixels) & (cosine > least)


def match_projected_points(
    slam_map: Map, projected: Projected, view: FrameFeatures, radius_px: float | Tensor, matcher: Matcher
) -> MatchIndices:
    """Point ids and keypoints that match within a radius around the projection, one to one.

    The radius, or that of each point, is in pixels of the pyramid level that is predicted for it.
    """
    if len(projected.ids) == 0:
        return MatchIndices(projected.ids, projected.ids)
    expected = FrameFeatures(
        view.index,
        view.timestamp,
        keypoints=projected.pixels,
        scales=projected.scales,
        angles=projected.angles,
        descriptors=slam_map.points["descriptors"][projected.ids],
        mask=torch.ones_like(projected.ids, dtype=torch.bool),
        session=view.session,
    )
    pairs = run_matcher(matcher, expected, view, MatchPrior(radius_px * projected.scales, PROJECTION_RATIO))
    return replace(pairs, first=projected.ids[pairs.first])


def match_points(
    slam_map: Map, ids: Int[Tensor, " N"], view: FrameFeatures, settings: MatchingConfig
) -> MatchIndices:
    """Point ids and keypoints that match by descriptor alone, in the whole image."""
    if len(ids) == 0:
        return MatchIndices(ids, ids)
    limit = max_distance(view.descriptors, settings)
    matches = match(slam_map.point_features(ids), view.features, settings.max_ratio, max_distance=limit)
    found = matches.mask[0]
    return MatchIndices(ids[matches.indices_1[0][found]], matches.indices_2[0][found])


def match_keyframe(slam_map: Map, keyframe: int, view: FrameFeatures, matcher: Matcher) -> MatchIndices:
    """Points of a keyframe and keypoints of a view, matched by the keyframe's own descriptors."""
    seen = slam_map.frame_features(keyframe)
    point_ids = slam_map.keyframes["point_ids"][keyframe]
    pairs = run_matcher(matcher, replace(seen, mask=seen.mask & (point_ids >= 0)), view)
    return replace(pairs, first=point_ids[pairs.first])


def cell_numbers(pixels: Float[Tensor, "N 2"], size: tuple[int, int]) -> Int[Tensor, " N"]:
    """Numbers of the cells of `GRID` that contain pixels; `size`: width and height of the image, pixels."""
    column, row = (
        (at / extent * count).clamp_(0, count - 1).long()
        for at, extent, count in zip(pixels.unbind(-1), size, GRID, strict=True)
    )
    return row * GRID[0] + column


def _count_in_cells(cells: Int[Tensor, " N"]) -> Int[Tensor, " C"]:
    return torch.bincount(cells, minlength=GRID[0] * GRID[1])


def select_mature(times_found: Int[Tensor, " N"], least: int) -> Int[Tensor, " M"]:
    """Rows of the matches with mature points; all rows if these are fewer than `least`."""
    old = torch.nonzero(times_found >= MATURE_OBSERVATIONS)[:, 0]
    return old if len(old) >= least else torch.arange(len(times_found), device=times_found.device)


def subsample_per_cell(pixels: Float[Tensor, "N 2"], size: tuple[int, int]) -> Int[Tensor, " M"]:
    """Ascending rows of pixels, at most `MAX_MATCHES_PER_CELL` of each image cell."""
    ranks = ranks_within(cell_numbers(pixels, size), GRID[0] * GRID[1])
    return torch.nonzero(ranks < MAX_MATCHES_PER_CELL)[:, 0]


def grid_weights(pixels: Float[Tensor, "N 2"], size: tuple[int, int]) -> Float[Tensor, " N"]:
    """Weights of matches that limit the total weight of a crowded image cell."""
    cell = cell_numbers(pixels, size)
    return (MAX_CELL_WEIGHT / _count_in_cells(cell)[cell].float()).clamp(max=1.0)


def explained_ratio(view: FrameFeatures, keypoints: Int[Tensor, " M"], size: tuple[int, int]) -> float:
    """Ratio of the image cells with several keypoints that contain at least one of `keypoints`, the inliers."""
    occupied = _count_in_cells(cell_numbers(view.keypoints[view.mask], size)) >= 2
    used = _count_in_cells(cell_numbers(view.keypoints[keypoints], size)) > 0
    return float(used[occupied].double().mean()) if bool(occupied.any()) else 1.0


def coverage_ratio(
    slam_map: Map, expected: Projected, seen: Int[Tensor, " M"], size: tuple[int, int]
) -> float:
    """Ratio of the image cells with several expected mature points in which at least a fifth of them are inliers.

    It is 1 if there are fewer than `MIN_COVERAGE_CELLS` such cells; `seen` are the ids of the inliers.
    """
    old = slam_map.points["times_found"][expected.ids] >= MATURE_OBSERVATIONS
    cell = cell_numbers(expected.pixels[old], size)
    predicted, found = _count_in_cells(cell), _count_in_cells(cell[is_among(expected.ids[old], seen)])
    counted = predicted >= 2
    if int(counted.sum()) < MIN_COVERAGE_CELLS:
        return 1.0
    return float((5 * found >= predicted)[counted].double().mean())
