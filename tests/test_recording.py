"""`torchslam.run`: from a recording to a result without the command line."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

import torchslam
from tests.walks import Walk, arc
from torchslam import SLAM, Frame, State, StepResult, load_config, recording
from torchslam.data.sequence import Calibrated
from torchslam.global_mapping.mapper import GlobalMap, GlobalMapper
from torchslam.global_mapping.recording import Mapping
from torchslam.map.unit import MetricUnit
from torchslam.metric.source import ScaleMeasurement, ScaleSource, SubmapView
from torchslam.system.online_run import Observer

SETTINGS = ["features.kind=simulated", "features.num_keypoints=250", "simulated.points_per_view=150"]
CONFIG = load_config(None, [*SETTINGS, "simulated.noise_px=0.05", "camera.readout_std=0"])
FRAMES = 20
WALK = Walk(arc(45)[:FRAMES])


class Twice:
    """A source that says that a unit is two meters."""

    def measure(self, view: SubmapView) -> ScaleMeasurement:
        return ScaleMeasurement(ScaleSource.DISTANCE, 2.0, 0.01, 1, "lengths")


def test_frames_the_check_and_meters_are_one_call() -> None:
    seen: list[int] = []
    run = torchslam.run(
        WALK, CONFIG, measurements=[Twice()], observer=Observer(lambda result: seen.append(result.index))
    )
    assert seen == list(range(FRAMES))
    assert len(run.trajectory) == FRAMES
    assert (run.kept, run.why, run.by_frame) == (Mapping.ONLINE, "", None)
    assert isinstance(run.metric, MetricUnit)
    alone = SLAM(WALK.camera, CONFIG).run(WALK)
    centers = [each.trajectory.T_wc[:, :3, 3] for each in (run, alone)]
    torch.testing.assert_close(centers[0].diff(dim=0), 2 * centers[1].diff(dim=0))


def test_a_lost_recording_is_mapped_as_a_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    step = SLAM.step

    def lose(slam: SLAM, frame: Frame) -> StepResult:
        result = step(slam, frame)
        return replace(result, state=State.LOST) if frame.index == 12 else result

    monkeypatch.setattr(SLAM, "step", lose)
    run = torchslam.run(WALK, CONFIG)
    assert (run.kept, run.why) == (Mapping.GLOBAL, "tracking was lost at frame 12")
    assert run.by_frame is not None
    assert len(run.trajectory) == FRAMES > len(run.online)
    online = torchslam.run(WALK, CONFIG, mapping="online")
    assert (online.kept, online.by_frame, len(online.results)) == (Mapping.ONLINE, None, FRAMES)


def test_a_recording_that_is_to_be_mapped_as_a_whole_is_not_processed_frame_by_frame() -> None:
    """But where it is so long that frames which are spread evenly may not overlap: then keyframes are mapped."""
    seen: list[int] = []
    observer = Observer(lambda result: seen.append(result.index))
    run = torchslam.run(WALK, CONFIG, mapping="global", observer=observer)
    assert (run.kept, run.why, seen) == (Mapping.GLOBAL, "it was asked for", [])
    assert run.by_frame is not None
    assert run.by_frame.results == []
    assert (len(run.trajectory), len(run.online), run.failure) == (FRAMES, 0, "")
    config = replace(CONFIG, global_mapping=replace(CONFIG.global_mapping, window_images=4))
    torchslam.run(WALK, config, mapping="global", observer=observer)
    assert seen == list(range(FRAMES))


def test_frames_are_processed_where_the_map_of_the_whole_is_not_right(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fail(mapper: GlobalMapper, *_: Any) -> GlobalMap:
        return mapper._failed("no map", [], [])

    monkeypatch.setattr(GlobalMapper, "run", fail)
    run = torchslam.run(WALK, CONFIG, mapping="global")
    assert (run.kept, run.why, len(run.trajectory)) == (Mapping.ONLINE, "it was asked for", FRAMES)


def test_an_interrupt_keeps_what_there_is() -> None:
    def stop(result: StepResult) -> None:
        if result.index == 12:
            raise KeyboardInterrupt

    run = torchslam.run(WALK, CONFIG, measurements=[Twice()], observer=Observer(stop))
    assert run.interrupted
    assert (run.kept, run.check, run.metric) == (None, None, None)
    assert len(run.results) == 13
    assert run.unmeasured == ("interrupted; `torchslam align` measures later",)


@pytest.mark.parametrize("calibrated", list(Calibrated))
def test_an_unknown_camera_is_estimated_first(
    monkeypatch: pytest.MonkeyPatch, calibrated: Calibrated
) -> None:
    searched: list[Any] = []

    def find(sequence: Walk, config: Any, output: None, device: str, **rest: Any) -> tuple[Walk, str]:
        searched.append(output)
        return sequence, "found"

    monkeypatch.setattr(recording, "find_camera", find)
    sequence = Walk(arc(45)[:10])
    sequence.calibrated = calibrated
    torchslam.run(sequence, CONFIG, mapping="online")
    assert searched == ([] if calibrated is Calibrated.GIVEN else [None])


def test_an_unknown_mapping_is_named() -> None:
    with pytest.raises(ValueError, match="'whole' is not a valid Mapping"):
        torchslam.run(WALK, CONFIG, mapping="whole")
