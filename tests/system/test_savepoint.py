"""Savepoints: how many certain frames confirm those that are held back, and what a rollback restores."""

from __future__ import annotations

import pytest
import torch

from tests.scene import CAMERA, Scene, assert_same_state, sideways, state_of, submap_of_scene
from torchslam.config import Config
from torchslam.geometry import SharedCamera
from torchslam.map.atlas import Submap
from torchslam.mapping.mapper import Mapper
from torchslam.system import savepoint as savepoints
from torchslam.system.savepoint import Savepoint
from torchslam.tracking.tracker import Tracker
from torchslam.types import Reason, Rejection
from torchslam.utils.timing import Stopwatch

SCENE = Scene.of(200)
DOUBT = Rejection(Reason.PURE_ROTATION)


def savepoint_of(num_confirming: int = 2, submap: Submap | None = None) -> Savepoint:
    return Savepoint(submap or submap_of_scene(SCENE, sideways(3)), num_confirming)


def extended(savepoint: Savepoint, index: int = 3) -> None:
    """Insert a tentative keyframe, which moves the map: it observes, triangulates, fuses, culls and adjusts."""
    submap, view = savepoint.submap, SCENE.view(index, sideways(1, start=0.15 * index)[0], noise=0.7)
    tracker = Tracker(SharedCamera(CAMERA), Config())
    estimate = tracker.track(submap, view)
    assert estimate is not None
    tracker.commit(submap, view, estimate)
    savepoint.save_map()
    keyframe = Mapper(SharedCamera(CAMERA), Config(), Stopwatch()).insert(submap.map, view, estimate)
    tracker.reset_to_keyframe(submap, keyframe)


# --- the countdown ----------------------------------------------------------------------------------------------


def test_nothing_is_held_back_at_first() -> None:
    savepoint = savepoint_of()
    assert savepoint.is_open
    assert not savepoint.is_relocalized
    assert not savepoint.has_keyframes
    assert (savepoint.frames, savepoint.num_certain, savepoint.num_doubtful) == ([], 0, 0)
    assert list(savepoint.keyframes) == []


def test_two_certain_frames_confirm_a_doubtful_one() -> None:
    savepoint = savepoint_of()
    savepoint.count(DOUBT)
    assert savepoint.is_open
    assert str(savepoint.reason) == "to be confirmed by 2 more frames"
    savepoint.count()
    assert savepoint.is_open
    assert str(savepoint.reason) == "to be confirmed by 1 more frames"
    savepoint.count()
    assert not savepoint.is_open
    assert (savepoint.num_certain, savepoint.num_doubtful) == (2, 1)


def test_another_doubtful_frame_restarts_the_count() -> None:
    savepoint = savepoint_of()
    for doubt in (DOUBT, None, DOUBT, None):
        savepoint.count(doubt)
        assert savepoint.is_open
    savepoint.count()
    assert not savepoint.is_open


@pytest.mark.parametrize("num_confirming", [1, 3, 8])
def test_as_many_certain_frames_are_needed_as_the_savepoint_says(num_confirming: int) -> None:
    savepoint = savepoint_of(num_confirming)
    savepoint.count(DOUBT)
    for _ in range(num_confirming):
        assert savepoint.is_open
        savepoint.count()
    assert not savepoint.is_open


def test_without_tentative_keyframes_many_doubtful_frames_need_no_more_certain_ones() -> None:
    savepoint = savepoint_of()
    for _ in range(5):
        savepoint.count(DOUBT)
    assert savepoint.needed == 2


def test_tentative_keyframes_need_as_many_certain_frames_as_there_were_doubtful_ones() -> None:
    savepoint = savepoint_of()
    for _ in range(3):
        savepoint.count(DOUBT)
    savepoint.save_map()
    assert savepoint.needed == 2  # as counted when there were none
    for doubtful in (4, 5):
        savepoint.count(DOUBT)
        assert savepoint.needed == doubtful
    for _ in range(5):
        assert savepoint.is_open
        savepoint.count()
    assert not savepoint.is_open


