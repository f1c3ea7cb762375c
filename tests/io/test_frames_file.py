from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from torchslam.errors import ResultsError
from torchslam.io.results import read_frames
from torchslam.io.write_run import write_frames
from torchslam.types import State, StepResult


def test_frames_without_poses_round_trip(tmp_path: Path, results: list[StepResult]) -> None:
    write_frames(tmp_path / "frames.csv", results)
    loaded = read_frames(tmp_path / "frames.csv")
    for before, after in zip(results, loaded, strict=True):
        times = {stage: pytest.approx(value, abs=5e-4) for stage, value in before.stage_ms.items()}
        assert after == replace(before, T_cw=None, stage_ms=times)


def test_state_and_submap_of_a_frame_have_columns(tmp_path: Path, results: list[StepResult]) -> None:
    doubtful = [replace(results[0], state=State.UNCERTAIN, submap=12), replace(results[1], submap=None)]
    write_frames(tmp_path / "frames.csv", doubtful)
    lines = (tmp_path / "frames.csv").read_text().splitlines()
    assert lines[0].startswith("index,timestamp,state,submap,keyframe,")
    assert lines[1].startswith("0,100.0,uncertain,12,0,")
    assert lines[2].split(",")[2:4] == ["initializing", ""]
    assert [frame.submap for frame in read_frames(tmp_path / "frames.csv")] == [12, None]


def test_no_frames(tmp_path: Path) -> None:
    write_frames(tmp_path / "frames.csv", [])
    assert read_frames(tmp_path / "frames.csv") == []


def test_errors_name_file_and_line(tmp_path: Path, results: list[StepResult]) -> None:
    path = tmp_path / "frames.csv"
    with pytest.raises(ResultsError, match=r"frames\.csv: cannot be read"):
        read_frames(path)
    write_frames(path, results[:3])
    path.write_text(path.read_text().replace("initializing", "flying", 1))
    with pytest.raises(ResultsError, match=r"frames\.csv:2: .*flying"):
        read_frames(path)
