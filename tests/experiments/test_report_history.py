"""The history of the figures: what is kept, what is seen, what is drawn."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import pytest

from experiments.report import draw, rows, run
from experiments.report.compare import compare, missing, same_bytes
from experiments.report.record import Record, append, beginning, read_history

ROOM = "synthetic:room?frames=8"
FIGURES = {
    "frames": 50,
    "posed": 50,
    "keyframes": 9,
    "ate": 0.002,
    "extent": 0.5,
    "cpu_s": 10.0,
    "ms_median": 80.0,
}
STILL = {"frames": 40, "posed": 0, "keyframes": 0, "cpu_s": 4.0, "ms_median": 30.0}


def record(commit: str = "a" * 40, load: float = 0.1, **changes: Any) -> Record:
    """Of two sequences and a benchmark; `changes` are those of the first one."""
    end = {"ms_p95": 200.0, "trajectory": "0123456789abcdef"}
    return {
        "time": "2026-01-01T00:00:00Z",
        "commit": commit,
        "machine": "one",
        "load": load,
        "sequences": {"shelf": FIGURES | end | changes, "still": STILL | end},
        "benchmarks": {"bundle": {"error": 0.5, "ms": 900.0}},
    }


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"ate": 0.0023}, "shelf: ate 0.0023, was 0.002 (1.15 times)"),
        ({"posed": 44}, "shelf: posed 44 of 50, was 50 of 50"),
        ({"cpu_s": 11.5}, "shelf: cpu_s 11.5, was 10 (1.15 times)"),
        ({"ms_median": 90.0}, "shelf: ms_median 90, was 80"),
        ({"ate": 0.00215, "posed": 46, "cpu_s": 10.9, "ms_p95": 900.0}, ""),
        ({"ate": 0.001, "cpu_s": 1.0, "keyframes": 50}, ""),
    ],
    ids=str,
)
def test_a_change_of_a_tenth_is_reported(changes: dict[str, float], said: str) -> None:
    found = compare(record("b" * 40, **changes), [record()])
    assert len(found) == bool(said)
    if said:
        assert found[0].startswith(said)
        assert found[0].endswith("at aaaaaaaaaa of 2026-01-01 on one")


def test_an_undefined_error_and_a_map_of_a_static_camera_are_regressions() -> None:
    new = record()
    del new["sequences"]["shelf"]["ate"]
    new["sequences"]["still"]["posed"] = 3
    new["benchmarks"]["bundle"]["error"] = 0.6
    said = compare(new, [record()])
    assert [words.partition(",")[0] for words in said] == [
        "shelf: ate is undefined",
        "still: posed 3 frames of a sequence without a map",
        "bundle: error 0.6",
    ]


def test_times_are_compared_only_on_the_same_idle_machine() -> None:
    slow = record(cpu_s=20.0)
    assert len(compare(slow, [record()])) == 1
    assert not compare(slow, [record() | {"machine": "another"}])
    assert not compare(slow, [record(load=3.0)])
    assert not compare(slow | {"load": 3.0}, [record()])
    # ... while the last quiet one of this machine lies further back than others:
    assert len(compare(slow, [record(), record(load=3.0), record() | {"machine": "another"}])) == 1


def test_a_regression_is_reported_until_it_is_accepted() -> None:
    bad = record("b" * 40, ate=0.004)
    bad["worse"] = compare(bad, [record()])
    again = record("c" * 40, ate=0.004)
    assert "was 0.002" in compare(again, [record(), bad])[0]
    assert not compare(again, [record(), bad | {"accepted": "fewer wrong poses"}])
    other = copy.deepcopy(bad)
    other["sequences"]["still"]["posed"] = 2  # another sequence of a bad record still counts
    assert not [words for words in compare(other, [record(), other]) if words.startswith("still")]


def test_changed_bytes_and_missing_rows_are_named() -> None:
    new = record(trajectory="f" * 16)
    assert same_bytes(new, [record()]) == {"shelf": False, "still": True}
    del new["sequences"]["still"]
    assert missing(new, [record()]) == ["still"]


def test_a_damaged_history_is_refused_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "history.jsonl"
    append(record(), path)
    with path.open("a") as file:
        file.write('{"commit": "b"}\n')
    with pytest.raises(
        SystemExit, match=r"line 2: not a record: machine, load, sequences, benchmarks missing"
    ):
        read_history(path)


def test_a_row_has_the_metrics_and_a_hash_of_the_trajectory() -> None:
    first, second = rows.run_row(ROOM), rows.run_row(f"{ROOM}&seed=3")
    assert first["frames"] == 8
    assert first["posed"] > 0
    assert 0 < first["ate"] < 0.1 * first["extent"]
    assert first["config"] == second["config"]
    assert first["trajectory"] != second["trajectory"]
    assert 0 < first["ms_median"] <= first["ms_p95"] < 1e3 * first["cpu_s"]


def test_a_report_is_appended_compared_and_drawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    figures = iter([{}, {"ate": 0.003}, {"ate": 0.003}])
    monkeypatch.setattr(run, "run_row", lambda name: record(**next(figures))["sequences"]["shelf"])
    monkeypatch.setattr(run, "BENCHMARKS", {"bundle": lambda: {"error": 0.5, "ms": 900.0}})
    history, docs = tmp_path / "figures" / "history.jsonl", tmp_path / "docs"
    command = ["shelf", "--history", str(history), "--docs", str(docs)]
    assert run.main(command) == 0
    assert run.main(command) == 1
    assert "WORSE: shelf: ate 0.003, was 0.002 (1.50 times), at " in capsys.readouterr().out
    assert run.main([*command, "--accept", "for a reason"]) == 0
    cached_run = [json.loads(line) for line in history.read_text().splitlines()]
    assert [bool(line.get("worse")) for line in cached_run] == [False, True, True]
    assert cached_run[2]["accepted"] == "for a reason"
    assert len(cached_run[0]["commit"]) == 40
    assert cached_run[0]["versions"]["torch"]
    page = (docs / "history.md").read_text()
    assert "| shelf | 50 of 50 | 0.0030 | 0.60% |" in page
    assert "for a reason: shelf: ate 0.003, was 0.002" in page
    picture = docs / "images" / "history.png"
    before = picture.read_bytes()
    draw.write(read_history(history), docs)
    assert picture.read_bytes() == before


def test_a_report_names_commit_machine_and_versions() -> None:
    begun = beginning()
    assert len(begun["commit"]) == 40
    assert "processors" in begun["machine"]
    assert {"python", "torch", "numpy"} <= begun["versions"].keys()
