from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from tests.scene import Scene, sideways, submap_of_scene
from torchslam.map.map import Map
from torchslam.optim import Marginals
from torchslam.types import FrameFeatures

KEYPOINTS = 8


def make_view(index: int, generator: torch.Generator) -> FrameFeatures:
    return FrameFeatures(
        index=index,
        timestamp=0.1 * index,
        keypoints=100 * torch.rand(KEYPOINTS, 2, generator=generator, dtype=torch.float64),
        scales=torch.full((KEYPOINTS,), 1.2, dtype=torch.float64),
        angles=torch.rand(KEYPOINTS, generator=generator, dtype=torch.float64),
        descriptors=torch.randint(0, 256, (KEYPOINTS, 32), generator=generator, dtype=torch.uint8),
        mask=torch.ones(KEYPOINTS, dtype=torch.bool),
    )


def pose(x: float) -> Tensor:
    T_cw = torch.eye(4, dtype=torch.float64)
    T_cw[0, 3] = -x
    return T_cw


def make_map(generator: torch.Generator) -> Map:
    """Three keyframes along x; points 0..3 seen by the first two, 4 and 5 by the last two, each at its own keypoint."""
    slam_map = Map()
    for k in range(3):
        slam_map.add_keyframe(make_view(10 * k, generator), pose(float(k)))
    positions_w = torch.rand(6, 3, generator=generator, dtype=torch.float64) + torch.tensor([0.0, 0.0, 4.0])
    slam_map.add_points(positions_w, torch.zeros(6, 32, dtype=torch.uint8), keyframe=0)
    for keyframe, ids in ((0, [0, 1, 2, 3]), (1, [0, 1, 2, 3, 4, 5]), (2, [4, 5])):
        slam_map.add_observations(keyframe, torch.arange(len(ids)), torch.tensor(ids))
    return slam_map


@pytest.fixture
def small_map(generator: torch.Generator) -> Map:
    return make_map(generator)


def test_observations_are_flat_and_ordered(small_map: Map) -> None:
    seen = small_map.observations()
    assert seen.keyframe_index.tolist() == [0] * 4 + [1] * 6 + [2] * 2
    assert seen.point_index.tolist() == [0, 1, 2, 3, 0, 1, 2, 3, 4, 5, 4, 5]
    assert torch.equal(seen.pixels[4], small_map.keyframes["keypoints"][1, 0])
    assert len(small_map.observations(torch.tensor([2]))) == 2


def test_covisibility(small_map: Map) -> None:
    assert small_map.count_observed(torch.tensor([4, 5, 0])).tolist() == [1, 3, 2]
    assert small_map.count_observed(torch.tensor([4, 5, 0]), torch.tensor([2, 1])).tolist() == [2, 3]
    assert small_map.covisible_keyframes(1, 5, min_shared=1).tolist() == [0, 2]
    assert small_map.covisible_keyframes(1, 5, min_shared=3).tolist() == [0]
    assert small_map.covisible_keyframes(1, 1, min_shared=1).tolist() == [0]
    assert small_map.observed_points(torch.tensor([1, 2])).tolist() == [0, 1, 2, 3, 4, 5]
    assert small_map.points["times_observed"].tolist() == [2] * 6


def test_merged_points_resolve_to_their_final_replacement(small_map: Map) -> None:
    small_map.merge_points(torch.tensor([5]), torch.tensor([4]))
    small_map.merge_points(torch.tensor([4]), torch.tensor([0]))
    assert small_map.follow_merges(torch.tensor([5, 4, 0, 1])).tolist() == [0, 0, 0, 1]


def test_refresh_takes_direction_scale_and_descriptor_from_the_newest_keyframe(small_map: Map) -> None:
    small_map.update_appearance(torch.tensor([1, 0]))
    ray = small_map.positions_w[2] - torch.tensor([1.0, 0.0, 0.0])
    distance = float(ray.norm())
    assert torch.allclose(small_map.points["view_directions_w"][2], ray / distance)
    assert math.isclose(float(small_map.points["scale_distance"][2]), 1.2 * distance)
    assert torch.equal(small_map.points["descriptors"][2], small_map.keyframes["descriptors"][1, 2])


def test_features_are_restored_from_a_keyframe(small_map: Map, generator: torch.Generator) -> None:
    view = make_view(77, generator)
    keyframe = small_map.add_keyframe(view, pose(3.0))
    back = small_map.frame_features(keyframe)
    assert (back.index, back.timestamp) == (view.index, view.timestamp)
    assert torch.equal(back.keypoints, view.keypoints)
    assert torch.equal(back.descriptors, view.descriptors)


def test_covariances_are_stored_and_unknown_ones_are_kept(small_map: Map) -> None:
    frames = torch.eye(6, dtype=torch.float64).repeat(3, 1, 1)
    frames[0] = 0
    points = torch.eye(3, dtype=torch.float64).repeat(2, 1, 1)
    everyone = torch.arange(3)
    small_map.set_covariances(everyone, torch.tensor([4, 1]), Marginals(frames, points, frames[:0]))
    small_map.set_covariances(everyone, torch.tensor([4, 1]), Marginals(0 * frames, 0 * points, frames[:0]))
    assert torch.equal(small_map.keyframes["covariances"], frames)
    assert small_map.points["covariances_w"].diagonal(dim1=1, dim2=2).sum(-1).tolist() == [0, 3, 0, 0, 3, 0]
    torch.testing.assert_close(small_map.center_covariances_w()[1:], points)


def test_the_local_map_unites_the_most_covisible_of_each() -> None:
    slam_map = submap_of_scene(Scene.of(200), sideways(8, step=0.3)).map
    keyframes = torch.tensor([6, 1])
    near = [slam_map.covisible_keyframes(keyframe, 2) for keyframe in keyframes.tolist()]
    assert [len(some) for some in near] == [2, 2]
    assert torch.equal(slam_map.covisibility_union(keyframes, 2), torch.unique(torch.cat([keyframes, *near])))
