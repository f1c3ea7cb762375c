"""New map points from two keyframes: matches along epipolar lines, triangulated and checked."""

from __future__ import annotations

import math

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
from torchslam.values import Features, View
from torchslam.world.map import NO_POINT, Map


def triangulate_against(slam_map: Map, keyframe: int, neighbour: int, camera: Camera, config: Config) -> None:
    """Add the points that two keyframes see with enough parallax and that neither has in the map yet."""
    settings = config.mapping
    T_1w, T_2w = slam_map.T_cw[keyframe], slam_map.T_cw[neighbour]
    if not has_baseline(slam_map, keyframe, neighbour, settings.min_baseline):
        return
    view_1, view_2 = slam_map.view(keyframe), slam_map.view(neighbour)
    free_1 = torch.nonzero(view_1.mask & (slam_map.keyframes["point_ids"][keyframe] == NO_POINT))[:, 0]
    free_2 = torch.nonzero(view_2.mask & (slam_map.keyframes["point_ids"][neighbour] == NO_POINT))[:, 0]
    T_21 = T_2w @ se3_inverse(T_1w)
    first, second = match_along_epipolar_lines(
        view_1, view_2, free_1, free_2, T_21, camera, settings.epipolar_px, config.matching
    )
    seen = triangulate(T_1w, T_2w, view_1.keypoints[first], view_2.keypoints[second], camera, camera)
    scale_1, scale_2 = view_1.scales[first], view_2.scales[second]
    limit = config.measurement.chi_square
    good = seen.mask & fits(seen.errors_1**2, scale_1, limit) & fits(seen.errors_2**2, scale_2, limit)
    good &= seen.angles > math.radians(settings.min_parallax_deg)
    good &= has_consistent_scale(seen.points_w, T_1w, T_2w, scale_1, scale_2, view_2.scale_range)
    keep = torch.nonzero(good)[:, 0]
    points_w = seen.points_w[keep]
    covariances_w = triangulation_covariance(
        T_1w, T_2w, points_w, scale_1[keep], scale_2[keep], camera, camera
    )
    ids = slam_map.add_points(points_w, view_1.descriptors[first[keep]], keyframe, covariances_w)
    slam_map.observe(keyframe, first[keep], ids)
    slam_map.observe(neighbour, second[keep], ids)


def has_baseline(slam_map: Map, keyframe: int, neighbour: int, least: float) -> bool:
    """Whether the two are apart by a share of the median depth that the neighbour sees."""
    T_1w, T_2w = slam_map.T_cw[keyframe], slam_map.T_cw[neighbour]
    seen = slam_map.points_seen_by(slam_map.ids(neighbour))
    depth = transform(T_2w, slam_map.positions_w[seen])[:, 2].median()
    baseline = torch.linalg.vector_norm(se3_inverse(T_1w)[:3, 3] - se3_inverse(T_2w)[:3, 3])
    return bool(baseline > least * depth)


def match_along_epipolar_lines(
    view_1: View,
    view_2: View,
    rows_1: Tensor,
    rows_2: Tensor,
    T_21: Tensor,
    camera: Camera,
    epipolar_px: float,
    settings: MatchingConfig,
) -> tuple[Tensor, Tensor]:
    """(m,), (m,) keypoints among rows_1 (n1,) and rows_2 (n2,) that are each other's best on the epipolar line.

    The distance to the epipolar plane is the sine of an angle; a pixel is 1 / focal length of it.
    """
    if len(rows_1) == 0 or len(rows_2) == 0:
        return rows_1[:0], rows_2[:0]
    essential = skew(T_21[:3, 3]) @ T_21[:3, :3]
    planes = camera.unproject(view_1.keypoints[rows_1]) @ essential.mT
    planes = planes / torch.linalg.vector_norm(planes, dim=-1, keepdim=True).clamp(min=1e-12)
    rays_2 = camera.unproject(view_2.keypoints[rows_2])
    sine = (planes.float() @ rays_2.float().mT).abs()
    allowed = sine < (epipolar_px / camera.focal * view_2.scales[rows_2]).float()
    matches = match(
        features_of(view_1, rows_1),
        features_of(view_2, rows_2),
        ratio=None,
        max_distance=0.8 * max_distance(view_1.descriptors, settings),
        allowed=allowed[None],
    )
    found = matches.mask[0]
    return rows_1[matches.indices_1[0][found]], rows_2[matches.indices_2[0][found]]


def features_of(view: View, rows: Tensor) -> Features:
    """Some keypoints (n,) of a view as a batch of one, for matching."""
    features = view.features
    return Features(*(getattr(features, name)[:, rows] for name in Features.__dataclass_fields__))


def has_consistent_scale(
    points_w: Tensor,
    T_1w: Tensor,
    T_2w: Tensor,
    scale_1: Tensor,
    scale_2: Tensor,
    scale_range: tuple[float, float],
    factor: float = 1.8,
) -> Tensor:
    """(n,) whether a point's size in the two images agrees with its distances: scale falls as distance grows."""
    distance_1 = torch.linalg.vector_norm(transform(T_1w, points_w), dim=-1)
    distance_2 = torch.linalg.vector_norm(transform(T_2w, points_w), dim=-1)
    expected = (scale_1 * distance_1 / distance_2.clamp(min=1e-12)).clamp(*scale_range)
    return (scale_2 < factor * expected) & (scale_2 * factor > expected)
