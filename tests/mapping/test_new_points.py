"""New points from two keyframes: who matches, which of them become points, and how certain they are."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.scene import CAMERA, Scene, pose, rows_of, sideways, submap_of_scene
from torchslam.config import Config, MatchingConfig
from torchslam.geometry import KeypointNoise, se3_inverse, so3_exp, transform, triangulation_covariance
from torchslam.map.map import Map
from torchslam.mapping import new_points
from torchslam.mapping.new_points import has_baseline, has_consistent_scale, triangulate_against
from torchslam.tracking.matcher import (
    FreeKeypoints,
    angle_around_axis,
    match_along_epipolar_lines,
    max_distance,
)
from torchslam.types import FrameFeatures

SCENE = Scene.of(300)
ROWS = rows_of(SCENE)


def map_of_half_the_points(T_cw: Tensor, noise: float = 0.0) -> Map:
    """Keyframes at T_cw that know every other point of the scene."""
    return submap_of_scene(SCENE, T_cw, noise=noise, seen=torch.arange(300) % 2 == 0).map


def triangulated(slam_map: Map, keyframe: int = 1, neighbors: tuple[int, ...] = (0,)) -> Tensor:
    """(n,) rows of the points that a keyframe and its neighbors make."""
    before = len(slam_map.points)
    triangulate_against(slam_map, keyframe, torch.tensor(neighbors), CAMERA, Config())
    return torch.arange(before, len(slam_map.points))


def shown(slam_map: Map, keyframe: int, points: Tensor) -> Tensor:
    """(n,) which points of the scene a keyframe sees as points of the map."""
    table = slam_map.keyframes["point_ids"][keyframe]
    at = torch.stack([torch.nonzero(table == point)[0, 0] for point in points])
    return SCENE.shows(int(slam_map.keyframes["frame_index"][keyframe]))[at]


def test_unmatched_keypoints_of_both_keyframes_are_triangulated() -> None:
    slam_map = map_of_half_the_points(sideways(2, step=0.4))
    new = triangulated(slam_map)
    one, two = shown(slam_map, 1, new), shown(slam_map, 0, new)
    assert torch.equal(one, two)
    assert (one % 2 == 1).all()
    torch.testing.assert_close(slam_map.positions_w[new], SCENE.points_w[one], atol=1e-8, rtol=0)
    views = [SCENE.view(index, T_cw) for index, T_cw in enumerate(sideways(2, step=0.4))]
    both = views[0].mask[SCENE.at(0)] & views[1].mask[SCENE.at(1)] & (torch.arange(300) % 2 == 1)
    assert len(new) == int(both.sum()) > 80
    assert torch.equal(slam_map.points["descriptors"][new], SCENE.descriptors[one])
    assert (slam_map.points["first_keyframe"][new] == 1).all()
    assert (slam_map.points["times_observed"][new] == 2).all()
    assert len(triangulated(slam_map)) == 0  # they are known now


def test_several_neighbors_at_once_equal_one_after_the_other() -> None:
    T_cw = sideways(4, step=0.4)
    together, apart = map_of_half_the_points(T_cw), map_of_half_the_points(T_cw)
    new = triangulated(together, keyframe=3, neighbors=(0, 1, 2))
    for neighbor in (0, 1, 2):
        assert len(triangulated(apart, keyframe=3, neighbors=(neighbor,))) > 0
    assert torch.equal(together.keyframes["point_ids"], apart.keyframes["point_ids"])
    for name in ("positions_w", "covariances_w"):
        torch.testing.assert_close(together.points[name], apart.points[name], atol=1e-9, rtol=1e-6)
    assert len(new) == len(torch.unique(shown(together, 3, new)))


def test_the_first_of_several_neighbors_is_used() -> None:
    slam_map = map_of_half_the_points(sideways(3, step=0.4))
    new = triangulated(slam_map, keyframe=2, neighbors=(0, 1))
    table = slam_map.keyframes["point_ids"]
    alone = triangulated(map_of_half_the_points(sideways(3, step=0.4)), keyframe=2, neighbors=(0,))
    assert torch.isin(new, table[0]).sum() == len(alone) < len(new)
    assert not torch.isin(table[0][table[0] >= new[0]], table[1]).any()


def test_new_points_have_covariances() -> None:
    slam_map = map_of_half_the_points(sideways(2, step=0.4))
    new = triangulated(slam_map)
    scales = []
    for keyframe in (1, 0):
        view = slam_map.frame_features(keyframe)
        scales.append(view.scales[SCENE.at(view.index)[shown(slam_map, keyframe, new)]])
    wanted = triangulation_covariance(
        slam_map.T_cw[1], slam_map.T_cw[0], slam_map.positions_w[new], *scales, CAMERA, CAMERA
    )
    torch.testing.assert_close(slam_map.points["covariances_w"][new], wanted)


def test_points_with_little_parallax_are_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    T_cw = sideways(2, step=0.1)
    slam_map = map_of_half_the_points(T_cw)
    monkeypatch.setattr(new_points, "MIN_BASELINE", 0.001)
    monkeypatch.setattr(new_points, "MIN_PARALLAX_DEG", 1.5)
    new = triangulated(slam_map)
    every = map_of_half_the_points(T_cw)
    monkeypatch.setattr(new_points, "MIN_PARALLAX_DEG", 0)
    all_of_them = triangulated(every)

    def angles(points_w: Tensor) -> Tensor:
        rays = [torch.nn.functional.normalize(points_w - se3_inverse(T)[:3, 3], dim=-1) for T in T_cw]
        return torch.rad2deg((rays[0] * rays[1]).sum(-1).acos())

    wanted = int((angles(every.positions_w[all_of_them]) > 1.5).sum())
    assert 0 < len(new) == wanted < len(all_of_them)


def spoiled(slam_map: Map, keyframe: int, pixels: float, axis: int) -> None:
    """Move all keypoints of a keyframe by pixels in units of their scales."""
    off = pixels * slam_map.keyframes["scales"][keyframe]
    slam_map.keyframes["keypoints"][keyframe, :, axis] += off


@pytest.mark.parametrize(("offset", "good"), [(4.6, True), (5.2, False)])
def test_points_must_reproject_onto_their_keypoints(
    offset: float, good: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Across the epipolar line an error is shared by the two views: each may be off by 2.45 times its scale."""
    slam_map = map_of_half_the_points(sideways(2, step=0.4))
    spoiled(slam_map, 0, offset, 1)
    monkeypatch.setattr(new_points, "MAX_EPIPOLAR_PX", 100)
    new = triangulated(slam_map)
    assert (len(new) > 40) is good
    assert (len(new) == 0) is not good or good


