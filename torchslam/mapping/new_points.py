"""New map points from a keyframe and its neighbours: matches along epipolar lines, triangulated and checked."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchslam.config import Config, MatchingConfig
from torchslam.features import expand_runs, match_pairs
from torchslam.geometry import (
    Camera,
    Noise,
    fits,
    se3_inverse,
    transform,
    triangulate,
    triangulation_covariance,
)
from torchslam.tracking.correspondences import max_distance
from torchslam.values import Features
from torchslam.world.map import NO_POINT, Map
from torchslam.world.observers import first_of_each


@dataclass(frozen=True)
class FreeKeypoints:
    """The keypoints of k keyframes that see no point yet; where one has fewer than others, rows are masked out.

    features: (k, n, ...); rows: (k, n) of the keyframes' keypoints; normalized: (k, n, 2) undistorted;
    noise: (k, n)
    """

    features: Features
    rows: Tensor
    normalized: Tensor
    noise: Noise

    @classmethod
    def of(cls, slam_map: Map, keyframes: Tensor, camera: Camera) -> FreeKeypoints:
        """Those of keyframes (k,)."""
        table = slam_map.keyframes
        free = table["mask"][keyframes] & (table["point_ids"][keyframes] == NO_POINT)
        free, rows = torch.sort(free, dim=1, descending=True, stable=True)
        free = free[:, : int(free.sum(1).max())]
        rows = rows[:, : free.shape[1]]
        features = replace(slam_map.features(keyframes, rows), mask=free)
        noise = slam_map.noise(keyframes[:, None], rows)
        return cls(features, rows, camera.normalize(features.keypoints), noise)


def triangulate_against(
    slam_map: Map, keyframe: int, neighbours: Tensor, camera: Camera, config: Config
) -> None:
    """Add the points that a keyframe and neighbours (k,) see with enough parallax and that the map does not have yet.

    Of several neighbours with which a keypoint makes a point the first one counts.
    """
    settings, limit = config.mapping, config.measurement.chi_square
    neighbours = neighbours[has_baseline(slam_map, keyframe, neighbours, settings.min_baseline)]
    if len(neighbours) == 0:
        return
    here = FreeKeypoints.of(slam_map, slam_map.ids(keyframe), camera)
    there = FreeKeypoints.of(slam_map, neighbours, camera)
    T_1w, T_2w = slam_map.T_cw[keyframe], slam_map.T_cw[neighbours]
    which, at_1, at_2 = match_along_epipolar_lines(
        here, there, T_2w @ se3_inverse(T_1w), camera, settings.epipolar_px, config.matching
    )
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


def has_baseline(slam_map: Map, keyframe: int, neighbours: Tensor, least: float) -> Tensor:
    """(k,) whether a keyframe and neighbours (k,) are apart by a share of the median depth that the neighbour sees."""
    T_1w, T_2w = slam_map.T_cw[keyframe], slam_map.T_cw[neighbours]
    seen = slam_map.keyframes["point_ids"][neighbours]
    depths = transform(T_2w, slam_map.positions_w[seen])[..., 2]
    depth = depths.masked_fill(seen == NO_POINT, torch.nan).nanmedian(-1).values
    apart = se3_inverse(T_1w)[:3, 3] - se3_inverse(T_2w)[:, :3, 3]
    return torch.linalg.vector_norm(apart, dim=-1) > least * depth


def match_along_epipolar_lines(
    here: FreeKeypoints,
    there: FreeKeypoints,
    T_21: Tensor,
    camera: Camera,
    epipolar_px: float,
    settings: MatchingConfig,
) -> tuple[Tensor, Tensor, Tensor]:
    """Keypoints of one keyframe and of k others that are each other's best on the epipolar line.

    T_21: (k, 4, 4) from the one camera to the others. Returns for every match (m,) which of the others it is with, and
    the rows in `here` and `there`, ordered by these three.

    The distance to the epipolar plane is the sine of an angle; a pixel is 1 / focal length of it. All these planes
    contain the baseline, so that a plane is an angle around it.
    """
    rays_1 = pad(here.normalized, (0, 1), value=1.0) @ T_21[:, :3, :3].mT
    (angles_1, _), (angles_2, sines) = (
        around(T_21[:, :3, 3], rays) for rays in (rays_1, pad(there.normalized, (0, 1), value=1.0))
    )
    width = epipolar_px / camera.focal * there.features.scales / sines.clamp(min=1e-12)
    width = torch.where(width < 1, torch.asin(width.clamp(max=1.0)), math.pi)
    # A number per angle and neighbour, each a turn below and above as well: a window may reach over the end of a turn.
    offset = 6 * math.pi * torch.arange(len(T_21), device=width.device)[:, None]
    turns = 2 * math.pi * torch.arange(-1, 2, device=width.device)
    keys, order = (angles_1[..., None] + offset[..., None] + turns).flatten().sort(stable=True)
    left, right = (torch.searchsorted(keys, angles_2 + offset + sign * width) for sign in (-1, 1))
    column, place = expand_runs(left.flatten(), torch.where(there.features.mask, right, left).flatten())
    count, descriptors = angles_1.shape[1], here.features.descriptors
    row, column = match_pairs(
        descriptors.expand(len(T_21), *descriptors.shape[1:]).flatten(0, 1),
        there.features.descriptors.flatten(0, 1),
        order[place] // 3,
        column,
        0.8 * max_distance(descriptors, settings),
    )
    return row // count, row % count, column % width.shape[1]


def around(axes: Tensor, rays: Tensor) -> tuple[Tensor, Tensor]:
    """(k, n), (k, n) angles of rays (k, n, 3) around axes (k, 3), radians, and the sines of their angles to these."""
    least = torch.nn.functional.one_hot(axes.abs().argmin(-1), 3).to(axes.dtype)
    across = torch.nn.functional.normalize(torch.linalg.cross(axes, least), dim=-1)
    other = torch.linalg.cross(torch.nn.functional.normalize(axes, dim=-1), across)
    x, y = (rays @ torch.stack((across, other), dim=-1)).unbind(-1)
    return torch.atan2(y, x), torch.hypot(x, y) / torch.linalg.vector_norm(rays, dim=-1)


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
