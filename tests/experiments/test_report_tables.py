"""The report: what it reads of a results folder, what counts as worse, and the tables in the documentation."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from experiments.common import DATA_DIR, Usage, run_command
from experiments.report import record, rows, run, tables
from experiments.report.compare import compare
from experiments.report.rows import ALL, judged, parse_agreement, peer_trajectory, read_row, run_row
from torchslam.data.trajectories import write_trajectory
from torchslam.io.write_run import write_frames
from torchslam.types import State, StepResult, Trajectory

FRAMES = 20
AGREEMENT = "237 of 237 in common, median 0.0046, within 2, 5, 10 %: 0.93, 1.00, 1.00, worst 0.06\n"
ROW = {
    "exit_status": 0,
    "cpu_s": 10.0,
    "wall_s": 12.0,
    "peak_mb": 500,
    "frames": 200,
    "posed": 190,
    "online_posed": 180,
    "uncertain": 4,
    "kept": "online",
    "why_global": "",
    "ms_median": 20.0,
    "ms_p95": 60.0,
    "ms_longest": 300.0,
    "extent": 0.5,
    "online_ate": 0.004,
    "ate": 0.002,
    "judged_by": "truth",
    "judged": 190,
    "uncertain_right": 3,
    "uncertain_wrong": 1,
    "certain_wrong": 0,
}
PEER_ROW = ROW | {
    "peer": {"system": "pycolmap", "posed": 200, "cpu_s": 50.0, "median": 0.01, "within": [0.9, 0.95, 1.0]}
}


def report(**changes: Any) -> record.Report:
    """Of one recording with a truth and one with a peer; `changes` are those of the first one."""
    place = {"date": "2026-01-01", "commit": "a" * 40, "is_changed": False, "machine": "one"}
    return place | {"rows": {"shelf_bin": ROW | changes, "garden": PEER_ROW}}


def walk() -> Trajectory:
    """Poses on a curve with turns, one per second."""
    times = torch.arange(FRAMES, dtype=torch.float64)
    T_wc = torch.eye(4, dtype=torch.float64).repeat(FRAMES, 1, 1)
    T_wc[:, :3, 3] = torch.stack([times, (times / 3).sin(), (times / 5).cos()], dim=-1)
    return Trajectory(times, T_wc)


def results_of(folder: Path, trajectory: Trajectory, uncertain: set[int]) -> Path:
    """The files of a results folder that a row is read from."""
    folder.mkdir()
    write_trajectory(folder / "trajectory.txt", trajectory)
    write_trajectory(folder / "online.txt", Trajectory(trajectory.timestamps[:5], trajectory.T_wc[:5]))
    states = [State.UNCERTAIN if index in uncertain else State.TRACKING for index in range(FRAMES)]
    write_frames(
        folder / "frames.csv", [StepResult(k, float(k), state, None) for k, state in enumerate(states)]
    )
    metrics = {"frames": FRAMES, "posed": len(trajectory), "online_posed": 5, "uncertain": len(uncertain)}
    metrics |= {
        "lost": 0,
        "keyframes": 3,
        "mapping": "global",
        "mapping_reason": "tracking was lost at frame 5",
    }
    metrics |= {"session": 0, "submap": 0, "submaps": []}
    metrics |= {"ms_median": 10.0, "ms_p95": 20.0, "ms_longest": 31.26}
    (folder / "metrics.json").write_text(json.dumps(metrics))
    return folder


def moved(trajectory: Trajectory, frames: list[int], distance: float) -> Trajectory:
    T_wc = trajectory.T_wc.clone()
    T_wc[frames, 1, 3] += distance
    return Trajectory(trajectory.timestamps, T_wc)


def test_a_row_is_read_from_a_results_folder(tmp_path: Path) -> None:
    truth = tmp_path / "truth.txt"
    write_trajectory(truth, walk())
    doubled = walk().T_wc.clone()
    doubled[:, :3, 3] *= 2.0
    row = read_row(results_of(tmp_path / "out", Trajectory(walk().timestamps, doubled), {3}), truth)
    assert (row["posed"], row["online_posed"], row["kept"]) == (20, 5, "global")
    assert row["why_global"] == "tracking was lost at frame 5"
    assert row["ms_longest"] == 31.3
    assert row["ate"] == pytest.approx(0.0, abs=1e-6)
    assert row["online_ate"] == pytest.approx(0.0, abs=1e-6)
    assert (row["judged_by"], row["judged"], row["uncertain_right"]) == ("truth", 20, 1)
    without = read_row(tmp_path / "out", tmp_path / "none.txt")
    assert not {"ate", "judged", "peer"} & without.keys()


def test_wrong_frames_are_counted_by_whether_they_are_called_uncertain(tmp_path: Path) -> None:
    results = results_of(tmp_path / "out", moved(walk(), [7, 8, 9], 9.0), {8, 12, 13})
    assert judged(results, walk()) == {
        "judged": 20,
        "uncertain_right": 2,
        "uncertain_wrong": 1,
        "certain_wrong": 2,
    }
    half = Trajectory(walk().timestamps[::2], walk().T_wc[::2])  # of the others, there is no true pose
    assert judged(results, half) | {"judged": 10, "uncertain_right": 1} == judged(results, half)


def test_a_run_without_poses_is_not_judged(tmp_path: Path) -> None:
    truth = tmp_path / "truth.txt"
    write_trajectory(truth, walk())
    row = read_row(results_of(tmp_path / "out", Trajectory.empty(), set()), truth)
    assert row["ate"] is None
    assert (row["judged"], row["certain_wrong"]) == (0, 0)


def test_the_agreement_with_a_peer_is_parsed() -> None:
    assert parse_agreement(AGREEMENT) == {"common": 237, "median": 0.0046, "within": [0.93, 1.0, 1.0]}
    with pytest.raises(SystemExit, match="unexpected output: 'nan'"):
        parse_agreement("nan")


@pytest.mark.skipif(
    not (DATA_DIR.parent / "peers" / "compare_poses.py").is_file(), reason="no compare_poses.py"
)
def test_a_peer_takes_the_place_of_the_truth(tmp_path: Path) -> None:
    peer = tmp_path / "peer"
    peer.mkdir()
    write_trajectory(peer / "trajectory.txt", walk())
    (peer / "peer.json").write_text('{"posed": 20, "cpu_s": 3.0}')
    results = results_of(tmp_path / "out", moved(walk(), [7], 9.0), {7})
    row = read_row(results, tmp_path / "none.txt", peer)
    assert row["peer"] == {
        "posed": 20,
        "cpu_s": 3.0,
        "common": 20,
        "median": pytest.approx(0.0, abs=1e-3),
        "within": [0.95, 0.95, 0.95],
    }
    assert (row["judged_by"], row["uncertain_wrong"]) == ("pycolmap", 1)


def test_a_peer_runs_once_and_only_with_its_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert peer_trajectory(ALL["garden"], None, tmp_path) is None
    lines = []

    def run_global(line: list[str], **options: Any) -> subprocess.CompletedProcess[str]:
        lines.append(line)
        Path(line[-1]).mkdir(parents=True)
        figures = {"system": "pycolmap 4", "registered": 152, "of": 152, "cpu_total": 110.0}
        return subprocess.CompletedProcess(line, 0, f"a word\n{json.dumps(figures)}\n")

    monkeypatch.setattr(rows.subprocess, "run", run_global)
    path = peer_trajectory(ALL["garden"], Path("/peers"), tmp_path)
    assert path == peer_trajectory(ALL["garden"], None, tmp_path) == tmp_path / "garden" / "trajectory.txt"
    assert [line[0] for line in lines] == ["/peers/bin/python"]
    assert json.loads((tmp_path / "garden" / "peer.json").read_text())["posed"] == 152


def test_the_usage_of_a_command_includes_its_children(tmp_path: Path) -> None:
    mine = bytearray(600 << 20)  # the memory of the caller does not count
    spin = "import time; b = bytearray(200 << 20); t = time.process_time()\nwhile time.process_time() < t + 0.3: pass"
    both = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {spin!r}]); sys.exit(3)"
    with (tmp_path / "log").open("w") as log:
        status, used = run_command([sys.executable, "-c", both], log)
    assert status == 3
    assert 0.3 < used.cpu_s < 2.0
    assert 200 < used.peak_mb < 400 < len(mine) / 2**20


def test_a_command_that_failed_has_a_row_without_figures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rows, "run_default", lambda *arguments: (1, Usage(2.04, 3.0, 100.2)))
    row = run_row(ALL["shelf_bin"], tmp_path)
    assert row == {"exit_status": 1, "cpu_s": 2.0, "wall_s": 3.0, "peak_mb": 100}
    assert compare(report() | {"rows": {"shelf_bin": row}}, report()) == ["shelf_bin: exit status 1, was 0"]
    assert "| shelf_bin (robot arm) | exit status 1 |" in tables.accuracy({"rows": {"shelf_bin": row}})
    assert "shelf_bin" not in tables.certainty({"rows": {"shelf_bin": row}})


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"ate": 0.00211}, "ATE 0.00211, was 0.002 (1.05 times)"),
        ({"online_ate": 0.0044}, "online ATE 0.0044, was 0.004 (1.10 times)"),
        ({"ate": None}, "ATE is undefined, was 0.002"),
        ({"posed": 189}, "posed 189 of 200 frames, was 190"),
        ({"uncertain": 7}, "7 uncertain frames, was 4"),
        ({"certain_wrong": 3}, "3 wrong frames that are not called uncertain, was 0"),
        ({"cpu_s": 11.1}, "CPU time (s) 11.1, was 10 (1.11 times)"),
        ({"peak_mb": 560}, "memory (MB) 560, was 500 (1.12 times)"),
        ({"ate": 0.00209, "uncertain": 6, "certain_wrong": 2, "cpu_s": 10.9, "peak_mb": 549}, ""),
        ({"ate": 0.001, "posed": 200, "uncertain": 0, "cpu_s": 1.0, "peak_mb": 100}, ""),
    ],
    ids=str,
)  # fmt: skip
def test_what_got_worse_is_named(changes: dict[str, float], said: str) -> None:
    assert compare(report(**changes), report()) == ([f"shelf_bin: {said}"] if said else [])


def test_a_map_of_a_camera_at_rest_and_a_difference_to_the_peer_are_compared() -> None:
    assert compare(report(posed=3), report(posed=0)) == [
        "shelf_bin: posed 3 frames of a recording without a map"
    ]
    new = report()
    new["rows"]["garden"] = PEER_ROW | {"peer": PEER_ROW["peer"] | {"median": 0.02}}
    assert compare(new, report()) == ["garden: median difference to pycolmap 0.02, was 0.01 (2.00 times)"]


def test_tables_are_written_between_their_marks(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("# Title\n\n<!-- report:begin accuracy -->\nold\n<!-- report:end -->\nEnd\n")
    tables.write(report(), [page])
    text = page.read_text()
    assert "| shelf_bin (robot arm) | 190 of 200 | 180 | 0.0040 m | 0.0020 m | online | 10 | 500 |" in text
    assert (
        "| garden (phone) | 190 of 200 | 180 | 0.80% of the extent | 0.40% of the extent | online |" in text
    )
    assert text.startswith("# Title\n\n<!-- report:begin accuracy -->\n| recording |")
    assert text.endswith("|\n<!-- report:end -->\nEnd\n")
    assert tables.filled(text, report()) == text
    assert tables.filled(text, report(ate=0.003)) != text
    with pytest.raises(SystemExit, match="report:begin ates: no such table; there are origin, accuracy"):
        tables.filled("<!-- report:begin ates -->\n<!-- report:end -->", report())


@pytest.mark.parametrize("path", tables.FILES, ids=lambda path: path.parent.name)
def test_the_tables_of_the_documentation_are_those_of_the_report(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert "<!-- report:begin accuracy -->" in text
    assert tables.filled(text, json.loads(record.REPORT.read_text())) == text, "run `make report`"


def test_a_report_is_compared_written_and_accepted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    written: list[record.Report] = []
    monkeypatch.setattr(run, "available", list)
    monkeypatch.setattr(run, "run_row", lambda recording, *options: ROW | {"ate": 0.003})
    monkeypatch.setattr(record, "committed", lambda: report())
    monkeypatch.setattr(record, "write", written.append)
    monkeypatch.setattr(tables, "write", lambda found: None)
    assert run.main(["shelf_bin"]) == 1
    assert "WORSE: shelf_bin: ATE 0.003, was 0.002 (1.50 times)" in capsys.readouterr().out
    assert written == []
    assert run.main(["shelf_bin", "--write", "--accept", "fewer wrong poses"]) == 0
    assert run.main([]) == 1
    some, every = written
    assert some["accepted"] == "fewer wrong poses"
    assert some["worse"] == ["shelf_bin: ATE 0.003, was 0.002 (1.50 times)"]
    assert list(every["rows"]) == list(ALL)
    monkeypatch.setattr(record, "committed", lambda: None)
    assert run.main(["shelf_bin"]) == 0
    with pytest.raises(SystemExit):
        run.main(["shelf"])
    assert "shelf: no such recording" in capsys.readouterr().err