def test_a_first_doubtful_keyframe_needs_the_usual_number_of_certain_frames() -> None:
    savepoint = savepoint_of(3)
    savepoint.save_map()
    savepoint.count(DOUBT)
    assert savepoint.needed == 3


def test_the_number_of_held_frames_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(savepoints, "MANY_HELD_FRAMES", 2)
    monkeypatch.setattr(savepoints, "MAX_HELD_FRAMES", 3)
    savepoint = savepoint_of()
    for index, (is_long, is_full) in enumerate([(False, False), (True, False), (True, True)]):
        savepoint.frames.append(index)
        assert (savepoint.is_long, savepoint.is_full) == (is_long, is_full)
    savepoint.commit()
    assert not savepoint.is_long
    assert not savepoint.is_full


# --- commit and rollback ----------------------------------------------------------------------------------------


def test_a_rollback_restores_every_byte_of_the_map_and_the_tracking_state() -> None:
    submap = submap_of_scene(SCENE, sideways(3))
    tracker, view = (
        Tracker(SharedCamera(CAMERA), Config()),
        SCENE.view(3, sideways(1, start=0.45)[0], noise=0.7),
    )
    estimate = tracker.track(submap, view)
    assert estimate is not None
    tracker.commit(submap, view, estimate)
    savepoint, mapper = savepoint_of(submap=submap), Mapper(SharedCamera(CAMERA), Config(), Stopwatch())
    savepoint.save_map()
    before = state_of(submap)
    noise_variance = submap.map.noise_variance
    tracker.commit(submap, view, None)  # forgets the motions
    tracker.reset_to_keyframe(submap, mapper.insert(submap.map, view, estimate))
    assert list(savepoint.keyframes) == [3]
    submap.map.noise_variance = 7.0
    with pytest.raises(AssertionError):
        assert_same_state(state_of(submap), before)
    savepoint.rollback()
    assert_same_state(state_of(submap), before)
    assert submap.map.noise_variance == noise_variance
    assert not savepoint.has_keyframes
    assert list(savepoint.keyframes) == []


def test_a_rollback_goes_back_to_before_the_first_tentative_keyframe() -> None:
    savepoint = savepoint_of()
    keys = savepoint.submap.map.keys.clone()
    extended(savepoint, 3)
    extended(savepoint, 4)
    assert list(savepoint.keyframes) == [3, 4]
    savepoint.rollback()
    assert torch.equal(savepoint.submap.map.keys, keys)


def test_without_tentative_keyframes_there_is_nothing_to_restore() -> None:
    """The map may have grown since: what grew is certain."""
    savepoint = savepoint_of()
    submap = savepoint.submap
    view = SCENE.view(3, sideways(1, start=0.45)[0])
    submap.map.add_keyframe(view, sideways(1, start=0.45)[0])
    before = state_of(submap)
    savepoint.rollback()
    assert_same_state(state_of(submap), before)
    assert list(savepoint.keyframes) == []


def test_what_was_committed_is_not_rolled_back() -> None:
    savepoint = savepoint_of()
    savepoint.frames += [3]
    extended(savepoint, 3)
    savepoint.commit()
    assert savepoint.frames == []
    assert not savepoint.has_keyframes
    before = state_of(savepoint.submap)
    savepoint.rollback()
    assert_same_state(state_of(savepoint.submap), before)
    extended(savepoint, 4)
    assert list(savepoint.keyframes) == [4]
    savepoint.rollback()
    assert savepoint.submap.map.num_keyframes == 4


def test_a_commit_goes_on_counting() -> None:
    savepoint = savepoint_of()
    for doubt in (DOUBT, DOUBT, DOUBT, None):
        savepoint.count(doubt)
    savepoint.commit()
    assert (savepoint.needed, savepoint.num_certain, savepoint.num_doubtful) == (1, 1, 3)
    savepoint.count()
    assert not savepoint.is_open
