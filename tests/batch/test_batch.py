"""Batches: alone and in shards, killed and gone on with, with rows that fail; always the same bytes."""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.batch.conftest import LIST, OPTIONS, ROOM, SETTINGS, STATUSES, batch, content, table, task
from tests.cli.conftest import write_tum_folder
from tests.fuzz import valid_inputs
from torchslam.batch import Engine, Row, Task, run_batch, run_row
from torchslam.batch import results_table as tables
from torchslam.batch.result_store import ERRORS, RECORD, RUNS, hash_files
from torchslam.batch.task import _input
from torchslam.cli.main import main
from torchslam.errors import ConfigError


def times_of_change(output: Path) -> dict[str, int]:
    return {path.parent.name: path.stat().st_mtime_ns for path in output.glob(f"{RUNS}/*/{RECORD}")}


# --- a whole batch -------------------------------------------------------------------------------------------


def test_the_table_has_a_row_for_each_sequence_with_status_and_error(whole: Path) -> None:
    rows = table(whole)
    assert [row["name"] for row in rows] == ["one", "two", "three", "four", "five"]
    assert [row["status"] for row in rows] == STATUSES
    assert "does not exist" in rows[2]["error"]
    assert "features.num_keypoints must be at least 1" in rows[3]["error"]
    assert "stands still" in rows[4]["error"]
    figures = json.loads((whole / RUNS / "one" / "metrics.json").read_text())
    assert float(rows[0]["ate_m"]) == figures["ate_m"] > 0
    assert int(rows[0]["posed"]) == figures["posed"] == 10
    assert rows[2]["ate_m"] == rows[4]["ate_m"] == ""
    assert rows[0]["configuration"] != rows[1]["configuration"]
    assert {path.name for path in (whole / ERRORS).iterdir()} == {"three.json", "four.json"}
    assert {path.name for path in (whole / RUNS).iterdir()} == {"one", "two", "five"}


