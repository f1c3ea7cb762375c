"""A scout in a process of its own: the same bytes as without it, whatever happens to the process."""

from __future__ import annotations

import os
import signal
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from tests.tracking.test_scout import frame
from torchslam import load_config
from torchslam.data import open_sequence
from torchslam.data.sequence import Sequence
from torchslam.errors import FrameError
from torchslam.evaluation import evaluate
from torchslam.map.submap import World
from torchslam.parallel.patch_worker import Scouting
from torchslam.parallel.serialization import as_arrays, from_arrays
from torchslam.parallel.worker import Worker
from torchslam.parallel.workers import helped
from torchslam.system.context import Outcome
from torchslam.system.run import Run, run_sequence
from torchslam.system.slam import SLAM
from torchslam.system.tracking_state import Following
from torchslam.types import Followed, Frame, State, StepResult, View

CONFIG = load_config(
    None,
    [
        "patches.enabled=true",
        "features.num_keypoints=600",
        "initialization.min_frames=3",
    ],
)
START, FRAMES = 0, 38
BAD = 26
PATIENCE = 120.0  # seconds: torch is imported within two, on a machine with nothing else to do


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    """A camera that moves through a room; one damaged picture."""
    folder, rendered = tmp_path_factory.mktemp("room"), open_sequence("synthetic:room")
    (folder / "rgb").mkdir()
    for index in range(FRAMES):
        image = (rendered[START + index].image[0, 0].numpy() * 255).round().astype(np.uint8)
        cv2.imwrite(str(folder / "rgb" / f"{index:02}.png"), image)
    (folder / "rgb" / f"{BAD:02}.png").write_bytes(b"not an image")
    return open_sequence(folder, ",".join(str(float(number)) for number in rendered.camera.params))


def run(sequence: Sequence, processes: int, after: object = None) -> tuple[Run, SLAM]:
    slam = SLAM(sequence.camera, CONFIG)
    with (
        helped(sequence, slam, processes) as frames,
        pytest.warns(UserWarning, match="skipped a frame"),
    ):
        return run_sequence(slam, sequence, after, frames=frames), slam  # type: ignore[arg-type]


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wait for the process, so that a short sequence is its own."""
    enter = Scouting.__enter__

    def wait(self: Scouting) -> Scouting:
        enter(self)
        assert self._worker._ours.poll(PATIENCE)
        return self

    monkeypatch.setattr(Scouting, "__enter__", wait)


@pytest.fixture(scope="module")
def alone(sequence: Sequence) -> Run:
    return run(sequence, 1)[0]


def test_most_frames_are_followed(alone: Run) -> None:
    assert len(alone.skipped) == 1
    keyed = (alone.history.observations["keypoints"] >= 0).float()
    frames = alone.history.observations["row"]
    followed = {int(row) for row in frames.unique() if not bool(keyed[frames == row].any())}
    assert len(followed) >= 10
    assert all(result.state is State.TRACKING for result in alone.results[10:])
    truth = open_sequence("synthetic:room").groundtruth
    assert truth is not None
    index_at = {result.timestamp: START + result.index for result in alone.results}
    frames = [index_at[time] for time in alone.trajectory.timestamps.tolist()]
    moved = replace(alone.trajectory, timestamps=truth.timestamps[frames])
    assert evaluate(moved, truth).ate_m < 0.01


def test_an_adjustment_is_taken_over_in_its_frame_where_only_patches_are_followed(
    sequence: Sequence, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = replace(
        CONFIG, bundle=replace(CONFIG.bundle, window=3, delay=2)
    )  # few keyframes are enough to wait
    slam, taken = SLAM(sequence.camera, config), []
    go_along = Following.go_along

    def watched(self: Following, world: World, frame: Frame, followed: Followed) -> tuple[View, Outcome]:
        due = slam.mapper.adjusting.due
        found = go_along(self, world, frame, followed)
        if due is not None and not slam.mapper.adjusting:
            taken.append(frame.index == due)
        return found

    def after(result: StepResult) -> None:
        due = slam.mapper.adjusting.due
        assert due is None or due > result.index

    monkeypatch.setattr(Following, "go_along", watched)
    with pytest.warns(UserWarning, match="skipped a frame"):
        slam.run(sequence, after)
    assert taken
    assert all(taken)


def same(one: Run, other: Run) -> bool:
    return (
        torch.equal(one.trajectory.T_wc, other.trajectory.T_wc)
        and torch.equal(one.map.positions_w, other.map.positions_w)
        and [result.is_keyframe for result in one.results] == [result.is_keyframe for result in other.results]
        and [result.inliers for result in one.results] == [result.inliers for result in other.results]
    )


@pytest.mark.usefixtures("patient")
def test_the_same_with_a_process(sequence: Sequence, alone: Run) -> None:
    assert same(run(sequence, 2)[0], alone)


def test_the_same_with_a_process_that_comes_later(
    sequence: Sequence, alone: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    arrived: list[int] = []

    def is_there(self: Worker) -> bool:
        if arrived[-1:] == [15]:
            assert self._ours.poll(PATIENCE)
        return arrived[-1:] >= [15] and there(self)

    there = Worker.is_there
    monkeypatch.setattr(Worker, "is_there", is_there)
    assert same(run(sequence, 2, lambda result: arrived.append(result.index))[0], alone)
    assert 15 in arrived


@pytest.mark.usefixtures("patient")
def test_a_process_that_is_killed_is_done_without(sequence: Sequence) -> None:
    slam = SLAM(sequence.camera, CONFIG)
    with helped(sequence, slam, 2) as frames:
        assert isinstance(frames, Scouting)

        def kill(result: StepResult) -> None:
            if result.index == 20:
                os.kill(frames._worker._process.pid or 0, signal.SIGKILL)

        with pytest.warns(UserWarning, match="another process of this run has ended"):
            finished = run_sequence(slam, sequence, kill, frames=frames)
    assert [result.state for result in finished.results[21:]] == [State.TRACKING] * (FRAMES - 22)


@pytest.mark.usefixtures("patient")
def test_errors_are_raised_at_their_frame(sequence: Sequence) -> None:
    slam = SLAM(sequence.camera, CONFIG)
    with Scouting(sequence, slam) as frames:
        for index in range(BAD):
            assert frames[index].features is not None  # nothing was learned: there is nothing to follow
        with pytest.raises(FrameError, match=f"{BAD}.png"):
            frames[BAD]
        assert frames[BAD + 1].index == BAD + 1


def test_what_travels_arrives(sequence: Sequence) -> None:
    followed = Followed(3, "", torch.eye(4).double(), torch.tensor([1, 2]), torch.rand(2, 2).double(), 5)
    sent = as_arrays(frame(7), followed, None)
    arrived = from_arrays(sent)
    assert (arrived.index, arrived.timestamp, arrived.features) == (7, 7.0, None)
    assert arrived.followed is not None
    for name, value in vars(followed).items():
        there = getattr(arrived.followed, name)
        assert torch.equal(there, value) if isinstance(value, torch.Tensor) else there == value


def test_frames_with_features_are_not_followed(sequence: Sequence, tmp_path: Path) -> None:
    slam = SLAM(sequence.camera, CONFIG)
    with Scouting(sequence, slam) as frames:
        assert frames[0].followed is None  # the process has not started
        assert frames[0].image.shape == (1, 1, 480, 640)
