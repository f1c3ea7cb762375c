"""Who is held back, for how long, and what is given free again."""

from __future__ import annotations

import pytest
import torch

from tests.map.simulated import estimate_at
from tests.scene import Scene, pose
from torchslam.config import Config, load_config
from torchslam.map.atlas import TrackingState
from torchslam.tracking.pose_validation import PoseConfirmation
from torchslam.types import FrameFeatures, PoseEstimate, Reason, Rejection

SCENE = Scene.of(10)
ODD = Rejection(Reason.PURE_ROTATION)


def frame(index: int) -> tuple[FrameFeatures, PoseEstimate, TrackingState]:
    tracking = TrackingState.empty(torch.zeros(1, dtype=torch.float64))
    tracking.T_cr, tracking.reference = pose(0.1 * index), 100 + index
    return SCENE.view(index, pose()), estimate_at(pose(index), torch.arange(5), torch.arange(5)), tracking


def test_nothing_is_pending_at_first() -> None:
    confirmation = PoseConfirmation(Config())
    assert not confirmation.is_holding
    assert not confirmation.is_relocalized
    assert confirmation.views() == []


def test_two_certain_frames_confirm_an_uncertain_one() -> None:
    confirmation = PoseConfirmation(Config())
    confirmation.push(*frame(0), ODD)
    assert confirmation.is_holding
    assert str(confirmation.reason) == "to be confirmed by 2 more frames"
    confirmation.push(*frame(1), None)
    assert confirmation.is_holding
    assert str(confirmation.reason) == "to be confirmed by 1 more frames"
    confirmation.push(*frame(2), None)
    assert not confirmation.is_holding
    assert not confirmation.is_relocalized
    assert [view.index for view in confirmation.views()] == [0, 1, 2]


def test_another_uncertain_frame_restarts_the_count() -> None:
    confirmation = PoseConfirmation(Config())
    for index, doubt in enumerate([ODD, None, ODD, None]):
        confirmation.push(*frame(index), doubt)
        assert confirmation.is_holding
    confirmation.push(*frame(4), None)
    assert not confirmation.is_holding


def test_relocalized_frames_need_more_confirmations() -> None:
    confirmation = PoseConfirmation(load_config(None, ["relocalization.num_confirming_frames=3"]))
    confirmation.start_after_relocalization(*frame(0))
    assert confirmation.is_holding
    assert confirmation.is_relocalized
    assert str(confirmation.reason) == "to be confirmed by 3 more frames"
    confirmation.push(*frame(1), None)
    confirmation.push(*frame(2), ODD)
    assert str(confirmation.reason) == "to be confirmed by 3 more frames"
    for index in (3, 4):
        confirmation.push(*frame(index), None)
        assert confirmation.is_holding
    confirmation.push(*frame(5), None)
    assert not confirmation.is_holding
    assert [view.index for view in confirmation.views()] == [0, 1, 2, 3, 4, 5]


def test_relocalization_discards_pending_frames() -> None:
    confirmation = PoseConfirmation(Config())
    confirmation.push(*frame(7), ODD)
    confirmation.start_after_relocalization(*frame(8))
    assert [view.index for view in confirmation.views()] == [8]


def test_confirmed_frames_keep_their_submap_and_reference() -> None:
    confirmation = PoseConfirmation(Config())
    frames = [frame(index) for index in range(3)]
    confirmation.start_after_relocalization(*frames[0])
    for held in frames[1:]:
        confirmation.push(*held, ODD)
    released = confirmation.confirm()
    assert not confirmation.is_holding
    assert confirmation.views() == []
    assert [one[0] for one in released] == [view for view, _, _ in frames]
    assert [one[1] for one in released] == [estimate for _, estimate, _ in frames]
    assert all(
        torch.equal(one[2], tracking.T_cr) for one, (_, _, tracking) in zip(released, frames, strict=True)
    )
    assert [one[3] for one in released] == [100, 101, 102]


def test_popped_frames_still_have_to_be_confirmed() -> None:
    confirmation = PoseConfirmation(Config())
    confirmation.push(*frame(0), ODD)
    confirmation.push(*frame(1), None)
    assert [held[0].index for held in confirmation.pop_all()] == [0, 1]
    assert confirmation.views() == []
    assert str(confirmation.reason) == "to be confirmed by 1 more frames"
    confirmation.push(*frame(2), None)
    assert not confirmation.is_holding
    assert [held[0].index for held in confirmation.confirm()] == [2]


def test_mapped_frames_need_as_many_certain_frames_as_were_uncertain() -> None:
    confirmation = PoseConfirmation(Config())
    for index in range(5):
        confirmation.push(*frame(index), ODD, is_mapped=index > 2)
    assert str(confirmation.reason) == "to be confirmed by 5 more frames"
    for index in range(5, 9):
        confirmation.push(*frame(index), None, is_mapped=True)
        assert confirmation.is_holding
    confirmation.push(*frame(9), None, is_mapped=True)
    assert not confirmation.is_holding
    confirmation.confirm()
    confirmation.push(*frame(10), ODD, is_mapped=True)  # who was believed begins anew
    assert str(confirmation.reason) == "to be confirmed by 2 more frames"


def test_the_number_of_pending_frames_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torchslam.tracking.pose_validation.MAX_PENDING_FRAMES", 3)
    confirmation = PoseConfirmation(Config())
    for index in range(3):
        assert not confirmation.is_full
        confirmation.push(*frame(index), ODD)
    assert confirmation.is_full
    confirmation.pop_all()
    assert not confirmation.is_full