def test_points_with_inconsistent_scales_are_rejected() -> None:
    slam_map = map_of_half_the_points(sideways(2, step=0.4))
    scales, all_of_them = (
        slam_map.keyframes["scales"][1],
        len(triangulated(map_of_half_the_points(sideways(2, step=0.4)))),
    )
    fine = scales < 1.3  # twice that is within the scales of the other view
    scales[fine] *= 2
    new = triangulated(slam_map)
    assert 0 < len(new) < all_of_them
    assert not fine[torch.nonzero(torch.isin(slam_map.keyframes["point_ids"][1], new))[:, 0]].any()


def test_the_baseline_must_be_a_fraction_of_the_depth(monkeypatch: pytest.MonkeyPatch) -> None:
    slam_map = map_of_half_the_points(sideways(2, step=0.4))
    seen = slam_map.observed_points(torch.tensor([0]))
    share = 0.4 / float(slam_map.positions_w[seen, 2].median())
    assert has_baseline(slam_map, 1, torch.tensor([0, 1]), 0.99 * share).tolist() == [True, False]
    assert not has_baseline(slam_map, 1, torch.tensor([0]), 1.01 * share)
    monkeypatch.setattr(new_points, "MIN_BASELINE", 1.01 * share)
    assert len(triangulated(slam_map)) == 0
    monkeypatch.setattr(new_points, "MIN_BASELINE", 0.99 * share)
    assert len(triangulated(slam_map)) > 0


def test_the_median_depth_is_that_of_the_neighbor() -> None:
    T_cw = torch.stack([pose(0, 0, 2.0), pose(0.5, 0, 0)])  # the first stands two meters back
    slam_map = map_of_half_the_points(T_cw)
    seen = slam_map.observed_points(torch.tensor([0]))
    share = math.hypot(0.5, 2.0) / float(slam_map.positions_w[seen, 2].median() + 2.0)
    assert has_baseline(slam_map, 1, torch.tensor([0]), 0.99 * share)
    assert not has_baseline(slam_map, 1, torch.tensor([0]), 1.01 * share)


