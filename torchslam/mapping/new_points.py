"""New map points and their fusion with known ones.

A keyframe is matched along epipolar lines with covisible keyframes; matches are triangulated and checked. Fusion
associates map points with covisible keyframes and merges duplicates.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchslam.config import Config
from torchslam.features import match_by_projection
from torchslam.geometry import (
    Camera,
    passes_gate,
    se3_inverse,
    transform,
    triangulate,
    triangulation_covariance,
)
from torchslam.map.map import NO_POINT, Map
from torchslam.map.observation_index import first_of_each
from torchslam.tracking.data_association import predict_observations
from torchslam.tracking.matcher import (
    DescriptorMatcher,
    FreeKeypoints,
    match_along_epipolar_lines,
    max_distance,
    run_matcher,
)
from torchslam.types import FrameFeatures, Matcher, MatchPrior

MIN_BASELINE = 0.01
"""Least baseline to a keyframe, relative to the median depth there. Tried at this value only."""
MAX_EPIPOLAR_PX = 2.0
"""Largest distance of a match from its epipolar line, pixels at the finest pyramid level. Tried at this value only."""
MIN_PARALLAX_DEG = 1.0
"""Least parallax of a new point, degrees. Tried at this value only."""
RADIUS_PX = 3.0
"""Search radius around the projection in fusion, at the finest pyramid level."""


def triangulate_against(
    slam_map: Map,
    keyframe: int,
    neighbors: Int[Tensor, " K"],
    camera: Camera,
    config: Config,
    matcher: Matcher | None = None,
    normalize: Callable[[Tensor], Tensor] | None = None,
) -> None:
    """Add new points that a keyframe and its neighbors observe with enough parallax.

    If a keypoint makes points with several neighbors, the first one counts. Without a custom matcher, descriptors are
    matched along epipolar lines. `normalize` is a faster equivalent of `camera.normalize`.
    """
    neighbors = neighbors[has_baseline(slam_map, keyframe, neighbors, MIN_BASELINE)]
    if len(neighbors) == 0:
        return
    here, there = (
        FreeKeypoints.of(slam_map, rows, normalize or camera.normalize)
        for rows in (slam_map.index_tensor(keyframe), neighbors)
    )
    T_21 = slam_map.T_cw[neighbors] @ se3_inverse(slam_map.T_cw[keyframe])
    if matcher is None or isinstance(matcher, DescriptorMatcher):
        limit = max_distance(here.features.descriptors, config.matching)
        matches = match_along_epipolar_lines(here, there, T_21, camera, MAX_EPIPOLAR_PX, limit)
        found = NewPointMatches(*matches, None)
    else:
        views = [free_view(slam_map, row) for row in (keyframe, *neighbors.tolist())]
        priors = [MatchPrior(T_21=each, camera=camera, epipolar_px=MAX_EPIPOLAR_PX) for each in T_21]
        found = match_each(matcher, views, here, there, priors)
    _triangulate(slam_map, keyframe, neighbors, here, there, found, camera)


class NewPointMatches(NamedTuple):
    """Matches of a keyframe: index of the neighbor, rows of free keypoints of both, and weights."""

    which: Int[Tensor, " M"]
    at_1: Int[Tensor, " M"]
    at_2: Int[Tensor, " M"]
    weights: Float[Tensor, " M"] | None

    def select(self, rows: Int[Tensor, " R"]) -> NewPointMatches:
        """Some of the matches, by index."""
        weights = None if self.weights is None else self.weights[rows]
        return NewPointMatches(self.which[rows], self.at_1[rows], self.at_2[rows], weights)


def _triangulate(
    slam_map: Map,
    keyframe: int,
    neighbors: Tensor,
    here: FreeKeypoints,
    there: FreeKeypoints,
    found: NewPointMatches,
    camera: Camera,
) -> None:
    """Triangulate matches and add the points that pass all checks."""
    T_1w, T_2w = slam_map.T_cw[keyframe], slam_map.T_cw[neighbors][found.which]
    seen_1, seen_2 = (0, found.at_1, None), (found.which, found.at_2, None)
    pixels = here.features.keypoints[seen_1], there.features.keypoints[seen_2]
    normalized = here.normalized[seen_1], there.normalized[seen_2]
    scale_1, scale_2 = here.features.scales[seen_1], there.features.scales[seen_2]
    seen = triangulate(*pixels, T_1w=T_1w, T_2w=T_2w, camera_1=camera, camera_2=camera, normalized=normalized)
    noise_1, noise_2 = here.noise[seen_1], there.noise[seen_2]
    good = seen.mask
    for T_cw, noise, seen_at in ((T_1w, noise_1, pixels[0]), (T_2w, noise_2, pixels[1])):
        points_c = transform(T_cw, seen.points_w)
        good &= passes_gate(noise.squared_reprojection(points_c, seen_at, camera))
    good &= seen.angles > math.radians(MIN_PARALLAX_DEG)
    sizes = tuple(size[found.which] for size in slam_map.scale_ranges(neighbors))
    good &= has_consistent_scale(seen.points_w, T_1w, T_2w, scale_1, scale_2, sizes)
    keep = torch.nonzero(good)[:, 0]
    keep = keep[first_of_each(found.at_1[keep])]
    points_w = seen.points_w[keep]
    spread_1, spread_2 = (noise[keep].sigma_or_covariance for noise in (noise_1, noise_2))
    covariances_w = triangulation_covariance(T_1w, T_2w[keep], points_w, spread_1, spread_2, camera, camera)
    found = found.select(keep)
    descriptors = here.features.descriptors[0, found.at_1]
    ids = slam_map.add_points(points_w[:, 0], descriptors, keyframe, covariances_w[:, 0])
    observing: tuple[int | Tensor, Tensor] = keyframe, neighbors[found.which]
    seen_rows = here.rows[0, found.at_1], there.rows[found.which, found.at_2]
    for keyframes, rows in zip(observing, seen_rows, strict=True):
        slam_map.add_observations(keyframes, rows, ids)
        if found.weights is not None:
            slam_map.scale_information(keyframes, rows, found.weights)


def free_view(slam_map: Map, keyframe: int) -> FrameFeatures:
    """Return the features of a keyframe, masked to keypoints that observe no point."""
    view = slam_map.frame_features(keyframe)
    return replace(view, mask=view.mask & (slam_map.keyframes["point_ids"][keyframe] == NO_POINT))


def match_each(
    matcher: Matcher,
    views: list[FrameFeatures],
    here: FreeKeypoints,
    there: FreeKeypoints,
    priors: list[MatchPrior],
) -> NewPointMatches:
    """Match the first view with each of the others, like `match_along_epipolar_lines`."""
    parts, weights = [], []
    for row, (view, prior) in enumerate(zip(views[1:], priors, strict=True)):
        pairs = run_matcher(matcher, views[0], view, prior)
        at_1, at_2 = slots_among(here.rows[0])[pairs.first], slots_among(there.rows[row])[pairs.second]
        order = torch.argsort(at_1 * len(view.mask) + at_2)
        parts.append(torch.stack([torch.full_like(at_1, row), at_1, at_2])[:, order])
        weights += [] if pairs.weights is None else [pairs.weights[order]]
    which, at_1, at_2 = torch.cat(parts, dim=1)
    return NewPointMatches(which, at_1, at_2, torch.cat(weights) if len(weights) == len(parts) else None)


def slots_among(rows: Int[Tensor, " N"]) -> Int[Tensor, " R"]:
    """Return the position of each keypoint among rows, arbitrary for missing ones."""
    found = torch.zeros(int(rows.max()) + 1 if len(rows) else 1, dtype=torch.int64, device=rows.device)
    return found.index_put((rows.flip(0),), torch.arange(len(rows), device=rows.device).flip(0))


def has_baseline(
    slam_map: Map, keyframe: int, neighbors: Int[Tensor, " K"], least: float
) -> Bool[Tensor, " K"]:
    """Return whether the baseline to neighbors is at least a ratio of the neighbor's median depth."""
    T_1w, T_2w = slam_map.T_cw[keyframe], slam_map.T_cw[neighbors]
    seen = slam_map.keyframes["point_ids"][neighbors]
    depths = transform(T_2w, slam_map.positions_w[seen])[..., 2]
    depth = depths.masked_fill(seen == NO_POINT, torch.nan).nanmedian(-1).values
    apart = se3_inverse(T_1w)[:3, 3] - se3_inverse(T_2w)[:, :3, 3]
    return torch.linalg.vector_norm(apart, dim=-1) > least * depth


