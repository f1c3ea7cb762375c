from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from torchslam.errors import ResultsError
from torchslam.output.frames_file import read_frames, write_frames
from torchslam.values import StepResult


def test_frames_come_back_without_poses(tmp_path: Path, results: list[StepResult]) -> None:
    write_frames(tmp_path / "frames.csv", results)
    loaded = read_frames(tmp_path / "frames.csv")
    for before, after in zip(results, loaded, strict=True):
        times = {stage: pytest.approx(value, abs=5e-4) for stage, value in before.stage_ms.items()}
        assert after == replace(before, T_cw=None, stage_ms=times)


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
