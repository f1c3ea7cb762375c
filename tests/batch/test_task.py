"""One row of a batch: no error leaves it, one thread, corrupt images, a ground truth of its own."""

from __future__ import annotations

import json
import os
import pickle
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tests.batch.conftest import table, task
from tests.cli.conftest import write_tum_folder
from torchslam.batch import Row, Task, run_row
from torchslam.batch.result_store import ERRORS, RUNS, run_or_reuse
from torchslam.data import read_trajectory, write_trajectory


def test_a_task_round_trips_through_text_and_pickle(tmp_path: Path) -> None:
    first = task(tmp_path, limit=3)
    assert Task.from_dict(json.loads(json.dumps(first.as_dict()))) == first
    assert pickle.loads(pickle.dumps(run_row)) is run_row


def test_a_row_uses_one_thread_and_restores_the_setting(tmp_path: Path) -> None:
    seen: list[int] = []

    def work(folder: Path) -> dict[str, object]:
        seen.append(torch.get_num_threads())
        return {"status": "done"}

    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("torchslam.batch.task._run", lambda todo, folder: work(folder))
            run_row(task(tmp_path).as_dict())
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
    assert seen == [1]


def test_a_row_catches_errors_but_not_interrupts(tmp_path: Path) -> None:
    def bug(folder: Path) -> dict[str, object]:
        (folder / "half").write_text("written")
        raise ZeroDivisionError("float division\nby zero")

    columns = run_or_reuse(tmp_path, "mine", dict, bug)
    assert columns["status"] == "error"
    assert columns["error"].startswith("ZeroDivisionError: float division by zero (test_task.py:")
    assert "Traceback" in json.loads((tmp_path / ERRORS / "mine.json").read_text())["traceback"]

    def stop(folder: Path) -> dict[str, object]:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_or_reuse(tmp_path, "mine", dict, stop)
    assert list((tmp_path / RUNS).iterdir()) == []


def test_a_write_error_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    columns = run_row(task(tmp_path / "file").as_dict())
    assert columns["status"] == "error"
    assert "could not be written" in columns["error"]


def test_corrupt_images_are_counted(tmp_path: Path) -> None:
    folder = write_tum_folder(tmp_path / "room", frames=3)
    (folder / "rgb" / "1.png").write_bytes(b"no image")
    fast = ("features.kind=opencv-orb", "features.num_keypoints=300")
    row = Row("mine", str(folder), overrides=fast)
    columns = run_row(Task(row, str(tmp_path), plots=False).as_dict())
    assert (columns["status"], columns["frames"], columns["skipped"]) == ("no map", 3, 1)
    for image in (folder / "rgb").iterdir():
        image.write_bytes(b"no image")
    columns = run_row(Task(row, str(tmp_path / "all"), plots=False).as_dict())
    assert columns["status"] in ("error", "no map")
    assert columns["error"]


@pytest.mark.parametrize("setting", ["features.weights", "matching.weights"])
def test_the_fingerprint_depends_on_the_weights(
    setting: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torchslam.batch.task._run", lambda todo, folder: {"status": "done"})
    weights = tmp_path / "a.safetensors"
    row = Row("mine", "synthetic:room", overrides=(f'{setting}="{weights}"',))
    todo = Task(row, str(tmp_path / "batch"), plots=False)
    statuses = []
    for content in (None, b"first", b"first", b"another"):
        if content is not None:
            weights.write_bytes(content)
            os.utime(weights, ns=(1, 1))
        replaced = replace(todo, overwrite=content == b"first").as_dict()
        columns = [run_row(replaced), run_row(todo.as_dict())]
        statuses.append([(each["status"], each["is_new"]) for each in columns])
    known, new, stale = ("done", False), ("done", True), ("error", True)
    assert statuses == [[new, known], [new, known], [known, known], [stale, stale]]


def test_live_sources_are_refused(tmp_path: Path) -> None:
    assert "a live source has no end" in run_row(task(tmp_path, "rtsp://127.0.0.1/a").as_dict())["error"]


def test_ground_truth_from_a_file_of_its_own(whole: Path, tmp_path: Path) -> None:
    truth = read_trajectory(whole / RUNS / "one" / "groundtruth.txt")
    T_wc = truth.T_wc.clone()
    T_wc[:, :3, 3] *= 10
    write_trajectory(tmp_path / "t.txt", type(truth)(truth.timestamps, T_wc))
    columns = run_row(task(tmp_path, groundtruth=str(tmp_path / "t.txt")).as_dict())
    assert columns["path_length_m"] == pytest.approx(10 * float(table(whole)[0]["path_length_m"]), rel=1e-6)
    columns = run_row(task(tmp_path / "b", groundtruth="none.txt", folder=str(tmp_path)).as_dict())
    assert "none.txt: cannot be read" in columns["error"]