def has_consistent_scale(
    points_w: Float[Tensor, "*#batch N 3"],
    T_1w: Float[Tensor, "*#batch 4 4"],
    T_2w: Float[Tensor, "*#batch 4 4"],
    scale_1: Float[Tensor, "*#batch N"],
    scale_2: Float[Tensor, "*#batch N"],
    scale_range: tuple[Float[Tensor, "*#batch #N"], ...],
) -> Bool[Tensor, "*#batch N"]:
    """Return whether the scales in two images agree with the distances of the points, up to a factor of 1.8.

    Scales are in pixels; `scale_range` is the finest and the coarsest one of the second image.
    """
    distance_1 = torch.linalg.vector_norm(transform(T_1w, points_w), dim=-1)
    distance_2 = torch.linalg.vector_norm(transform(T_2w, points_w), dim=-1)
    expected = (scale_1 * distance_1 / distance_2.clamp(min=1e-12)).clamp(*scale_range)
    return (scale_2 < 1.8 * expected) & (scale_2 * 1.8 > expected)


def fuse(
    slam_map: Map, here: Int[Tensor, " K"], there: Int[Tensor, " L"], camera: Camera, config: Config
) -> None:
    """Match the points of two sets of keyframes in each other, and merge duplicates."""
    for keyframes, others in ((here, there), (there, here)):
        points = slam_map.observed_points(others)
        merge_points(slam_map, *match_in_keyframes(slam_map, keyframes, points, camera, config))


