"""States and reasons: what a session says of its frames, and of a run without a map."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest
import torch

from torchslam import evaluate
from torchslam.config import load_config
from torchslam.data import open_sequence
from torchslam.system.online_run import no_map_message
from torchslam.system.slam import SLAM
from torchslam.tracking.tracker import Relocalizer
from torchslam.types import Explanation, Reason, Rejection, State, StepResult


def result(index: int, reason: Explanation) -> StepResult:
    return StepResult(index, float(index), State.INITIALIZING, None, reasons=(reason,))


@pytest.mark.parametrize(
    "rejection",
    [
        Rejection.of(Reason.FEW_KEYPOINTS, count=12, needed=100),
        Rejection.of(Reason.FEW_MATCHES, count=12, needed=100),
    ],
)
def test_the_reason_of_most_frames_is_reported(rejection: Rejection) -> None:
    reference = Explanation(Reason.NEW_REFERENCE)
    results = [result(0, reference), *(result(index, rejection) for index in range(1, 1000))]
    assert no_map_message(results, []) == f"no map was initialized in 1000 frames: {rejection}"


def test_a_single_reference_frame_is_reported_as_too_few_frames() -> None:
    assert "1 frames are too few" in no_map_message([result(0, Explanation(Reason.NEW_REFERENCE))], [])


def test_a_video_without_texture_and_views_far_apart_are_told_apart() -> None:
    room = open_sequence("synthetic:room?frames=400")
    plain = [replace(room[index], image=torch.full_like(room[index].image, 0.5)) for index in range(5)]
    for frames, message in (
        (plain, "in 5 frames: too little texture: 0 keypoints, 100 are needed"),
        ([room[index] for index in range(0, 400, 50)], r"in 8 frames: .*views may be too far apart"),
    ):
        slam = SLAM(room.camera, load_config(None, ["features.kind=opencv-orb"]))
        said = no_map_message([slam.step(replace(frame, index=row)) for row, frame in enumerate(frames)], [])
        assert re.search(message, said), said


@pytest.fixture
def slam() -> SLAM:
    return SLAM(
        open_sequence("synthetic:room?frames=40").camera, load_config(None, ["features.kind=opencv-orb"])
    )


def test_frames_lost_before_the_last_relocalization_are_tracked_backward(
    slam: SLAM, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The recording ends before the relocalized frame is confirmed: it is kept, and so are the ones before it."""
    locate = Relocalizer.locate
    monkeypatch.setattr(
        Relocalizer,
        "locate",
        lambda self, view, candidates: None if view.index < 37 else locate(self, view, candidates),
    )
    sequence = open_sequence("synthetic:room?frames=60")
    frames = [sequence[index] for index in range(39)]
    frames[31] = replace(frames[31], image=torch.full_like(frames[31].image, 0.5))
    states = [slam.step(frame).state for frame in frames]
    assert states[31:37] == [State.LOST] * 6
    assert states[37:] == [State.UNCERTAIN] * 2
    submap = slam.submap
    assert submap is not None
    assert not set(submap.posed_frames.frames["frame_index"].tolist()) & set(range(31, 39))
    slam.finalize()
    assert set(range(32, 39)) <= set(submap.posed_frames.frames["frame_index"].tolist())
    errors = evaluate(slam.trajectory(), sequence.groundtruth)
    assert errors.ate_m < 0.02
