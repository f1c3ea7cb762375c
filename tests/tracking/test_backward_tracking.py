"""Backward tracking: which frames get a pose, where it ends, and the frames without one."""

from __future__ import annotations

from collections.abc import Container
from dataclasses import replace
from itertools import count

import pytest
import torch
from torch import Tensor

from tests.scene import CAMERA, Scene, pose, sideways, submap_of_scene
from torchslam.config import Config, PoseValidationConfig
from torchslam.map.atlas import Atlas, Submap
from torchslam.tracking import backward_tracking
from torchslam.tracking.backward_tracking import (
    MAX_CONSECUTIVE_FAILURES,
    GapLink,
    UnposedFrames,
    track_back,
    track_into_earlier_keyframe,
)
from torchslam.tracking.initialization import ProvisionalMap
from torchslam.tracking.pose_validation import PendingFrame
from torchslam.tracking.tracker import Tracker
from torchslam.types import FrameFeatures, PoseEstimate, Reason, Rejection

SCENE = Scene.of(300)
ODD = Rejection(Reason.PURE_ROTATION)
AWAY = pose(0, 0, 0, 0, 3.0)  # looks back: sees nothing


class Ledger:
    """What was taken or kept, what was mapped on trial, and how often that was dropped."""

    def __init__(self) -> None:
        self.taken: dict[int, Tensor] = {}
        self.tried: list[int] = []
        self.dropped = 0

    def add_frame(self, submap: Submap, view: FrameFeatures, estimate: PoseEstimate) -> None:
        self.taken[view.index] = estimate.T_cw

    def add_tentative(self, submap: Submap, view: FrameFeatures, estimate: PoseEstimate) -> bool:
        self.tried.append(view.index)
        return False

    def commit(self, submap: Submap, held: list[PendingFrame]) -> None:
        for view, estimate, T_cr, reference in held:
            self.taken[view.index] = estimate.T_cw
            torch.testing.assert_close(T_cr @ submap.map.T_cw[reference], estimate.T_cw)

    def rollback(self, submap: Submap) -> None:
        self.dropped += 1


def walked(T_cw: Tensor, judge: PoseValidationConfig | None = None, noise: float = 0.0) -> Ledger:
    """The results of cameras at T_cw (F, 4, 4), the first one before the map's first keyframe, frame 100."""
    submap = submap_of_scene(SCENE, sideways(4), first=100)
    config = replace(Config(), pose_validation=judge or PoseValidationConfig())
    tracker, ledger = Tracker(CAMERA, config), Ledger()
    tracker.reset_to_keyframe(submap, 0)
    views = [SCENE.view(99 - offset, T, noise=noise) for offset, T in enumerate(T_cw)]
    posed = track_back(tracker, submap, views, config, ledger)
    assert [view.index for view in posed] == list(ledger.taken)
    return ledger


def back(
    T_cw: Tensor, judge: PoseValidationConfig | None = None, noise: float = 0.0
) -> tuple[list[int], dict[int, Tensor]]:
    """Frames posed, and where; see `walked`."""
    taken = walked(T_cw, judge, noise).taken
    return list(taken), taken


def doubting(monkeypatch: pytest.MonkeyPatch, doubtful: Container[int]) -> None:
    """The frames that come as these to be judged, from the first on, seem strange."""
    confirming = count()
    monkeypatch.setattr(
        backward_tracking, "check_map_agreement", lambda *_: ODD if next(confirming) in doubtful else None
    )


def test_frames_before_the_map_get_their_true_poses() -> None:
    T_cw = sideways(6, -0.05, start=-0.05)
    posed, poses = back(T_cw)
    assert posed == [99, 98, 97, 96, 95, 94]
    for index, found in poses.items():
        torch.testing.assert_close(found, T_cw[99 - index], atol=1e-7, rtol=0)


def test_a_few_blank_frames_are_skipped() -> None:
    T_cw = sideways(12, -0.02, start=-0.02)
    T_cw[2 : 2 + MAX_CONSECUTIVE_FAILURES - 1] = AWAY
    T_cw[8 : 8 + MAX_CONSECUTIVE_FAILURES - 1] = AWAY
    assert back(T_cw)[0] == [99, 98, 93, 92]


def test_many_blank_frames_end_backward_tracking() -> None:
    T_cw = sideways(10, -0.02, start=-0.02)
    T_cw[1 : 1 + MAX_CONSECUTIVE_FAILURES] = AWAY
    assert back(T_cw)[0] == [99]


def test_frames_with_invalid_poses_are_not_accepted() -> None:
    T_cw = sideways(3, -0.05, start=-0.05)
    assert back(T_cw, noise=0.5)[0] == [99, 98, 97]
    assert back(T_cw, PoseValidationConfig(max_rotation_std_deg=1e-6), noise=0.5)[0] == []


def test_a_jump_from_the_predicted_motion_is_uncertain() -> None:
    T_cw = sideways(4, -0.05, start=-0.05)
    # the first frame has no motion to be compared with; the motion from the first to the third is too large
    judge = PoseValidationConfig(max_jump=0.03)
    T_cw[2:] = sideways(2, -0.05, start=-0.5)
    assert back(T_cw, judge)[0] == [99, 98]


