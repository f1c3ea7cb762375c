"""What moves by itself is found, followed and left out; the scene is not, and the two are not taken for each other."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.scene import CAMERA, Scene, pose
from torchslam.config import Config
from torchslam.geometry import SharedCamera, se3_inverse
from torchslam.tracking import non_static
from torchslam.tracking.non_static import FRAME_INTERVAL, IndependentMotion, Movement
from torchslam.types import FrameFeatures, PoseEstimate, Reason

SCENE = Scene.of(200)
NEAR = Scene.of(60, seed=1, depth=2.0, width=0.8)  # a thing: a sixth of the image's width
EVERY = FRAME_INTERVAL
DEPTH = 4.0


def camera_at(index: int) -> Tensor:
    """(4, 4) T_cw of a camera that goes to the right and turns a little."""
    return pose(-0.04 * index, 0, 0, 0, 0.004 * index)


def thing_at(index: int, speed: float) -> Tensor:
    """(4, 4) from where the thing was first to where it is now: it falls."""
    return pose(-0.4, -0.3 + speed * index, 0)


def joined(one: FrameFeatures, other: FrameFeatures) -> FrameFeatures:
    """The keypoints of both."""
    columns = ("keypoints", "detected", "scales", "angles", "descriptors", "mask", "information")
    return replace(one, **{name: torch.cat([getattr(one, name), getattr(other, name)]) for name in columns})


def frame(index: int, speed: float = 0.03, thing: Scene = NEAR, scene: Scene = SCENE) -> FrameFeatures:
    """The scene first, then the thing before it, which moves by `speed` a frame."""
    T_cw = camera_at(index)
    behind, before = scene.view(index, T_cw), thing.view(index, T_cw @ thing_at(index, speed))
    box = before.keypoints[before.mask]
    hidden = ((behind.keypoints > box.amin(0)) & (behind.keypoints < box.amax(0))).all(-1)
    return joined(replace(behind, mask=behind.mask & ~hidden), before)


def is_thing(view: FrameFeatures, scene: Scene = SCENE) -> Tensor:
    return torch.arange(len(view.mask)) >= len(scene)


def estimate(view: FrameFeatures, T_cw: Tensor, keypoints: Tensor) -> PoseEstimate:
    return PoseEstimate(T_cw, keypoints, keypoints, len(keypoints), torch.eye(6).double(), DEPTH)


def watcher() -> IndependentMotion:
    return IndependentMotion(SharedCamera(CAMERA), Config())


def watched(
    by: IndependentMotion, views: list[FrameFeatures], T_cw: Tensor | None = None
) -> Iterator[tuple[FrameFeatures, FrameFeatures, Movement]]:
    """Each view, what is left of it, and what is said; the scene is what agrees with the pose."""
    for view in views:
        cleared = by.mask_out(view)
        agrees = torch.nonzero(cleared.mask & ~is_thing(view))[:, 0]
        pose_now = camera_at(view.index) if T_cw is None else T_cw
        yield view, cleared, by.observe(view, estimate(view, pose_now, agrees))


def test_a_moving_object_is_detected_and_masked_out() -> None:
    by = watcher()
    for view, cleared, said in watched(by, [frame(index) for index in range(3 * EVERY)]):
        left_out = view.mask & ~cleared.mask
        assert not (left_out & ~is_thing(view)).float().mean() > 0.02  # some of the scene is next to it
        if view.index == EVERY:
            assert said.note is not None
            assert said.note.reason is Reason.INDEPENDENT_MOTION
            assert 40 <= said.note.values["count"] <= 75
        if view.index <= EVERY:
            assert not left_out.any()
        else:
            assert (left_out & is_thing(view)).sum() > 0.75 * (view.mask & is_thing(view)).sum()
        assert not said.rejection


def test_a_static_object_belongs_to_the_scene() -> None:
    by = watcher()
    for view, cleared, said in watched(by, [frame(index, speed=0.0) for index in range(3 * EVERY)]):
        assert said == Movement()
        assert torch.equal(cleared.mask, view.mask)


@pytest.mark.parametrize("depth", [0.6, 1.0, 20.0])
def test_depth_differences_are_no_motion(depth: float) -> None:
    """Whatever its depth, a point of the scene lies where a point of the scene can be."""
    other = Scene.of(60, seed=2, depth=depth, width=0.4 * depth)
    by = watcher()
    for index in range(2 * EVERY):
        view = joined(SCENE.view(index, camera_at(index)), other.view(index, camera_at(index)))
        by.mask_out(view)
        assert by.observe(view, estimate(view, camera_at(index), torch.arange(50))) == Movement()


def test_the_least_error_decides(monkeypatch: pytest.MonkeyPatch) -> None:
    """A thing that falls by 3 px from look to look is none for a threshold of 4 of its scales, and one of 1."""
    speed = 3.0 / EVERY / 100.0  # 100 px a unit at its depth
    for least, found in ((4.0, False), (0.5, True)):
        monkeypatch.setattr(non_static, "MIN_ERROR", least)
        by = watcher()
        views = [frame(index, speed) for index in range(EVERY + 1)]
        *_, (_, _, said) = watched(by, views)
        assert bool(said.note) is found


def test_too_few_matches_are_no_object(monkeypatch: pytest.MonkeyPatch) -> None:
    few = Scene.of(19, seed=1, depth=2.0, width=0.8)
    for least, found in ((20, False), (15, True)):
        monkeypatch.setattr(non_static, "MIN_MATCHES", least)
        by = watcher()
        *_, (_, _, said) = watched(by, [frame(index, thing=few) for index in range(EVERY + 1)])
        assert bool(said.note) is found


def test_outliers_without_common_motion_are_no_object() -> None:
    """Keypoints that jump about are wrong matches; of what misses the scene, half must move as one."""
    by = watcher()
    for index in range(2 * EVERY):
        view = frame(index)
        jumps = 40 * torch.randn(len(view.mask), 2, generator=torch.Generator().manual_seed(index)).double()
        view = replace(
            view, keypoints=torch.where(is_thing(view)[:, None], view.keypoints + jumps, view.keypoints)
        )
        by.mask_out(view)
        assert not by.observe(view, estimate(view, camera_at(index), torch.arange(50))).note


def test_an_object_is_tracked_while_the_camera_is_lost() -> None:
    by = watcher()
    *_, _ = watched(by, [frame(index) for index in range(2 * EVERY)])
    for index in range(2 * EVERY, 6 * EVERY):
        view = frame(index)
        left_out = view.mask & ~by.mask_out(view).mask
        assert (left_out & is_thing(view)).sum() > 0.8 * (view.mask & is_thing(view)).sum()
        assert (left_out & ~is_thing(view)).sum() < 0.2 * view.mask.sum()


def test_an_object_is_dropped_when_it_has_not_moved_for_long(monkeypatch: pytest.MonkeyPatch) -> None:
    for limit, kept in ((2, False), (100, True)):
        monkeypatch.setattr(non_static, "MAX_UNSEEN_FRAMES", limit)
        by = watcher()
        *_, _ = watched(by, [frame(index) for index in range(EVERY + 1)])
        for index in range(EVERY + 1, EVERY + 4):
            cleared = by.mask_out(frame(index))
        assert bool((~cleared.mask & frame(index).mask).any()) is kept


def test_an_object_is_dropped_when_it_disappears() -> None:
    by = watcher()
    *_, _ = watched(by, [frame(index) for index in range(2 * EVERY)])
    alone = SCENE.view(2 * EVERY, camera_at(2 * EVERY))
    assert torch.equal(by.mask_out(alone).mask, alone.mask)


def test_an_object_larger_than_the_map_makes_the_pose_uncertain() -> None:
    """The map followed the thing: the rest moves against it, in most of the image."""
    by = watcher()
    for index in range(EVERY + 1):
        view = frame(index, speed=0.1)
        cleared = by.mask_out(view)
        T_cw = camera_at(index) @ thing_at(index, 0.1)
        said = by.observe(view, estimate(view, T_cw, torch.nonzero(is_thing(view))[:, 0]))
    assert said.rejection
    assert "move against the map" in str(said.rejection)
    assert torch.equal(cleared.mask, view.mask)
    assert torch.equal(by.mask_out(view).mask, view.mask)


def test_a_map_that_attaches_to_a_moving_object_is_uncertain() -> None:
    by = watcher()
    *_, _ = watched(by, [frame(index) for index in range(2 * EVERY + 1)])
    doubts = []
    for index in range(2 * EVERY + 1, 4 * EVERY + 1):
        view = frame(index)
        by.mask_out(view)
        # The pose is relative to the thing from here on, without a jump.
        T_cw = camera_at(index) @ thing_at(index, 0.03) @ se3_inverse(thing_at(2 * EVERY, 0.03))
        doubts.append(by.observe(view, estimate(view, T_cw, torch.arange(len(SCENE)))).rejection is not None)
    assert any(doubts)


def test_where_most_of_the_image_moves_the_pose_is_uncertain(monkeypatch: pytest.MonkeyPatch) -> None:
    by = watcher()
    *_, (view, _, said) = watched(by, [frame(index) for index in range(EVERY + 1)])
    assert not said.rejection
    cell = torch.nonzero(view.mask & ~is_thing(view))[:1, 0]  # one keypoint agrees with the map
    assert by.observe(view, estimate(view, camera_at(view.index), cell)).rejection
    monkeypatch.setattr(non_static, "MAX_AREA_RATIO", 100.0)
    assert not watcher().observe(view, estimate(view, camera_at(0), cell)).rejection


def test_poses_of_two_submaps_are_not_compared() -> None:
    by = watcher()
    for index in range(2 * EVERY):
        view = frame(index)
        by.mask_out(view)
        is_late = index >= EVERY
        T_cw = camera_at(index) @ pose(3.0 * is_late, 0, 0)
        said = by.observe(view, estimate(view, T_cw, torch.arange(50)), (int(is_late), 0))
        assert said == Movement()


def test_frames_of_another_session_are_not_compared() -> None:
    by = watcher()
    for index in range(EVERY + 1):
        view = replace(frame(index), session=int(index == EVERY))
        by.mask_out(view)
        said = by.observe(view, estimate(view, camera_at(index), torch.arange(50)))
    assert said == Movement()