ALONG = sideways(2, step=0.4)  # epipolar lines are rows of the image


def free(view: FrameFeatures, rows: Tensor) -> FreeKeypoints:
    """Some keypoints (n,) of a view."""
    features = view.features.rows(rows)
    noise = KeypointNoise(view.scales[rows][None], view.information[rows][None])
    return FreeKeypoints(features, rows[None], CAMERA.normalize(features.keypoints), noise)


def run_matcher(
    views: list[FrameFeatures], rows: list[Tensor], T_21: Tensor, epipolar_px: float = 2.0
) -> tuple[Tensor, Tensor]:
    """(m,), (m,) keypoints among some rows of two views that match."""
    one, two = (free(view, some) for view, some in zip(views, rows, strict=True))
    which, at_1, at_2 = match_along_epipolar_lines(
        one, two, T_21[None], CAMERA, epipolar_px, max_distance(one.features.descriptors, MatchingConfig())
    )
    assert not which.any()
    return one.rows[0, at_1], two.rows[0, at_2]


def epipolar(offset: float, limit: float = 2.0, **changes: Tensor) -> tuple[Tensor, Tensor]:
    """Matches of two views, the second with all its keypoints off the line by so many times their scale."""
    views = [SCENE.view(index, T_cw) for index, T_cw in enumerate(ALONG)]
    moved = views[1].keypoints + offset * views[1].scales[:, None] * torch.tensor([0.0, 1.0])
    views[1] = replace(views[1], keypoints=moved, **changes)
    middle = (moved - torch.tensor([159.5, 119.5])).norm(dim=-1) < 60  # where a pixel is 1 / focal length
    rows = [torch.nonzero(mask)[:, 0] for mask in (views[0].mask, views[1].mask & middle)]
    T_21 = ALONG[1] @ se3_inverse(ALONG[0])
    return run_matcher(views, rows, T_21, limit)


def test_matches_lie_on_the_epipolar_line() -> None:
    first, second = epipolar(0.0)
    assert len(first) > 15
    assert torch.equal(SCENE.shows(0)[first], SCENE.shows(1)[second])


@pytest.mark.parametrize("limit", [1.0, 4.0])
def test_the_epipolar_threshold_scales_with_the_keypoint(limit: float) -> None:
    assert len(epipolar(0.98 * limit, limit)[0]) > 15
    assert len(epipolar(1.12 * limit, limit)[0]) == 0


