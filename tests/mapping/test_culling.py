"""Which keyframes the map can do without, and how many are left of a camera that stays in one place."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from tests.map.simulated import CAMERA, estimate_at, path, view_of
from torchslam.config import Config, KeyframesConfig, load_config
from torchslam.geometry import SharedCamera, se3_exp, se3_inverse
from torchslam.map import compaction
from torchslam.map.atlas import Submap, TrackingState
from torchslam.map.map import Map
from torchslam.mapping.mapper import NUM_NEWEST_KEPT, Mapper, cull_keyframes, is_covered, redundant_keyframes
from torchslam.types import FrameFeatures
from torchslam.utils.timing import Stopwatch

SETTINGS = KeyframesConfig()
POINTS = 20


def cloud() -> Tensor:
    generator = torch.Generator().manual_seed(1)
    return torch.rand(POINTS, 3, generator=generator, dtype=torch.float64) + torch.tensor([-0.5, -0.5, 4.0])


def view_at(index: int, T_cw: Tensor, scale: float = 1.0) -> FrameFeatures:
    view = view_of(index, T_cw, cloud(), torch.Generator().manual_seed(index))
    return FrameFeatures(**{**view.__dict__, "scales": torch.full((POINTS,), scale, dtype=torch.float64)})


def world_of(T_cw: Tensor, scales: list[float] | None = None) -> Submap:
    """Keyframes at T_cw (K, 4, 4) that all see all points, the last one followed."""
    submap = Submap.empty(0, CAMERA.params.double())
    slam_map, everyone = submap.map, torch.arange(POINTS)
    for index, pose in enumerate(T_cw):
        view = view_at(index, pose, scales[index] if scales else 1.0)
        keyframe = slam_map.add_keyframe(view, pose)
        if index == 0:
            slam_map.add_points(cloud(), view.descriptors, 0)
        slam_map.add_observations(keyframe, everyone, everyone)
        seen = estimate_at(pose, everyone, everyone)
        submap.posed_frames.add(view, seen, pose @ se3_inverse(pose), keyframe)
    last = len(T_cw) - 1
    eye = torch.eye(4, dtype=torch.float64)
    no_motion = torch.empty(0, 4, 4), torch.empty(0)
    rows = everyone, slam_map.index_tensor(last), everyone
    submap.tracking = TrackingState(eye, last, POINTS, *no_motion, *rows)
    return submap


def standing(count: int) -> Tensor:
    return torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)


def which(submap: Submap, *candidates: int) -> list[int]:
    return torch.nonzero(redundant_keyframes(submap, torch.tensor(candidates), SETTINGS))[:, 0].tolist()


def test_a_keyframe_is_redundant_when_three_others_see_its_points() -> None:
    assert which(world_of(standing(4)), 2) == [2]
    assert which(world_of(standing(3)), 2) == []
    assert which(world_of(standing(6)), 4, 3, 2, 1) == [2, 3, 4]


def test_coarser_observations_do_not_replace_finer_ones() -> None:
    scales = [2.0, 1.0, 2.0, 2.0, 2.0]
    assert which(world_of(standing(5), scales), 1) == []
    assert which(world_of(standing(5), scales), 2) == [2]
    assert which(world_of(standing(5), [1.2, 1.0, 1.2, 1.2, 1.2]), 1) == [1]  # a level of the pyramid
    assert which(world_of(standing(5), [1.44, 1.0, 1.44, 1.44, 1.44]), 1) == []


def remove_observations_of(slam_map: Map, keyframe: int, count: int) -> None:
    slam_map.remove_observations(torch.full((count,), keyframe), torch.arange(count))


@pytest.mark.parametrize(("missing", "covered"), [(2, True), (3, False)])
def test_nine_of_ten_redundant_points_are_enough(missing: int, covered: bool) -> None:
    submap = world_of(standing(4))
    remove_observations_of(submap.map, 3, missing)
    assert is_covered(submap.map, 1, torch.zeros(4, dtype=torch.bool)) is covered


@pytest.mark.parametrize(("degrees", "near"), [(11.0, True), (13.0, False)])
def test_a_keyframe_with_another_view_direction_is_kept(degrees: float, near: bool) -> None:
    T_cw = standing(4)
    angle = torch.tensor(degrees).deg2rad().double()
    T_cw[2] = se3_exp(torch.tensor([0, 0, 0, 0, 0, 1.0], dtype=torch.float64) * angle)
    assert (which(world_of(T_cw), 2) == [2]) is near


@pytest.mark.parametrize(("share", "near"), [(0.09, True), (0.12, False)])
def test_a_keyframe_at_another_position_is_kept(share: float, near: bool) -> None:
    T_cw = standing(4)
    T_cw[2, 0, 3] = share * float(cloud()[:, 2].median())
    assert (which(world_of(T_cw), 2) == [2]) is near


def test_a_static_camera_keeps_its_first_and_newest_keyframes() -> None:
    submap = world_of(standing(30))
    before = submap.posed_frames.T_cw(submap.map)
    renumbering = cull_keyframes(submap, SETTINGS)
    assert renumbering is not None
    stays = torch.nonzero(renumbering.keyframes >= 0)[:, 0]
    assert stays[0] == 0
    assert stays[-NUM_NEWEST_KEPT:].tolist() == list(range(30 - NUM_NEWEST_KEPT, 30))
    assert submap.map.num_keyframes == len(stays) == NUM_NEWEST_KEPT + 1
    torch.testing.assert_close(submap.posed_frames.T_cw(submap.map), before)
    assert cull_keyframes(submap, SETTINGS) is None  # no new keyframe


def test_a_mapper_culls_keyframes_and_points(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compaction, "MIN_INVALID_ROWS", 5)
    monkeypatch.setattr(compaction, "_MAX_REWRITTEN", 1000)
    submap = world_of(standing(30))
    descriptors = submap.map.points["descriptors"][:1].repeat(40, 1)
    submap.map.remove_points(
        submap.map.add_points(torch.zeros(40, 3, dtype=torch.float64), descriptors, 2)[1:]
    )
    before, left = submap.map.keyframes["frame_index"].clone(), submap.map.positions_w[:21].clone()
    went = Mapper(SharedCamera(CAMERA), Config(), Stopwatch()).cull_and_compact(submap)
    assert went is not None
    assert went.points.tolist() == [*range(21)] + [-1] * 39
    assert torch.equal(submap.map.positions_w, left)
    stays = went.keyframes >= 0
    assert torch.equal(submap.map.keyframes["frame_index"][went.keyframes[stays]], before[stays])
    assert torch.equal(went.replacement[stays], went.keyframes[stays])
    assert int(went.replacement.min()) >= 0
    assert submap.map.num_keyframes < 30
    assert Mapper(SharedCamera(CAMERA), Config(), Stopwatch()).cull_and_compact(submap) is None


def test_culling_waits_for_several_new_keyframes() -> None:
    assert cull_keyframes(world_of(standing(7)), SETTINGS) is None
    submap = world_of(standing(20))
    submap.num_cull_checked = 13
    assert cull_keyframes(submap, SETTINGS) is None


def test_the_reference_keyframe_is_kept() -> None:
    submap = world_of(standing(20))
    submap.tracking.reference = 5
    renumbering = cull_keyframes(submap, SETTINGS)
    assert renumbering is not None
    assert submap.tracking.reference == renumbering.keyframes[5] >= 0


def test_a_moving_camera_keeps_its_keyframes() -> None:
    T_cw = path(200)[::15]
    assert cull_keyframes(world_of(T_cw), SETTINGS) is None


def test_culling_can_be_disabled() -> None:
    keeping = load_config(None, ["paper.last_keyframe=true"])
    assert Mapper(SharedCamera(CAMERA), keeping, Stopwatch()).cull_and_compact(world_of(standing(30))) is None
