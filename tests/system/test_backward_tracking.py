"""Backward tracking: which frames get a pose, where it ends, and the frames without one."""

from __future__ import annotations

from collections.abc import Container
from itertools import count

import pytest
import torch
from torch import Tensor

from tests.scene import CAMERA, Scene, pose, sideways, submap_of_scene
from torchslam import SLAM
from torchslam.map.atlas import Submap
from torchslam.system import savepoint as savepoints
from torchslam.system.frame_log import FrameStatus, HeldFrame
from torchslam.system.local_mapping import MAX_CONSECUTIVE_FAILURES, LocalMapping
from torchslam.system.savepoint import Savepoint
from torchslam.tracking import pose_validation
from torchslam.types import Explanation, FrameFeatures, PoseEstimate, Reason, Rejection

SCENE = Scene.of(300)
DOUBT = Rejection(Reason.PURE_ROTATION)
AWAY = pose(0, 0, 0, 0, 3.0)  # looks back: sees nothing
FIRST = 100  # frame of the map's first keyframe
MAP_FRAMES = [100, 101, 102, 103]


class Frames:
    """A map whose first keyframe is frame 100, and frames before it, the last of them first, without a pose.

    Attributes:
        tried: Frames that were to become tentative keyframes.
    """

    def __init__(self, T_cw: Tensor, monkeypatch: pytest.MonkeyPatch, noise: float = 0.0) -> None:
        self.slam = SLAM(CAMERA)
        self.context, self.backward = self.slam._context, self.slam._state_machine.backward
        self.submap = submap_of_scene(SCENE, sideways(4), first=FIRST)
        self.log = self.context.log
        self.log.unpose(*[SCENE.view(FIRST - 1 - offset, T, noise=noise) for offset, T in enumerate(T_cw)])
        self.tried: list[int] = []
        add_tentative_keyframe = LocalMapping.add_tentative_keyframe

        def add(
            mapping: LocalMapping, savepoint: Savepoint, view: FrameFeatures, estimate: PoseEstimate
        ) -> None:
            self.tried.append(view.index)
            add_tentative_keyframe(mapping, savepoint, view, estimate)

        monkeypatch.setattr(LocalMapping, "add_tentative_keyframe", add)

    def tracked(self) -> Frames:
        self.backward.from_first_keyframe(self.submap)
        return self

    @property
    def poses(self) -> dict[int, Tensor]:
        """The poses of the frames that are not of the map."""
        frames = self.submap.posed_frames.frames["frame_index"].tolist()
        T_cw = self.submap.posed_frames.T_cw(self.submap.map)
        return {index: T for index, T in zip(frames, T_cw, strict=True) if index not in MAP_FRAMES}

    @property
    def posed(self) -> list[int]:
        """Frames that got a pose, the last one first."""
        return sorted(self.poses, reverse=True)

    @property
    def unposed(self) -> list[int]:
        return [view.index for view in reversed(self.log.unposed())]

    @property
    def keyframes(self) -> list[int]:
        return self.submap.map.keyframes["frame_index"].tolist()


def tracked_backward(T_cw: Tensor, monkeypatch: pytest.MonkeyPatch, noise: float = 0.0) -> Frames:
    return Frames(T_cw, monkeypatch, noise=noise).tracked()


def doubting(monkeypatch: pytest.MonkeyPatch, doubtful: Container[int]) -> None:
    """Doubt the frames that come as these to be judged, from the first on."""
    judged = count()
    monkeypatch.setattr(
        pose_validation, "check_map_agreement", lambda *_: DOUBT if next(judged) in doubtful else None
    )


def with_keyframes(monkeypatch: pytest.MonkeyPatch, due: Container[int]) -> None:
    """These frames are due as keyframes, and no others."""

    def reason(
        mapping: LocalMapping, submap: Submap, view: FrameFeatures, estimate: PoseEstimate
    ) -> Explanation | None:
        return Explanation.of(Reason.UNCONFIRMED, count=0) if view.index in due else None

    monkeypatch.setattr(LocalMapping, "_keyframe_reason", reason)


@pytest.fixture(autouse=True)
def _without_keyframes(monkeypatch: pytest.MonkeyPatch) -> None:
    with_keyframes(monkeypatch, ())


def test_frames_before_the_map_get_their_true_poses(monkeypatch: pytest.MonkeyPatch) -> None:
    T_cw = sideways(6, -0.05, start=-0.05)
    walk = tracked_backward(T_cw, monkeypatch)
    assert walk.posed == [99, 98, 97, 96, 95, 94]
    assert walk.unposed == []
    for index, found in walk.poses.items():
        torch.testing.assert_close(found, T_cw[99 - index], atol=1e-7, rtol=0)


def test_a_few_blank_frames_are_skipped(monkeypatch: pytest.MonkeyPatch) -> None:
    T_cw = sideways(12, -0.02, start=-0.02)
    T_cw[2 : 2 + MAX_CONSECUTIVE_FAILURES - 1] = AWAY
    T_cw[8 : 8 + MAX_CONSECUTIVE_FAILURES - 1] = AWAY
    walk = tracked_backward(T_cw, monkeypatch)
    assert walk.posed == [99, 98, 93, 92]
    assert walk.unposed == [97, 96, 95, 94, 91, 90, 89, 88]


def test_many_blank_frames_end_backward_tracking(monkeypatch: pytest.MonkeyPatch) -> None:
    T_cw = sideways(10, -0.02, start=-0.02)
    T_cw[1 : 1 + MAX_CONSECUTIVE_FAILURES] = AWAY
    walk = tracked_backward(T_cw, monkeypatch)
    assert walk.posed == [99]
    assert walk.unposed == list(range(98, 89, -1))


