"""The start of a map is posed anew if it is bent, and left as it is if it is right."""

from __future__ import annotations

from functools import lru_cache

import pytest
import torch
from torch import Tensor

from torchslam import SLAM, evaluate, open_sequence
from torchslam.config import Config
from torchslam.geometry import Camera, transform
from torchslam.map.atlas import Submap
from torchslam.optim import POSE_OPTIONS, solve_pose
from torchslam.system.start_check import KeyframePair, StartCheck
from torchslam.system.state_machine import InitializationState
from torchslam.types import FrameFeatures, Rejection, TwoViewMap

ROOM = "synthetic:room?frames=60"
FRAMES = 60


def bent(start: TwoViewMap, camera: Camera) -> TwoViewMap:
    """A start whose depth is its own reciprocal, with the best pose for it: its points agree, and it is wrong."""
    depths = start.points_w[:, 2]
    points_w = start.points_w * (depths.median() / depths)[:, None]
    pixels = start.view.keypoints[start.keypoints_2]
    T_cw = solve_pose(
        points_w[None],
        pixels[None],
        T_cw=start.T_cw[None],
        camera=camera,
        options=POSE_OPTIONS.replace(kernel="cauchy", backward="detached"),
    ).T_cw[0]
    errors = torch.linalg.vector_norm(camera.project(transform(T_cw, points_w))[0] - pixels, dim=-1)
    kept = torch.nonzero(errors < 3.0)[:, 0]
    return TwoViewMap(
        start.reference, start.view, T_cw, points_w[kept], start.keypoints_1[kept], start.keypoints_2[kept]
    )


@lru_cache
def shown(is_bent: bool, is_checked: bool) -> tuple[Tensor, float, int]:
    """Poses of the frames at the end, ATE in meters, and how often the start was posed anew."""
    create, pose_anew, count = InitializationState._create, StartCheck._pose_anew, [0, 0]

    def create_bent(
        self: InitializationState, start: TwoViewMap, views: list[FrameFeatures]
    ) -> Rejection | None:
        count[0] += 1
        return create(self, bent(start, self.context.camera) if count[0] == 1 and is_bent else start, views)

    def counted(
        self: StartCheck, submap: Submap, views: list[FrameFeatures], pairs: list[KeyframePair], needed: float
    ) -> bool:
        if not is_checked:
            return False
        count[1] += 1
        return pose_anew(self, submap, views, pairs, needed)

    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(InitializationState, "_create", create_bent)
        monkeypatch.setattr(StartCheck, "_pose_anew", counted)
        sequence = open_sequence(ROOM)
        run = SLAM(sequence.camera, Config()).run(sequence)
    return run.trajectory.T_wc, evaluate(run.trajectory, sequence.groundtruth).ate_m, count[1]


def test_a_bent_start_is_posed_anew() -> None:
    before, after = shown(True, False), shown(True, True)
    assert before[1] > 0.1
    assert after[1] < 0.01
    assert after[2] == 1
    assert len(after[0]) == FRAMES


def test_a_right_start_stays_as_it_is() -> None:
    T_wc, ate, count = shown(False, True)
    assert count == 0
    assert ate < 0.01
    assert torch.equal(T_wc, shown(False, False)[0])


def test_a_start_that_is_not_better_is_taken_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """The map, the frames and the keyframe database are as they were."""
    sequence = open_sequence(ROOM)
    slam = SLAM(sequence.camera, Config())
    pose_anew, seen = StartCheck._pose_anew, []

    def state(submap: Submap) -> list[Tensor]:
        columns = (submap.map.keyframes, submap.map.points, submap.posed_frames.frames)
        tensors = [values.clone() for table in columns for values in table.columns().values()]
        return [*tensors, slam.loop_closer.keyframe_database.keys.clone(), submap.tracking.T_cr.clone()]

    def unbelieved(
        self: StartCheck, submap: Submap, views: list[FrameFeatures], pairs: list[KeyframePair], _: float
    ) -> bool:
        before = state(submap)
        is_better = pose_anew(self, submap, views, pairs, float("inf"))
        seen.append((is_better, before, state(submap)))
        return is_better

    monkeypatch.setattr("torchslam.system.start_check.MIN_SUPPORT_RATIO", 2.0)
    monkeypatch.setattr(StartCheck, "_pose_anew", unbelieved)
    for frame in sequence:
        slam.step(frame)
    slam.finalize()
    ((is_better, before, after),) = seen
    assert not is_better
    assert all(torch.equal(one, other) for one, other in zip(before, after, strict=True))
    assert len(slam.trajectory()) == FRAMES