@pytest.mark.parametrize(("bits", "found"), [(51, True), (52, False)])
def test_descriptors_must_match(bits: int, found: bool) -> None:
    """Four fifths of what is allowed elsewhere: 0.8 times 64."""
    other = SCENE.view(1, ALONG[1]).descriptors.clone()
    other[:, : bits // 8] ^= 255
    other[:, 31] ^= (1 << bits % 8) - 1
    assert (len(epipolar(0.0, descriptors=other)[0]) > 15) is found


def test_a_keypoint_is_matched_once() -> None:
    views = [SCENE.view(index, T_cw) for index, T_cw in enumerate(ALONG)]
    twin = torch.nonzero(views[0].mask)[:2, 0]  # two keypoints of the same look in the first view
    keypoints, descriptors = views[0].keypoints.clone(), views[0].descriptors.clone()
    keypoints[twin[1]] = keypoints[twin[0]]
    descriptors[twin[1]] = descriptors[twin[0]]
    descriptors[twin[1], 0] ^= 1
    views[0] = replace(views[0], keypoints=keypoints, descriptors=descriptors)
    rows = [torch.nonzero(view.mask)[:, 0] for view in views]
    T_21 = ALONG[1] @ se3_inverse(ALONG[0])
    first, second = run_matcher(views, rows, T_21)
    assert twin[0] in first
    assert twin[1] not in first
    assert len(torch.unique(second)) == len(second)


def test_empty_sets_have_no_matches() -> None:
    views = [SCENE.view(index, T_cw) for index, T_cw in enumerate(ALONG)]
    rows, empty = torch.arange(10), torch.arange(0)
    for one, other in ((empty, rows), (rows, empty)):
        assert [len(part) for part in run_matcher(views, [one, other], pose(1.0))] == [0, 0]


@pytest.mark.parametrize(
    ("factor", "consistent"), [(1.7, True), (1.9, False), (1 / 1.7, True), (1 / 1.9, False)]
)
def test_keypoint_scale_is_inverse_to_distance(factor: float, consistent: bool) -> None:
    """At a third of the distance, three times the size, within a factor of 1.8."""
    points_w = torch.tensor([[0.0, 0.0, 6.0]]).double()
    ahead = pose(0, 0, -4.0)
    one, size = torch.tensor([1.5]).double(), torch.tensor([4.5 * factor]).double()
    finest, coarsest = torch.tensor([[0.1, 20.0]]).double().unbind(-1)
    sizes = (finest, coarsest)
    assert bool(has_consistent_scale(points_w, pose(), ahead, one, size, sizes)[0]) is consistent
    assert bool(has_consistent_scale(points_w, ahead, pose(), size, one, sizes)[0]) is consistent


def test_scales_beyond_the_pyramid_are_clamped() -> None:
    points_w = torch.tensor([[0.0, 0.0, 6.0]]).double()
    one, two = torch.tensor([1.5]).double(), torch.tensor([2.0]).double()
    finest, coarse, coarser = torch.tensor([[1.0, 2.0, 8.0]]).double().unbind(-1)
    ahead = pose(0, 0, -4.0)
    assert has_consistent_scale(points_w, pose(), ahead, one, two, (finest, coarse)).all()
    assert not has_consistent_scale(points_w, pose(), ahead, one, two, (finest, coarser)).any()
    assert transform(pose(0, 0, -4.0), points_w)[0, 2] == 2.0


def test_angles_around_an_axis() -> None:
    generator = torch.Generator().manual_seed(0)
    axes, rays = (
        torch.randn(*shape, 3, generator=generator, dtype=torch.float64) for shape in ((4,), (4, 9))
    )
    axes[0] = torch.tensor([0.0, 0.0, 2.0])
    angles, sines = angle_around_axis(axes, rays)
    unit, across = (torch.nn.functional.normalize(x, dim=-1) for x in (axes[:, None], rays))
    torch.testing.assert_close(sines, torch.linalg.cross(unit.expand_as(rays), across).norm(dim=-1))
    turn = so3_exp(0.3 * unit[:, 0])
    turned, _ = angle_around_axis(axes, rays @ turn.mT)
    torch.testing.assert_close(torch.remainder(turned - angles, 2 * math.pi), torch.full_like(angles, 0.3))


def test_an_angle_window_wraps_around() -> None:
    """Forwards the planes turn around the middle of the image: all angles occur."""
    ahead = torch.stack([pose(), pose(0, 0, -0.8)])
    views = [SCENE.view(index, T_cw) for index, T_cw in enumerate(ahead)]
    rows = [torch.nonzero(view.mask)[:, 0] for view in views]
    first, second = run_matcher(views, rows, ahead[1])
    shows = SCENE.shows(0)[first]
    assert torch.equal(shows, SCENE.shows(1)[second])
    both = set(SCENE.shows(0)[rows[0]].tolist()) & set(SCENE.shows(1)[rows[1]].tolist())
    assert len(first) == len(both) > 50


def test_keypoints_with_a_point_are_not_matched_again() -> None:
    slam_map = map_of_half_the_points(sideways(3, step=0.3))
    table = slam_map.keyframes["point_ids"]
    known = torch.nonzero(table[0] >= 0)[:40, 0]
    slam_map.remove_observations(
        torch.zeros_like(known), known
    )  # the first keyframe has 40 free keypoints more
    before = table.clone()
    free = FreeKeypoints.of(slam_map, torch.tensor([0, 1]), CAMERA.normalize)
    for row in range(2):
        rows = free.rows[row, free.features.mask[0 + row]]
        assert bool((before[row, rows] < 0).all())
        assert len(rows) == int(((before[row] < 0) & slam_map.keyframes["mask"][row]).sum())
    assert len(triangulated(slam_map, keyframe=2, neighbors=(0, 1))) > 80
    assert torch.equal(table[before >= 0], before[before >= 0])
