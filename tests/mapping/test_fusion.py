"""Points that are one become one, and no others."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from tests.scene import CAMERA, Scene, rows_of, sideways, submap_of_scene
from torchslam.config import Config
from torchslam.geometry import se3_inverse, transform
from torchslam.map.atlas import Submap
from torchslam.map.map import NO_POINT, Map
from torchslam.mapping.new_points import fuse, match_in_keyframes, merge_points

SCENE = Scene.of(200)
ROWS = rows_of(SCENE)


def submap(count: int = 3) -> Submap:
    return submap_of_scene(SCENE, sideways(count))


def free(slam_map: Map, keyframe: int, count: int) -> tuple[Tensor, Tensor]:
    """Let a keyframe forget some points that all keyframes see; returns their rows and keypoints."""
    table = slam_map.keyframes["point_ids"]
    everywhere = slam_map.points["times_observed"] == slam_map.num_keyframes
    at = torch.nonzero((table[keyframe] >= 0) & everywhere[table[keyframe].clamp(min=0)])[:count, 0]
    points = table[keyframe, at].clone()
    slam_map.remove_observations(torch.full_like(at, keyframe), at)
    return points, at


def double(slam_map: Map, keyframe: int, count: int) -> tuple[Tensor, Tensor]:
    """Let a keyframe see some points as points of their own; returns the rows of the originals and of the doubles."""
    points, at = free(slam_map, keyframe, count)
    doubles = slam_map.add_points(
        slam_map.positions_w[points], slam_map.points["descriptors"][points], keyframe
    )
    slam_map.add_observations(keyframe, at, doubles)
    slam_map.update_appearance(torch.arange(slam_map.num_keyframes))
    return points, doubles


def test_a_free_keypoint_is_matched_to_a_projected_point() -> None:
    here = submap()
    points, at = free(here.map, 2, 6)
    before = here.map.points["times_observed"].clone()
    found, there = match_in_keyframes(here.map, torch.tensor([2]), points, CAMERA, Config())
    assert len(found) == len(there) == 0
    assert torch.equal(here.map.keyframes["point_ids"][2, at], points)
    assert torch.equal(here.map.points["times_observed"][points], before[points] + 1)


def test_several_keyframes_at_once_equal_one_after_the_other() -> None:
    together, apart = submap(4), submap(4)
    for here in (together, apart):
        points, _ = free(here.map, 3, 6)
        double(here.map, 2, 6)
        free(here.map, 1, 9)
    points = together.map.observed_points(torch.arange(4))
    found = match_in_keyframes(together.map, torch.tensor([3, 1, 2]), points, CAMERA, Config())
    one_by_one = [
        match_in_keyframes(apart.map, torch.tensor([k]), points, CAMERA, Config()) for k in (3, 1, 2)
    ]
    for pairs, wanted in zip(found, zip(*one_by_one, strict=True), strict=True):
        assert torch.equal(pairs, torch.cat(wanted))
    assert torch.equal(together.map.keyframes["point_ids"], apart.map.keyframes["point_ids"])
    assert len(found[0]) >= 6


def test_an_observed_point_is_not_searched() -> None:
    here = submap()
    seen = here.map.observed_points(torch.tensor([1]))
    before = here.map.keyframes["point_ids"].clone()
    assert len(match_in_keyframes(here.map, torch.tensor([1]), seen, CAMERA, Config())[0]) == 0
    assert torch.equal(here.map.keyframes["point_ids"], before)


def test_a_keypoint_of_another_point_gives_a_duplicate_pair() -> None:
    here = submap()
    points, doubles = double(here.map, 2, 6)
    table = here.map.keyframes["point_ids"].clone()
    found, there = match_in_keyframes(here.map, torch.tensor([2]), points, CAMERA, Config())
    assert dict(zip(found.tolist(), there.tolist(), strict=True)) == dict(
        zip(points.tolist(), doubles.tolist(), strict=True)
    )
    assert torch.equal(here.map.keyframes["point_ids"], table)


@pytest.mark.parametrize(("offset", "agrees"), [(2.4, True), (2.5, False)])
def test_a_projection_must_match_within_the_keypoint_scale(offset: float, agrees: bool) -> None:
    here = submap()
    points, at = free(here.map, 2, 6)
    T_cw = here.map.T_cw[2]
    points_c = transform(T_cw, here.map.positions_w[points])
    scales = here.map.keyframes["scales"][2, at]
    points_c[:, 0] += offset * scales * points_c[:, 2] / 200.0
    here.map.points["positions_w"][points] = transform(se3_inverse(T_cw), points_c)
    match_in_keyframes(here.map, torch.tensor([2]), points, CAMERA, Config())
    assert bool((here.map.keyframes["point_ids"][2, at] == points).all()) is agrees
    assert bool((here.map.keyframes["point_ids"][2, at] == NO_POINT).all()) is not agrees


@pytest.mark.parametrize(("factor", "found"), [(1.4, True), (1.6, False), (0.72, True), (0.6, False)])
def test_a_keypoint_must_have_the_expected_scale(factor: float, found: bool) -> None:
    here = submap()
    points, at = free(here.map, 2, 40)
    middle = (here.map.keyframes["scales"][2, at] - 1.7).abs() < 0.15  # far from the ends of the scales
    points, at = points[middle], at[middle]
    assert len(at) > 3
    here.map.points["scale_distance"][points] *= factor
    match_in_keyframes(here.map, torch.tensor([2]), points, CAMERA, Config())
    assert bool((here.map.keyframes["point_ids"][2, at] == points).all()) is found
    assert bool((here.map.keyframes["point_ids"][2, at] == NO_POINT).all()) is not found


@pytest.mark.parametrize("keyframe_row", [0, 2])
def test_duplicates_are_found_from_either_keyframe(keyframe_row: int) -> None:
    """Keyframe 2 has points of its own that the other two see as others: from either side, they are merged."""
    here = submap()
    points, doubles = double(here.map, 2, 10)
    others = torch.tensor([keyframe for keyframe in range(3) if keyframe != keyframe_row])
    fuse(here.map, others, here.map.index_tensor(keyframe_row), CAMERA, Config())
    assert torch.equal(here.map.follow_merges(doubles), points)
    assert not here.map.points["is_valid"][doubles].any()
    assert (here.map.points["times_observed"][points] == 3).all()


def test_free_keypoints_of_both_keyframes_gain_observations() -> None:
    for keyframe in (0, 1):
        here = submap()
        points, at = free(here.map, 1, 10)
        fuse(here.map, torch.tensor([1 - keyframe]), torch.tensor([keyframe]), CAMERA, Config())
        assert torch.equal(here.map.keyframes["point_ids"][1, at], points)


def observed(*times: int) -> Map:
    """Points that so many keyframes see."""
    scene = Scene.of(len(times))
    slam_map = Map()
    for index in range(max(times)):
        slam_map.add_keyframe(scene.view(index, sideways(1)[0]), sideways(1)[0])
    slam_map.add_points(scene.points_w, scene.descriptors, 0)
    for point, count in enumerate(times):
        for keyframe in range(count):
            slam_map.add_observations(keyframe, torch.tensor([point]), torch.tensor([point]))
    return slam_map


def merged(times: tuple[int, ...], *pairs: tuple[int, int]) -> list[int]:
    slam_map = observed(*times)
    merge_points(slam_map, *torch.tensor(pairs).T)
    return slam_map.follow_merges(torch.arange(len(times))).tolist()


def test_the_most_observed_point_is_kept() -> None:
    assert merged((3, 2), (0, 1)) == [0, 0]
    assert merged((2, 3), (0, 1)) == [1, 1]
    assert merged((2, 2), (0, 1)) == [1, 1]  # of equals the one that was there
    assert merged((2, 2), (1, 0)) == [0, 0]


def test_chains_of_duplicates_merge_into_one_point() -> None:
    assert merged((2, 3, 4), (0, 1), (1, 2)) == [2, 2, 2]
    assert merged((2, 3, 4), (1, 2), (0, 1)) == [2, 2, 2]
    assert merged((4, 2, 3), (1, 2), (1, 0), (2, 0)) == [0, 0, 0]
    assert merged((3, 3, 3, 2), (0, 1), (1, 0)) == [1, 1, 2, 3]


def test_without_duplicates_nothing_changes() -> None:
    slam_map = observed(2, 3)
    merge_points(slam_map, torch.arange(0), torch.arange(0))
    merge_points(slam_map, torch.tensor([1]), torch.tensor([1]))
    assert slam_map.points["is_valid"].all()
    assert math.isclose(float(slam_map.points["times_observed"].sum()), 5)
