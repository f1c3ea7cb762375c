"""New map points from a keyframe and its neighbours: matches along epipolar lines, triangulated and checked."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from torchslam.config import Config
from torchslam.geometry import (
    Camera,
    fits,
    se3_inverse,
    transform,
    triangulate,
    triangulation_covariance,
)
from torchslam.tracking.epipolar import FreeKeypoints, match_along_epipolar_lines
from torchslam.tracking.matcher import DescriptorMatcher, Matcher, Prior, matched, max_distance
from torchslam.values import View
from torchslam.world.map import NO_POINT, Map
from torchslam.world.observers import first_of_each


def triangulate_against(
    slam_map: Map,
    keyframe: int,
    neighbours: Tensor,
    camera: Camera,
    config: Config,
    matcher: Matcher | None = None,
    normalize: Callable[[Tensor], Tensor] | None = None,
) -> None:
    """Add the points that a keyframe and neighbours (k,) see with enough parallax and that the map does not have yet.

    Of several neighbours with which a keypoint makes a point the first one counts.

    matcher:   one of one's own; along epipolar lines, by descriptors, if None
    normalize: a quicker way for `camera.normalize`
    """
    settings, limit = config.mapping, config.measurement.chi_square
    neighbours = neighbours[has_baseline(slam_map, keyframe, neighbours, settings.min_baseline)]
    if len(neighbours) == 0:
        return
    here, there = (
        FreeKeypoints.of(slam_map, rows, normalize or camera.normalize)
        for rows in (slam_map.ids(keyframe), neighbours)
    )
    T_1w, T_2w = slam_map.T_cw[keyframe], slam_map.T_cw[neighbours]
    T_21, weights = T_2w @ se3_inverse(T_1w), None
    if matcher is None or isinstance(matcher, DescriptorMatcher):
        limit_of = max_distance(here.features.descriptors, config.matching)
        which, at_1, at_2 = match_along_epipolar_lines(
            here, there, T_21, camera, settings.epipolar_px, limit_of
        )
    else:
        views = [free_view(slam_map, row) for row in (keyframe, *neighbours.tolist())]
        prior = Prior(T_21=T_21, camera=camera, epipolar_px=settings.epipolar_px)
        which, at_1, at_2, weights = match_each(matcher, views, here, there, prior)
    # From here on every match (m,) is a pair of views of its own, with one point.
    T_2w, seen_1, seen_2 = T_2w[which], (0, at_1, None), (which, at_2, None)
    pixels = here.features.keypoints[seen_1], there.features.keypoints[seen_2]
    normalized = here.normalized[seen_1], there.normalized[seen_2]
    scale_1, scale_2 = here.features.scales[seen_1], there.features.scales[seen_2]
    seen = triangulate(T_1w, T_2w, *pixels, camera, camera, normalized=normalized)
    noise_1, noise_2 = here.noise[seen_1], there.noise[seen_2]
    good = seen.mask
    for T_cw, noise, seen_at in ((T_1w, noise_1, pixels[0]), (T_2w, noise_2, pixels[1])):
        points_c = transform(T_cw, seen.points_w)
        good &= fits(noise.squared_reprojection(points_c, seen_at, camera), limit)
    good &= seen.angles > math.radians(settings.min_parallax_deg)
    sizes = tuple(size[which] for size in slam_map.scale_ranges(neighbours))
    good &= has_consistent_scale(seen.points_w, T_1w, T_2w, scale_1, scale_2, sizes)
    keep = torch.nonzero(good)[:, 0]
    keep = keep[first_of_each(at_1[keep])]
    points_w = seen.points_w[keep]
    covariances_w = triangulation_covariance(
        T_1w, T_2w[keep], points_w, noise_1[keep].spread, noise_2[keep].spread, camera, camera
    )
    which, at_1, at_2 = which[keep], at_1[keep], at_2[keep]
    descriptors = here.features.descriptors[0, at_1]
    ids = slam_map.add_points(points_w[:, 0], descriptors, keyframe, covariances_w[:, 0])
    slam_map.observe(keyframe, here.rows[0, at_1], ids)
    slam_map.observe(neighbours[which], there.rows[which, at_2], ids)
    if weights is not None:
        slam_map.weigh(keyframe, here.rows[0, at_1], weights[keep])
        slam_map.weigh(neighbours[which], there.rows[which, at_2], weights[keep])


def free_view(slam_map: Map, keyframe: int) -> View:
    """What a keyframe saw, of which keypoints that see no point yet may match."""
    view = slam_map.view(keyframe)
    return replace(view, mask=view.mask & (slam_map.keyframes["point_ids"][keyframe] == NO_POINT))


def match_each(
    matcher: Matcher, views: list[View], here: FreeKeypoints, there: FreeKeypoints, prior: Prior
) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
    """As `match_along_epipolar_lines` of the first view with each of the others, by a matcher; and the weights (m,).

    prior: with T_21 (k, 4, 4) to all of the others
    """
    assert prior.T_21 is not None
    parts, weights = [], []
    for row, (view, T_21) in enumerate(zip(views[1:], prior.T_21, strict=True)):
        pairs = matched(matcher, views[0], view, replace(prior, T_21=T_21))
        at_1, at_2 = places(here.rows[0])[pairs.first], places(there.rows[row])[pairs.second]
        order = torch.argsort(at_1 * len(view.mask) + at_2)
        parts.append(torch.stack([torch.full_like(at_1, row), at_1, at_2])[:, order])
        weights += [] if pairs.weights is None else [pairs.weights[order]]
    which, at_1, at_2 = torch.cat(parts, dim=1)
    return which, at_1, at_2, torch.cat(weights) if len(weights) == len(parts) else None


def places(rows: Tensor) -> Tensor:
    """(N,) where each of N keypoints stands among rows (n,), which may leave some out."""
    found = torch.zeros(int(rows.max()) + 1 if len(rows) else 1, dtype=torch.int64, device=rows.device)
    return found.index_put((rows.flip(0),), torch.arange(len(rows), device=rows.device).flip(0))


def has_baseline(slam_map: Map, keyframe: int, neighbours: Tensor, least: float) -> Tensor:
    """(k,) whether a keyframe and neighbours (k,) are apart by a share of the median depth that the neighbour sees."""
    T_1w, T_2w = slam_map.T_cw[keyframe], slam_map.T_cw[neighbours]
    seen = slam_map.keyframes["point_ids"][neighbours]
    depths = transform(T_2w, slam_map.positions_w[seen])[..., 2]
    depth = depths.masked_fill(seen == NO_POINT, torch.nan).nanmedian(-1).values
    apart = se3_inverse(T_1w)[:3, 3] - se3_inverse(T_2w)[:, :3, 3]
    return torch.linalg.vector_norm(apart, dim=-1) > least * depth


def has_consistent_scale(
    points_w: Tensor,
    T_1w: Tensor,
    T_2w: Tensor,
    scale_1: Tensor,
    scale_2: Tensor,
    scale_range: tuple[Tensor, ...],
    factor: float = 1.8,
) -> Tensor:
    """(..., n) whether a point's size in two images agrees with its distances: scale falls as distance grows.

    points_w: (..., n, 3); scale_1, scale_2: (..., n); scale_range: the finest and the coarsest of the second image
    """
    distance_1 = torch.linalg.vector_norm(transform(T_1w, points_w), dim=-1)
    distance_2 = torch.linalg.vector_norm(transform(T_2w, points_w), dim=-1)
    expected = (scale_1 * distance_1 / distance_2.clamp(min=1e-12)).clamp(*scale_range)
    return (scale_2 < factor * expected) & (scale_2 * factor > expected)
