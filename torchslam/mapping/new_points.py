"""New map points from a keyframe and its neighbours: matches along epipolar lines, triangulated and checked."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchslam.config import Config, MatchingConfig
from torchslam.features import match
from torchslam.geometry import (
    Camera,
    fits,
    se3_inverse,
    skew,
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

    features: (k, n, ...); rows: (k, n) of the keyframes' keypoints; normalized: (k, n, 2) undistorted
    """

    features: Features
    rows: Tensor
    normalized: Tensor

    @classmethod
    def of(cls, slam_map: Map, keyframes: Tensor, camera: Camera) -> FreeKeypoints:
        """Those of keyframes (k,)."""
        table = slam_map.keyframes
        free = table["mask"][keyframes] & (table["point_ids"][keyframes] == NO_POINT)
        free, rows = torch.sort(free, dim=1, descending=True, stable=True)
        free = free[:, : int(free.sum(1).max())]
        rows = rows[:, : free.shape[1]]
        features = slam_map.features(keyframes, rows)
        return cls(features, rows, camera.normalize(features.keypoints))


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
    good = seen.mask & fits(seen.errors_1**2, scale_1, limit) & fits(seen.errors_2**2, scale_2, limit)
    good &= seen.angles > math.radians(settings.min_parallax_deg)
    sizes = tuple(size[which] for size in slam_map.scale_ranges(neighbours))
    good &= has_consistent_scale(seen.points_w, T_1w, T_2w, scale_1, scale_2, sizes)
    keep = torch.nonzero(good)[:, 0]
    keep = keep[first_of_each(at_1[keep])]
    points_w = seen.points_w[keep]
    covariances_w = triangulation_covariance(
        T_1w, T_2w[keep], points_w, scale_1[keep], scale_2[keep], camera, camera
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

    The distance to the epipolar plane is the sine of an angle; a pixel is 1 / focal length of it.
    """
    essential = skew(T_21[:, :3, 3]) @ T_21[:, :3, :3]
    planes = _unit(torch.nn.functional.pad(here.normalized, (0, 1), value=1.0) @ essential.mT)
    rays_2 = _unit(torch.nn.functional.pad(there.normalized, (0, 1), value=1.0))
    sine = (planes.float() @ rays_2.float().mT).abs_()
    width = (epipolar_px / camera.focal * there.features.scales).float()
    count, features = len(T_21), here.features
    expanded = Features(
        *(getattr(features, name).expand(count, *x.shape[1:]) for name, x in vars(features).items())
    )
    matches = match(
        expanded,
        there.features,
        ratio=None,
        max_distance=0.8 * max_distance(features.descriptors, settings),
        allowed=sine < width[:, None, :],
    )
    which, row = torch.nonzero(matches.mask, as_tuple=True)
    return which, row, matches.indices_2[which, row]


def _unit(vectors: Tensor) -> Tensor:
    """Vectors (..., 3), not zero, at unit length."""
    return vectors / torch.linalg.vector_norm(vectors, dim=-1, keepdim=True).clamp(min=1e-12)


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