def match_in_keyframes(
    slam_map: Map, keyframes: Int[Tensor, " K"], point_ids: Int[Tensor, " N"], camera: Camera, config: Config
) -> tuple[Int[Tensor, " M"], Int[Tensor, " M"]]:
    """Match points by projection into keyframes that do not observe them yet.

    Matches with free keypoints become observations. Returns the other matches as pairs of duplicate points:
    the matched point and the one that the keypoint already observes.
    """
    if len(keyframes) == 0 or len(point_ids) == 0:
        return point_ids[:0], point_ids[:0]
    table, points = slam_map.keyframes, slam_map.points
    features = slam_map.features(keyframes)
    T_cw, sizes = slam_map.T_cw[keyframes], slam_map.scale_ranges(keyframes)
    pixels, scales, visible = predict_observations(slam_map, point_ids, T_cw, camera, sizes)
    visible &= ~slam_map.observation_mask(keyframes, point_ids)
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
    errors = slam_map.keypoint_noise(keyframe, keypoint).squared(
        pixels[which, row] - table["keypoints"][keyframe, keypoint]
    )
    agrees = passes_gate(errors)
    ids, keyframe, keypoint = ids[agrees], keyframe[agrees], keypoint[agrees]
    taken = table["point_ids"][keyframe, keypoint]
    is_free = taken < 0
    slam_map.add_observations(keyframe[is_free], keypoint[is_free], ids[is_free])
    return ids[~is_free], taken[~is_free]


def merge_points(slam_map: Map, found: Int[Tensor, " M"], there: Int[Tensor, " M"]) -> None:
    """Merge pairs of points; of each group of duplicates the point with most observations stays."""
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
        slam_map.merge_points(found.new_tensor(list(replacement)), found.new_tensor(last))
