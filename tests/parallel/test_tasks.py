"""Tasks shared between this process and workers: each is done once, whatever becomes of the workers."""

from __future__ import annotations

import os
import signal
import sys
import time
import warnings
from pathlib import Path

import pytest

from tests.parallel.conftest import usual_start
from tests.parallel.test_pool import wait_until_ready
from torchslam.errors import FrameError
from torchslam.parallel.pool import SharedTasks

TASKS = [(number,) for number in range(12)]


def note(folder: Path, number: int) -> None:
    """Write the number of the process that did a task; each task may be done once."""
    with (folder / str(number)).open("x") as file:
        file.write(str(os.getpid()))
    time.sleep(0.02)


def die_elsewhere(folder: Path, main: int, number: int) -> None:
    if os.getpid() != main:
        os.kill(os.getpid(), signal.SIGKILL)
    note(folder, number)


def fail_elsewhere(folder: Path, main: int, number: int) -> None:
    if os.getpid() != main:
        raise FrameError(f"task {number}")
    note(folder, number)


@pytest.mark.parametrize(("method", "processes"), [("fork", 1), ("fork", 3), ("spawn", 2)])
def test_each_task_is_done_once_by_all_processes(
    tmp_path: Path, method: str, processes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "torchslam.parallel.pool.can_fork", lambda: method == "fork" and sys.platform == "linux"
    )
    with SharedTasks(note, (tmp_path,), processes) as shared:
        if processes > 1:
            wait_until_ready(shared)
        assert sum(1 for _ in shared.run(TASKS)) == len(TASKS)
        assert list(shared.run([])) == []
    by = {path.name: path.read_text() for path in tmp_path.iterdir()}
    assert by.keys() == {str(number) for (number,) in TASKS}
    assert len(set(by.values())) == processes
    assert str(os.getpid()) in by.values()


@usual_start
@pytest.mark.usefixtures("start_method")
def test_the_tasks_of_a_killed_worker_are_done_here(tmp_path: Path) -> None:
    with SharedTasks(die_elsewhere, (tmp_path, os.getpid()), 3) as shared:
        wait_until_ready(shared)
        with pytest.warns(UserWarning, match="continuing without it"):
            assert sum(1 for _ in shared.run(TASKS)) == len(TASKS)
    assert {path.read_text() for path in tmp_path.iterdir()} == {str(os.getpid())}
    assert len(list(tmp_path.iterdir())) == len(TASKS)


@usual_start
@pytest.mark.usefixtures("start_method")
def test_an_error_of_a_worker_is_raised_here(tmp_path: Path) -> None:
    with SharedTasks(fail_elsewhere, (tmp_path, os.getpid()), 2) as shared:
        wait_until_ready(shared)
        with warnings.catch_warnings(), pytest.raises(FrameError, match="task"):
            list(shared.run(TASKS))
