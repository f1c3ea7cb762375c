"""The benchmark of the whole system: what it counts, and the profile of a run."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import pytest

from experiments.benchmarks.slam import run, stages
from torchslam.io.write_run import write_frames
from torchslam.types import State, StepResult

OURS = ["ours", "ours, one process"]


def test_the_time_of_all_processes_is_summed() -> None:
    spin = "import time; t = time.process_time()\nwhile time.process_time() < t + 0.3: pass"
    both = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {spin!r}]); {spin}\nprint('done')"
    said, seconds = run.with_cpu_time([sys.executable, "-c", both])
    assert said == "done\n"
    assert 0.6 < seconds < 1.0
    with pytest.raises(SystemExit, match="ended with 3"):
        run.with_cpu_time([sys.executable, "-c", "raise SystemExit(3)"])


def test_rows_are_medians_of_their_runs() -> None:
    first = run.Metrics(160, 10.0, 50.0, 20.0, 40.0, 0.1, 160)
    runs = [first, replace(first, median=30.0, ate=0.3, posed=150), replace(first, median=12.0, ate=None)]
    cells = run.row(run.RECORDINGS[1], "ours", runs)
    assert cells == ["kitti07, 160", "ours", "12.0", "50", "20.0", "40", "0.2000", "160 of 160"]
    assert run.systems(True) == [*OURS, "ORB-SLAM3"]
    assert run.systems(False) == OURS


def test_missing_orb_slam3_is_reported(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("ORB_SLAM3_PYTHON", raising=False)
    assert run.find_peer() is None
    assert "ORB-SLAM3: skipped; set ORB_SLAM3_PYTHON" in capsys.readouterr().out


def test_a_profile_is_printed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    times = [{"features": 20.0, "total": 20.0}, {"features": 10.0, "mapping": 30.0, "total": 40.0}]
    write_frames(
        tmp_path / "frames.csv",
        [
            StepResult(index, float(index), State.TRACKING, None, is_keyframe=index == 1, stage_ms=each)
            for index, each in enumerate(times)
        ],
    )
    monkeypatch.setattr(sys, "argv", ["stages", str(tmp_path)])
    stages.main()
    out = capsys.readouterr().out
    assert "2 frames, 1 keyframes" in out
    assert "| features | 2 | 15.0 | 15.0 | 30.0 | 50% |" in out
    assert "| mapping | 1 | 30.0 | 15.0 | 30.0 | 50% |" in out
