"""The frame log: which frames have no final pose, and what changes their status."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from tests.map.simulated import estimate_at
from tests.scene import Scene, pose
from torchslam.map.atlas import TrackingState
from torchslam.system import frame_log
from torchslam.system.frame_log import MAX_UNPOSED_FRAMES, FrameLog, FrameStatus, HeldFrame
from torchslam.tracking.initialization import MAX_REFERENCE_AGE
from torchslam.types import FrameFeatures

SCENE = Scene.of(10)
UNPOSED, HELD, POSED = FrameStatus.UNPOSED, FrameStatus.HELD, FrameStatus.POSED


def view_of(index: int) -> FrameFeatures:
    return SCENE.view(index, pose())


def held_frame(index: int) -> HeldFrame:
    tracking = TrackingState.empty(torch.zeros(1, dtype=torch.float64))
    tracking.T_cr, tracking.reference = pose(0.1 * index), 100 + index
    estimate = estimate_at(pose(index), torch.arange(5), torch.arange(5))
    return HeldFrame.of(view_of(index), estimate, tracking)


def unposed(log: FrameLog, before: int | None = None) -> list[int]:
    return [view.index for view in log.unposed(before)]


SET = {
    UNPOSED: lambda log, index: log.unpose(view_of(index)),
    HELD: lambda log, index: log.hold(held_frame(index)),
    POSED: lambda log, index: log.pose(view_of(index)),
}


def test_a_frame_that_was_never_logged_has_no_status() -> None:
    log = FrameLog()
    log.unpose(view_of(3))
    assert log.status(4) is None
    with pytest.raises(KeyError):
        log.view(4)
    with pytest.raises(KeyError):
        log.take_held([4])


@pytest.mark.parametrize("before", [None, *SET])
@pytest.mark.parametrize("after", SET)
def test_a_frame_changes_its_status_and_is_logged_once(
    before: FrameStatus | None, after: FrameStatus
) -> None:
    log = FrameLog()
    if before is not None:
        SET[before](log, 3)
        assert log.status(3) is before
    SET[after](log, 3)
    assert log.status(3) is after
    assert unposed(log) == ([3] if after is UNPOSED else [])
    assert log.view(3).index == 3


@pytest.mark.parametrize("before", SET)
def test_a_released_frame_is_unposed_again(before: FrameStatus) -> None:
    log = FrameLog()
    SET[before](log, 3)
    SET[before](log, 5)
    log.release([3])
    assert log.status(3) is UNPOSED
    assert log.status(5) is before
    assert torch.equal(log.view(3).keypoints, view_of(3).keypoints)


@pytest.mark.parametrize("status", SET)
def test_a_forgotten_frame_is_gone(status: FrameStatus) -> None:
    log = FrameLog()
    for index in (3, 4):
        SET[status](log, index)
    log.forget([3, 9])  # the other one was never logged
    assert log.status(3) is None
    assert log.status(4) is status


def test_held_frames_are_taken_with_their_poses_in_the_order_asked_for() -> None:
    log = FrameLog()
    frames = {index: held_frame(index) for index in (5, 3, 4, 6)}
    for frame in frames.values():
        log.hold(frame)
    taken = log.take_held([4, 5, 3])
    assert taken == [frames[4], frames[5], frames[3]]
    assert [frame.reference for frame in taken] == [104, 105, 103]
    assert all(torch.equal(frame.T_cr, pose(0.1 * frame.view.index)) for frame in taken)
    assert [log.status(index) for index in (3, 4, 5, 6)] == [None, None, None, HELD]


def test_a_held_frame_keeps_the_pose_of_when_it_was_held() -> None:
    tracking = TrackingState.empty(torch.zeros(1, dtype=torch.float64))
    tracking.T_cr, tracking.reference = pose(1.0), 7
    frame = HeldFrame.of(view_of(0), estimate_at(pose(), torch.arange(5), torch.arange(5)), tracking)
    tracking.T_cr, tracking.reference = pose(2.0), 8
    assert torch.equal(frame.T_cr, pose(1.0))
    assert frame.reference == 7


def test_frames_are_listed_in_the_order_of_their_indices() -> None:
    log = FrameLog()
    log.unpose(*map(view_of, (7, 1, 8, 2)))
    log.hold(held_frame(3))
    log.pose(view_of(5))
    log.unpose(view_of(4))
    assert unposed(log) == [1, 2, 4, 7, 8]
    assert unposed(log, before=4) == [1, 2]
    assert unposed(log, before=5) == [1, 2, 4]
    assert [view.index for view in log.views([8, 3, 5])] == [3, 5, 8]


def test_the_latest_unposed_frames_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(frame_log, "MAX_UNPOSED_FRAMES", 3)
    log = FrameLog()
    log.unpose(*map(view_of, (0, 1, 2, 3)))
    log.unpose(view_of(5))
    assert unposed(log) == [2, 3, 5]
    log.unpose(view_of(4))  # which is later than the earliest
    assert unposed(log) == [3, 4, 5]
    log.unpose(view_of(1))
    assert unposed(log) == [3, 4, 5]


def test_frames_with_which_a_map_may_begin_are_kept() -> None:
    assert MAX_UNPOSED_FRAMES > MAX_REFERENCE_AGE


@pytest.mark.parametrize("status", [HELD, POSED])
def test_frames_with_a_pose_are_not_limited_and_limit_no_others(
    status: FrameStatus, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(frame_log, "MAX_UNPOSED_FRAMES", 2)
    log = FrameLog()
    log.unpose(view_of(0))
    for index in range(1, 8):
        SET[status](log, index)
    log.unpose(view_of(8))
    assert unposed(log) == [0, 8]
    assert all(log.status(index) is status for index in range(1, 8))
    log.release(range(1, 8))
    assert unposed(log) == [7, 8]
    assert log.status(6) is None


@pytest.mark.parametrize(
    "change",
    [
        lambda log: log.unpose(view_of(9)),
        lambda log: log.hold(held_frame(1)),
        lambda log: log.pose(view_of(2)),
        lambda log: log.release([2, 3]),
        lambda log: log.take_held([2]),
        lambda log: log.forget([1, 2, 3]),
    ],
)
def test_a_copy_restores_what_changed_since(change: Callable[[FrameLog], object]) -> None:
    log = FrameLog()
    log.unpose(view_of(1))
    log.hold(held_frame(2))
    log.pose(view_of(3))
    copied = log.copy()

    def statuses(each: FrameLog) -> list[FrameStatus | None]:
        return [each.status(index) for index in (1, 2, 3, 9)]

    change(log)
    assert statuses(log) != [UNPOSED, HELD, POSED, None]
    assert statuses(copied) == [UNPOSED, HELD, POSED, None]
    log.restore(copied)
    assert statuses(log) == [UNPOSED, HELD, POSED, None]
    change(log)
    assert statuses(copied) == [UNPOSED, HELD, POSED, None]
