"""Who is held back, for how long, and what is given free again."""

from __future__ import annotations

import pytest
import torch

from tests.map.simulated import tracked_at
from tests.scene import Scene, pose
from torchslam.config import Config, load_config
from torchslam.map.atlas import TrackingState
from torchslam.tracking.pose_confirmation import PoseConfirmation
from torchslam.types import FrameFeatures, PoseEstimate

SCENE = Scene.of(10)


def frame(index: int) -> tuple[FrameFeatures, PoseEstimate, TrackingState]:
    tracking = TrackingState.empty(torch.zeros(1, dtype=torch.float64))
    tracking.T_cr, tracking.reference = pose(0.1 * index), 100 + index
    return SCENE.view(index, pose()), tracked_at(pose(index), torch.arange(5), torch.arange(5)), tracking


def test_nothing_is_held_at_first() -> None:
    probation = PoseConfirmation(Config())
    assert not probation
    assert not probation.is_relocalized
    assert probation.views() == []


def test_two_certain_frames_confirm_a_doubtful_one() -> None:
    probation = PoseConfirmation(Config())
    probation.push(*frame(0), "odd")
    assert probation
    assert probation.reason == "to be confirmed by 2 more frames"
    probation.push(*frame(1), "")
    assert probation
    assert probation.reason == "to be confirmed by 1 more frames"
    probation.push(*frame(2), "")
    assert not probation
    assert not probation.is_relocalized
    assert [view.index for view in probation.views()] == [0, 1, 2]


def test_another_doubt_begins_the_count_again() -> None:
    probation = PoseConfirmation(Config())
    for index, doubt in enumerate(["odd", "", "odd", ""]):
        probation.push(*frame(index), doubt)
        assert probation
    probation.push(*frame(4), "")
    assert not probation


def test_what_came_back_needs_more_confirmations() -> None:
    probation = PoseConfirmation(load_config(None, ["relocalization.num_confirming_frames=3"]))
    probation.start_after_relocalization(*frame(0))
    assert probation
    assert probation.is_relocalized
    assert probation.reason == "to be confirmed by 3 more frames"
    probation.push(*frame(1), "")
    probation.push(*frame(2), "odd")
    assert probation.reason == "to be confirmed by 3 more frames"
    for index in (3, 4):
        probation.push(*frame(index), "")
        assert probation
    probation.push(*frame(5), "")
    assert not probation
    assert [view.index for view in probation.views()] == [0, 1, 2, 3, 4, 5]


def test_coming_back_forgets_what_was_held_before() -> None:
    probation = PoseConfirmation(Config())
    probation.push(*frame(7), "odd")
    probation.start_after_relocalization(*frame(8))
    assert [view.index for view in probation.views()] == [8]


def test_what_is_released_is_what_was_held_with_its_place_in_the_map() -> None:
    probation = PoseConfirmation(Config())
    frames = [frame(index) for index in range(3)]
    probation.start_after_relocalization(*frames[0])
    for held in frames[1:]:
        probation.push(*held, "odd")
    released = probation.confirm()
    assert not probation
    assert probation.views() == []
    assert [one[0] for one in released] == [view for view, _, _ in frames]
    assert [one[1] for one in released] == [estimate for _, estimate, _ in frames]
    assert all(
        torch.equal(one[2], tracking.T_cr) for one, (_, _, tracking) in zip(released, frames, strict=True)
    )
    assert [one[3] for one in released] == [100, 101, 102]


def test_what_is_handed_over_still_has_to_be_confirmed() -> None:
    probation = PoseConfirmation(Config())
    probation.push(*frame(0), "odd")
    probation.push(*frame(1), "")
    assert [held[0].index for held in probation.pop_all()] == [0, 1]
    assert probation.views() == []
    assert probation.reason == "to be confirmed by 1 more frames"
    probation.push(*frame(2), "")
    assert not probation
    assert [held[0].index for held in probation.confirm()] == [2]


def test_what_was_mapped_takes_as_many_certain_frames_as_there_were_doubtful_ones() -> None:
    probation = PoseConfirmation(Config())
    for index in range(5):
        probation.push(*frame(index), "odd", is_mapped=index > 2)
    assert probation.reason == "to be confirmed by 5 more frames"
    for index in range(5, 9):
        probation.push(*frame(index), "", is_mapped=True)
        assert probation
    probation.push(*frame(9), "", is_mapped=True)
    assert not probation
    probation.confirm()
    probation.push(*frame(10), "odd", is_mapped=True)  # who was believed begins anew
    assert probation.reason == "to be confirmed by 2 more frames"


def test_no_more_than_so_many_are_held_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torchslam.tracking.pose_confirmation.MAX_PENDING_FRAMES", 3)
    probation = PoseConfirmation(Config())
    for index in range(3):
        assert not probation.is_full
        probation.push(*frame(index), "odd")
    assert probation.is_full
    probation.pop_all()
    assert not probation.is_full