def test_uncertain_frames_are_kept_when_tracking_reaches_the_first_frame(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    doubting(monkeypatch, range(2, 100))
    T_cw = sideways(10, -0.02, start=-0.02)
    ledger = walked(T_cw)
    assert list(ledger.taken) == list(range(99, 89, -1))
    assert ledger.tried == list(range(97, 89, -1))
    assert not ledger.dropped
    torch.testing.assert_close(ledger.taken[90], T_cw[9], atol=1e-7, rtol=0)


def test_uncertain_frames_are_dropped_when_tracking_ends_early(monkeypatch: pytest.MonkeyPatch) -> None:
    doubting(monkeypatch, range(2, 100))
    T_cw = sideways(12, -0.02, start=-0.02)
    T_cw[6 : 6 + MAX_CONSECUTIVE_FAILURES] = AWAY
    ledger = walked(T_cw)
    assert list(ledger.taken) == [99, 98]
    assert ledger.dropped == 1


def test_uncertain_frames_are_kept_after_enough_certain_ones(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    confirming = PoseValidationConfig().num_confirming_frames
    T_cw = sideways(15, -0.02, start=-0.02)
    for certain, posed in ((confirming - 1, [99]), (confirming, list(range(99, 96 - confirming, -1)))):
        doubting(monkeypatch, {1, 2})
        away = T_cw.clone()
        away[3 + certain : 3 + certain + MAX_CONSECUTIVE_FAILURES] = AWAY
        ledger = walked(away)
        assert list(ledger.taken) == posed
        assert ledger.tried == list(range(98, 96 - certain, -1))


def views(*indices: int) -> list[FrameFeatures]:
    return [SCENE.view(index, pose()) for index in indices]


def unposed_frames(limit: int, *indices: int) -> UnposedFrames:
    unposed = UnposedFrames(limit)
    unposed.add(*views(*indices))
    return unposed


def indices(unposed: UnposedFrames) -> list[int]:
    return [view.index for view in unposed]


def test_the_latest_unposed_frames_are_kept_in_order() -> None:
    unposed = unposed_frames(3, 0, 1, 2, 3)
    unposed.add(*views(5))
    assert indices(unposed) == [2, 3, 5]
    assert len(unposed) == 3


def test_frames_are_inserted_in_order() -> None:
    unposed = unposed_frames(10, 1, 2, 7, 8)
    unposed.add(*views(4, 5))
    assert indices(unposed) == [1, 2, 4, 5, 7, 8]


def test_posed_frames_are_removed() -> None:
    unposed = unposed_frames(10, 1, 2, 3, 4)
    unposed.remove(views(2, 4, 9))
    assert indices(unposed) == [1, 3]
    unposed.add()
    assert indices(unposed) == [1, 3]


def test_no_frames_are_kept_when_disabled() -> None:
    assert len(unposed_frames(0, 1, 2)) == 0


def test_a_provisional_map_counts_frames_from_its_initialization() -> None:
    submap = Atlas(CAMERA.params).create()
    provisional = ProvisionalMap(submap, views(0, 1))
    assert provisional.age == 0
    for view in views(2, 3, 4):
        provisional.add_frame(view)
    assert provisional.age == 3
    assert [view.index for view in provisional.views] == [0, 1, 2, 3, 4]
    assert provisional.submap is submap


# --- the keyframe before a gap ------------------------------------------------------------------------------------


def at_a_gap(gap: int, T_earlier: Tensor) -> tuple[Atlas, Submap]:
    """Frames up to 97 - `gap` in a submap of their own, frames from 98 on in another, which is tracked backward."""
    earlier = submap_of_scene(SCENE, T_earlier, first=98 - gap - len(T_earlier) + 1)
    later = submap_of_scene(SCENE, sideways(4), first=98, number=1)
    atlas = Atlas(CAMERA.params)
    atlas._submaps = [earlier, later]
    state = later.fork()
    Tracker(CAMERA, Config()).reset_to_keyframe(state, 0)
    return atlas, state


def link_of(atlas: Atlas, state: Submap, before: int = 98) -> GapLink | None:
    return track_into_earlier_keyframe(Tracker(CAMERA, Config()), state, atlas, before, Config())


def test_the_last_keyframe_before_a_gap_is_tracked_in_the_map_after_it() -> None:
    T_earlier = sideways(3, start=-0.5)
    atlas, state = at_a_gap(1, T_earlier)
    before = state.T_cw.clone()
    link = link_of(atlas, state)
    assert link is not None
    assert link.before == 97
    (after,) = torch.nonzero(state.map.keys == link.after)[:, 0].tolist()
    torch.testing.assert_close(link.T_ba @ state.map.T_cw[after], T_earlier[-1], atol=1e-6, rtol=0)
    assert torch.equal(state.T_cw, before)


@pytest.mark.parametrize(
    ("gap", "is_found"), [(MAX_CONSECUTIVE_FAILURES, True), (MAX_CONSECUTIVE_FAILURES + 1, False)]
)
def test_a_keyframe_far_from_the_gap_is_not_tried(gap: int, is_found: bool) -> None:
    link = link_of(*at_a_gap(gap, sideways(3, start=-0.5)))
    assert (link is not None) is is_found


def test_a_keyframe_that_sees_something_else_gives_no_link() -> None:
    assert link_of(*at_a_gap(1, AWAY.expand(1, 4, 4).clone())) is None
    jumped = sideways(3, start=-0.5)
    assert link_of(*at_a_gap(1, jumped), before=80) is None  # nothing was posed before