def test_the_parquet_table_has_the_same_values(whole: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    rows = parquet.read_table(whole / "table.parquet").to_pylist()
    assert [row["status"] for row in rows] == STATUSES
    assert [row["ate_m"] for row in rows[:3]] == [*(float(row["ate_m"]) for row in table(whole)[:2]), None]
    assert rows[0]["posed"] == 10


def test_without_pyarrow_there_is_no_parquet(
    listed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    run_batch([task(tmp_path, "missing")])
    assert (tmp_path / "table.csv").exists()
    assert not (tmp_path / "table.parquet").exists()


def test_times_are_in_files_of_their_own(whole: Path) -> None:
    times = json.loads((whole / RUNS / "one" / "times.json").read_text())
    assert times["fps"] > 0
    assert times["cpu_s"] > 0
    assert "total" in times["stage_ms"]
    with (whole / "times.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [bool(row["fps"]) for row in rows] == [True, True, False, False, True]
    assert "fps" not in json.loads((whole / RUNS / "one" / "metrics.json").read_text())


@pytest.mark.usefixtures("without_pictures")
def test_the_results_equal_those_of_a_run(whole: Path, tmp_path: Path) -> None:
    settings = [part for setting in SETTINGS for part in ("--set", setting)]
    assert main(["run", ROOM, "--output", str(tmp_path), *settings]) == 0
    names = ("trajectory.txt", "online.txt", "keyframes.txt", "map.safetensors", "map.ply", "config.toml")
    for name in names:
        assert (tmp_path / name).read_bytes() == (whole / RUNS / "one" / name).read_bytes(), name


# --- what is done is not done again --------------------------------------------------------------------------


def test_finished_rows_are_not_repeated(
    whole: Path, listed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    again = tmp_path / "again"
    shutil.copytree(whole, again)
    assert batch(listed, again) == 4
    said = capsys.readouterr()
    assert "3 of them already existed" in said.out
    assert "torchslam: 1/5 one: 10 of 10 frames posed" in said.err
    assert times_of_change(again) == times_of_change(whole)
    assert content(again) == content(whole)


def test_failed_rows_are_retried(whole: Path, tmp_path: Path) -> None:
    shutil.copytree(whole, tmp_path / "again")
    listed = tmp_path / "list.csv"
    listed.write_text(LIST)
    write_tum_folder(tmp_path / "missing" / "folder", frames=2)
    listed.write_text("sequence,name\nmissing/folder,three\n")
    assert batch(listed, tmp_path / "again", ["--set", "features.kind=opencv-orb"]) == 0
    assert not (tmp_path / "again" / ERRORS / "three.json").exists()
    assert [row["status"] for row in table(tmp_path / "again")] == ["no map"]


def test_changed_settings_need_overwrite(tmp_path: Path) -> None:
    assert run_row(task(tmp_path).as_dict())["is_new"]
    before = content(tmp_path)
    other = Task(Row("mine", ROOM, overrides=(*SETTINGS, "seed=9")), str(tmp_path), plots=False)
    refused = run_row(other.as_dict())
    assert refused["status"] == "error"
    assert "--overwrite" in refused["error"]
    assert {name: content(tmp_path)[name] for name in before} == before
    replaced = run_row(Task(other.row, str(tmp_path), overwrite=True, plots=False).as_dict())
    assert replaced["status"] == "done"
    assert "seed = 9" in (tmp_path / RUNS / "mine" / "config.toml").read_text()
    assert [path.name for path in (tmp_path / RUNS).iterdir()] == ["mine"]
    assert list((tmp_path / ERRORS).iterdir()) == []


def test_an_unrelated_folder_is_never_replaced(tmp_path: Path) -> None:
    (tmp_path / RUNS / "mine").mkdir(parents=True)
    (tmp_path / RUNS / "mine" / "thesis.tex").write_text("years of work")
    refused = run_row(Task(task(tmp_path).row, str(tmp_path), overwrite=True, plots=False).as_dict())
    assert "not results of a batch" in refused["error"]
    assert (tmp_path / RUNS / "mine" / "thesis.tex").exists()
    for text in ("{", "[]", '{"status": 3}'):
        (tmp_path / RUNS / "mine" / RECORD).write_text(text)
        assert RECORD in run_row(task(tmp_path).as_dict())["error"]


def test_files_of_a_sequence_are_fingerprinted_by_name_size_and_time(tmp_path: Path) -> None:
    folder = tmp_path / "a"
    (folder / "rgb").mkdir(parents=True)
    (folder / "rgb" / "0.png").write_bytes(b"1")
    (folder / "nowhere").symlink_to(tmp_path / "nothing")
    first = hash_files([str(folder)])
    assert hash_files([str(folder)]) == first
    assert hash_files([str(folder), str(tmp_path / "missing")]) != first
    os.utime(folder / "rgb" / "0.png", ns=(1, 1))
    second = hash_files([str(folder)])
    assert second != first
    (folder / "rgb" / "1.png").write_bytes(b"1")
    assert hash_files([str(folder)]) not in (first, second)
    assert hash_files([str(folder / "rgb" / "*.png")]) != hash_files([str(folder / "rgb" / "0*.png")])
    assert hash_files(["synthetic:room"]) != hash_files(["synthetic:planar"])


def test_files_with_measurements_are_fingerprinted(tmp_path: Path) -> None:
    """Those of depth images that a list names as well, and what lies beside the samples of an inertial sensor."""
    for name, data in valid_inputs.depth_images().items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(data)
    (tmp_path / "v.csv").write_text("0 1\n1 1\n")

    def found(*settings: str) -> str:
        row = Row("mine", ROOM, overrides=(*SETTINGS, *settings))
        return _input(Task(row, str(tmp_path)))

    options = {
        "v.csv": [f'metric.speed="{tmp_path / "v.csv"}"'],
        "depth/1.png": [f'metric.depth="{tmp_path}:5000"'],
        "imu.yaml": [f'metric.imu="{tmp_path / "v.csv"}"'],
    }
    for name, settings in options.items():
        first = found(*settings)
        assert first not in (found(), found("metric.depth=auto"))
        (tmp_path / name).write_text("other")
        assert found(*settings) != first
    assert found("metric.depth=auto") == found()


# --- shards, kills -------------------------------------------------------------------------------------------


def test_shards_together_equal_the_whole(whole: Path, listed: Path, tmp_path: Path) -> None:
    statuses = []
    for shard in ("2/3", "0/3", "1/3"):
        batch(listed, tmp_path, ["--shard", shard])
        statuses.append([row["status"] for row in table(tmp_path)])
    assert statuses[0] == ["open", "open", "error", "open", "open"]
    assert statuses[1] == ["done", "open", "error", "error", "open"]
    assert content(tmp_path) == content(whole)


def test_the_final_table_has_the_rows_of_all_shards(
    whole: Path, listed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another shard finishes a row, and writes the table, between this one's look at the results and its writing."""
    late = whole / RUNS / "two"
    put = tables._put

    def slow(path: Path, content: bytes) -> None:
        if path.name == "table.csv" and not (tmp_path / RUNS / "two").exists():
            shutil.copytree(late, tmp_path / RUNS / "two")
        put(path, content)

    monkeypatch.setattr(tables, "_put", slow)
    batch(listed, tmp_path, ["--shard", "0/5"])
    assert [row["status"] for row in table(tmp_path)][:2] == ["done", "done"]


def until(happens: object, patience: float = 120.0) -> None:
    end = time.monotonic() + patience
    while not happens():  # type: ignore[operator]
        assert time.monotonic() < end, "it took too long"
        time.sleep(0.01)


def test_a_killed_batch_can_be_restarted(whole: Path, listed: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "torchslam.cli.main", "batch", str(listed), "-o", str(tmp_path)]
    process = subprocess.Popen([*command, *OPTIONS], stderr=subprocess.DEVNULL)
    # The second sequence is being run: its folder has begun.
    until(lambda: (tmp_path / RUNS / "one").exists() and (tmp_path / RUNS / ".two.part").exists())
    process.kill()
    process.wait()
    assert not (tmp_path / RUNS / "two").exists()
    first = times_of_change(tmp_path)["one"]
    assert batch(listed, tmp_path) == 4
    assert times_of_change(tmp_path)["one"] == first
    assert content(tmp_path) == content(whole)


@pytest.mark.parametrize(("number", "status"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_an_interrupt_keeps_finished_rows_only(
    whole: Path,
    listed: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    number: int,
    status: int,
) -> None:
    shutil.copytree(whole / RUNS / "one", tmp_path / RUNS / "one")
    monkeypatch.setattr("torchslam.batch.task._run", lambda todo, folder: os.kill(os.getpid(), number))
    before = signal.getsignal(number)
    with pytest.raises(SystemExit, match=str(status)):
        batch(listed, tmp_path)
    assert signal.getsignal(number) is before
    assert "run the same command to continue" in capsys.readouterr().err
    assert [path.name for path in (tmp_path / RUNS).iterdir()] == ["one"]
    assert not (tmp_path / ERRORS).exists()


# --- the command ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--workers", "2"], "need --engine ray"),
        (["--address", "auto"], "need --engine ray"),
        (["--shard", "5/5"], "shards count from 0/5"),
        (["--set", "seed=-1"], "seed must be"),
    ],
)
def test_errors_of_the_batch_are_one_line_with_status_2(
    listed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], more: list[str], message: str
) -> None:
    assert batch(listed, tmp_path, more) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / RUNS).exists()


def test_a_missing_ray_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ConfigError, match=r"pip install 'torchslam\[ray\]'"):
        list(Engine("ray").map_unordered(run_row, [{}]))
