"""Errors in worker processes are reported in one way."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import sys
import time
import warnings
from collections.abc import Iterator
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess

import pytest
import torch

from torchslam.errors import FrameError
from torchslam.parallel.worker import READY, Worker, pack_task, requests, send_result, serve, try_call, unwrap


def fail(error: Exception) -> None:
    raise error


def test_results_round_trip_and_are_computed_in_inference_mode() -> None:
    assert unwrap(try_call("adds", lambda a, b: a + b, 1, 2)) == 3
    assert try_call("looks", torch.is_inference_mode_enabled) is True


def test_a_worker_error_is_raised_by_the_caller_with_its_traceback() -> None:
    answer = pickle.loads(pickle.dumps(try_call("reads ahead", fail, ZeroDivisionError("what is this?"))))
    with pytest.raises(ZeroDivisionError, match="what is this") as raised:
        unwrap(answer)
    (note,) = raised.value.__notes__
    assert note.startswith("in the process that reads ahead:\nTraceback")
    assert "in fail" in note


def test_own_errors_are_raised_without_a_traceback() -> None:
    with pytest.raises(FrameError) as raised:
        unwrap(try_call("reads ahead", fail, FrameError("frame 3 is damaged")))
    assert not hasattr(raised.value, "__notes__")


def test_a_worker_starts_with_its_task_and_ends_with_its_parent() -> None:
    ours, theirs = multiprocessing.Pipe()
    ours.send_bytes(pack_task("twice", 2))
    for number in (3, 4):
        ours.send_bytes(pickle.dumps(number))
    heard: list[object] = []

    def work(connection: Connection, name: str, factor: int) -> None:
        heard.append(ours.recv_bytes())
        for number in requests(connection):
            send_result(connection, (name, factor * number))
            heard.append(pickle.loads(ours.recv_bytes()))
            if number == 4:
                ours.close()

    serve(work, theirs)
    assert heard == [READY, ("twice", 6), ("twice", 8)]


def multiply(connection: Connection, factor: int) -> None:
    """Answer requests; an empty request ends the process as if it had been killed."""
    for number in requests(connection):
        if number is None:
            os.kill(os.getpid(), signal.SIGKILL)
        send_result(connection, (factor * number, torch.get_num_threads()))


@pytest.fixture(params=[True, False], ids=["copied", "spawned"])
def worker(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[Worker]:
    if request.param and sys.platform != "linux":
        pytest.skip("processes are copied on Linux alone")
    monkeypatch.setattr("torchslam.parallel.worker.starts_at_once", lambda: request.param)
    found = Worker(multiply)
    yield found
    found.end()


def helpers() -> list[BaseProcess]:
    return [process for process in multiprocessing.active_children() if process.name == "torchslam helper"]


def come(worker: Worker) -> None:
    end = time.monotonic() + 120
    while not worker.is_there():
        assert worker._process.exitcode is None, "it died"
        assert time.monotonic() < end, "it never came"
        time.sleep(0.01)


def test_a_worker_starts_answers_and_stops(worker: Worker) -> None:
    (process,) = helpers()
    assert process.daemon  # none outlives this one
    come(worker)
    assert worker.send(pack_task(3))
    for number in (1, 2):
        assert worker.send(pickle.dumps(number))
        assert worker.receive() == (3 * number, torch.get_num_threads())
    worker.end()
    assert not helpers()


def test_a_killed_worker_is_reported_once_and_skipped(worker: Worker) -> None:
    come(worker)
    assert worker.send(pack_task(3))
    assert worker.send(pickle.dumps(None))
    with pytest.warns(UserWarning, match=r"has ended \(-9\): going on without it"):
        assert worker.receive() is None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not worker.is_there()
        assert not worker.send(pickle.dumps(1))
        assert worker.receive() is None


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torchslam.parallel.worker.SILENCE", 1.0)
    monkeypatch.setattr("torchslam.parallel.worker.SILENCE_UNKNOWN", 1.0)
    monkeypatch.setattr("torchslam.parallel.worker.LOOK", 0.05)
    monkeypatch.setattr("torchslam.parallel.worker.END", 0.2)


@pytest.mark.skipif(not hasattr(signal, "SIGSTOP"), reason="processes cannot be stopped here")
@pytest.mark.usefixtures("impatient")
def test_a_stopped_worker_is_given_up(worker: Worker) -> None:
    come(worker)
    assert worker.send(pack_task(3))
    assert worker.send(pickle.dumps(1))
    assert worker.receive()[0] == 3
    (process,) = helpers()
    os.kill(process.pid, signal.SIGSTOP)
    assert worker.send(pickle.dumps(2))
    with pytest.warns(UserWarning, match="does not answer: going on without it"):
        assert worker.receive() is None
    assert worker.receive() is None  # nothing that it may have sent meanwhile
    assert not worker.send(pickle.dumps(3))
    assert not helpers()


@pytest.mark.skipif(not hasattr(signal, "SIGSTOP"), reason="processes cannot be stopped here")
@pytest.mark.usefixtures("impatient")
def test_a_stopped_worker_takes_no_message_for_ever_and_can_be_ended(worker: Worker) -> None:
    come(worker)
    assert worker.send(pack_task(3))
    (process,) = helpers()
    os.kill(process.pid, signal.SIGSTOP)
    with pytest.warns(UserWarning, match="does not answer: going on without it"):
        assert not worker.send(bytes(100_000_000))
    assert not helpers()


@pytest.mark.skipif(not hasattr(signal, "SIGSTOP"), reason="processes cannot be stopped here")
@pytest.mark.usefixtures("impatient")
def test_a_stopped_worker_can_be_ended(worker: Worker) -> None:
    come(worker)
    (process,) = helpers()
    os.kill(process.pid, signal.SIGSTOP)
    worker.end()
    assert not helpers()


def spin(connection: Connection, seconds: float) -> None:
    for _ in requests(connection):
        end = time.process_time() + seconds
        while time.process_time() < end:
            pass
        send_result(connection, "done")


@pytest.mark.usefixtures("impatient")
def test_a_worker_that_works_is_waited_for() -> None:
    worker = Worker(spin)
    try:
        come(worker)
        assert worker.send(pack_task(2.0))
        assert worker.send(pickle.dumps(0))
        assert worker.receive() == "done"
    finally:
        worker.end()


def test_nothing_is_sent_to_a_worker_before_it_is_ready() -> None:
    worker = Worker(multiply)
    try:
        assert not worker.send(pack_task(3))
        come(worker)
        assert worker.send(pack_task(4))
        assert worker.send(pickle.dumps(1))
        assert worker.receive() == (4, torch.get_num_threads())
    finally:
        worker.end()
