"""What experiments run through batches: figures of rows, pieces that are kept, errors that end an experiment."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import pytest

from experiments.common import add_engine, available, metrics_of_runs, row_of
from experiments.trials import run as trials
from tests.batch.conftest import ROOM, SETTINGS
from torchslam.errors import SequenceError


def options(output: Path) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    add_engine(parser, "sweep")
    return parser.parse_args(["--output", str(output)])


def test_rows_are_run_once_and_have_metrics_and_times(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = [row_of(name, "short", overrides=SETTINGS) for name in available([ROOM, "nowhere at all"])]
    assert "nowhere at all: not at" in capsys.readouterr().out
    (first,) = metrics_of_runs(rows, options(tmp_path))
    assert first["posed"] == first["frames"] == 10
    assert first["cpu_s"] > 0
    assert first["ms_median"] > 0
    assert metrics_of_runs(rows, options(tmp_path)) == [first]  # the times too: nothing was run again
    with pytest.raises(SystemExit, match=r"room.*does not exist"):
        metrics_of_runs([*rows, row_of("/nowhere/room")], options(tmp_path))


def attempted(monkeypatch: pytest.MonkeyPatch, output: Path, *more: str) -> None:
    arguments = ["run", "plain/fr2_desk_20", "--no-readme", "--output", str(output), *more]
    monkeypatch.setattr(sys, "argv", arguments)
    monkeypatch.setattr("experiments.common.DATA_DIR", Path("/nowhere"))  # else all of it is looked at
    trials.main()


def test_a_trial_without_frames_is_skipped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    tries: list[list[str]] = []

    def missing(trial: object, settings: list[str]) -> None:
        tries.append(settings)
        raise SequenceError("not here")

    monkeypatch.setattr(trials, "perform", missing)
    attempted(monkeypatch, tmp_path)
    assert "plain/fr2_desk_20: left out: not here" in capsys.readouterr().out
    monkeypatch.setattr(trials, "perform", lambda trial, settings: (tries.append(settings), None))
    monkeypatch.setattr(trials, "cells", lambda name, outcome, unit: [name, "20 of 20"])
    for _ in range(2):
        attempted(monkeypatch, tmp_path / "a")
        assert capsys.readouterr().out == "plain/fr2_desk_20 | 20 of 20\n"
    attempted(monkeypatch, tmp_path / "a", "--set", "seed=1")
    assert tries == [[], [], ["seed=1"]]


def test_a_failing_trial_ends_with_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def wrong(trial: object, settings: list[str]) -> None:
        raise AssertionError("no pose any more")

    monkeypatch.setattr(trials, "perform", wrong)
    with pytest.raises(SystemExit, match="AssertionError: no pose any more"):
        attempted(monkeypatch, tmp_path)