def test_frames_with_invalid_poses_are_not_accepted(monkeypatch: pytest.MonkeyPatch) -> None:
    T_cw = sideways(3, -0.05, start=-0.05)
    assert tracked_backward(T_cw, monkeypatch, noise=0.5).posed == [99, 98, 97]
    monkeypatch.setattr(pose_validation, "MAX_ROTATION_STD_DEG", 1e-6)
    walk = tracked_backward(T_cw, monkeypatch, noise=0.5)
    assert walk.posed == []
    assert walk.unposed == [99, 98, 97]
    assert walk.tried == []


def test_a_jump_from_the_predicted_motion_is_not_accepted(monkeypatch: pytest.MonkeyPatch) -> None:
    T_cw = sideways(4, -0.05, start=-0.05)
    # the first frame has no motion to be compared with; the motion from the second to the third is too large
    T_cw[2:] = sideways(2, -0.05, start=-0.5)
    monkeypatch.setattr(pose_validation, "MAX_JUMP", 0.03)
    walk = tracked_backward(T_cw, monkeypatch)
    assert walk.posed == [99, 98]
    assert walk.tried == []


def test_doubtful_frames_are_kept_when_tracking_reaches_the_first_frame(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    doubting(monkeypatch, range(2, 100))
    T_cw = sideways(10, -0.02, start=-0.02)
    walk = tracked_backward(T_cw, monkeypatch)
    assert walk.posed == list(range(99, 89, -1))
    assert walk.tried == list(range(97, 89, -1))
    assert walk.unposed == []
    torch.testing.assert_close(walk.poses[90], T_cw[9], atol=1e-7, rtol=0)


def test_doubtful_frames_are_unposed_again_when_tracking_ends_early(monkeypatch: pytest.MonkeyPatch) -> None:
    doubting(monkeypatch, range(2, 100))
    with_keyframes(monkeypatch, [96, 94])
    T_cw = sideways(12, -0.02, start=-0.02)
    T_cw[6 : 6 + MAX_CONSECUTIVE_FAILURES] = AWAY
    walk = tracked_backward(T_cw, monkeypatch)
    assert walk.tried == [97, 96, 95, 94]
    assert walk.posed == [99, 98]
    assert walk.unposed == list(range(97, 87, -1))
    assert walk.keyframes == MAP_FRAMES  # the tentative ones are gone


def test_doubtful_frames_are_kept_after_enough_certain_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    confirming = pose_validation.NUM_CONFIRMING_FRAMES
    T_cw = sideways(15, -0.02, start=-0.02)
    for certain, posed in ((confirming - 1, [99]), (confirming, list(range(99, 96 - confirming, -1)))):
        doubting(monkeypatch, {1, 2})
        away = T_cw.clone()
        away[3 + certain : 3 + certain + MAX_CONSECUTIVE_FAILURES] = AWAY
        walk = tracked_backward(away, monkeypatch)
        assert walk.posed == posed
        assert walk.tried == list(range(98, 96 - certain, -1))
        assert walk.unposed == [index for index in range(99, 84, -1) if index not in posed]


def test_tentative_keyframes_are_kept_with_their_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only then can their places be recognized."""
    doubting(monkeypatch, {1, 2})
    with_keyframes(monkeypatch, [97])
    walk = tracked_backward(sideways(10, -0.02, start=-0.02), monkeypatch)
    assert walk.posed == list(range(99, 89, -1))
    assert walk.keyframes == [*MAP_FRAMES, 97]
    assert len(walk.slam.loop_closer.keyframe_database) == 1  # the map of the scene is not in it


def test_held_frames_are_committed_where_no_more_can_be_held(monkeypatch: pytest.MonkeyPatch) -> None:
    """The count of certain frames that are needed goes on, and what follows is held."""
    monkeypatch.setattr(savepoints, "MAX_HELD_FRAMES", 3)
    doubting(monkeypatch, range(100))
    T_cw = sideways(5 + MAX_CONSECUTIVE_FAILURES, -0.02, start=-0.02)
    T_cw[5:] = AWAY
    walk = tracked_backward(T_cw, monkeypatch)
    assert walk.tried == [99, 98, 97, 96, 95]
    assert walk.posed == [99, 98, 97]
    assert walk.unposed == [96, 95, 94, 93, 92, 91, 90]


def test_the_tracking_state_of_the_map_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames are tracked forward from where they were."""
    walk = Frames(sideways(6, -0.05, start=-0.05), monkeypatch)
    before = walk.submap.T_cw.clone(), walk.submap.tracking
    walk.tracked()
    assert walk.submap.tracking is before[1]
    assert torch.equal(walk.submap.T_cw, before[0])
    assert walk.posed


def test_frames_before_a_relocalized_one_are_tracked_from_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames after it are not, nor those that are held."""
    T_cw = sideways(6, -0.05, start=-0.05)
    walk = Frames(T_cw, monkeypatch)
    tracker, context = walk.context.tracker, walk.context
    view, held = walk.log.view(97), walk.log.view(96)
    state = walk.submap.fork()
    tracker.reset_to_keyframe(state, 0)
    estimate = tracker.track(state, view)
    assert estimate is not None
    context.log.forget([97])
    context.log.hold(HeldFrame(held, estimate, pose(), 0))
    walk.backward.from_frame(walk.submap, HeldFrame(view, estimate, pose(), 0))
    assert walk.posed == [95, 94]
    assert walk.unposed == [99, 98]
    assert context.log.status(96) is FrameStatus.HELD
    for index, found in walk.poses.items():
        torch.testing.assert_close(found, T_cw[99 - index], atol=1e-7, rtol=0)
