"""Worker processes answer calls, and are done without when they end."""

from __future__ import annotations

import inspect
import multiprocessing
import os
import signal
import struct
import subprocess
import sys
import textwrap
import time
import warnings
from collections.abc import Callable, Iterator
from functools import partial

import pytest
import torch
from torch import Tensor

from tests.parallel.conftest import usual_start
from torchslam.errors import FrameError
from torchslam.parallel.pool import WorkerLostError, WorkerPool

PATIENCE = 120.0  # seconds: torch is imported within two, on a machine with nothing else to do


def wait_until_ready(pool: WorkerPool) -> None:
    """Wait for all workers, which a run does not."""
    until = time.monotonic() + PATIENCE
    while not pool.is_ready or any(worker.task is not None for worker in pool._workers):
        assert time.monotonic() < until
        time.sleep(0.01)


def multiplier(factor: Tensor) -> Callable[..., object]:
    """Answers with a multiple and with what is set for the process; an empty call ends it as if it had been killed."""

    def answer(number: Tensor | None) -> tuple[Tensor, int, bool, int]:
        if number is None:
            os.kill(os.getpid(), signal.SIGKILL)
        return factor * number, torch.get_num_threads(), torch.is_inference_mode_enabled(), os.nice(0)

    return answer


def fail(error: Exception) -> None:
    raise error


@pytest.fixture
def pool(start_method: str) -> Iterator[WorkerPool]:
    with WorkerPool(1, multiplier, torch.tensor([2.0, 3.0]), niceness=3) as found:
        yield found


def ask(pool: WorkerPool, *question: object) -> object:
    call = pool.submit(*question)
    assert call is not None
    return pool.result(call)


def test_calls_are_answered_by_a_process_with_the_settings_of_this_one(pool: WorkerPool) -> None:
    wait_until_ready(pool)
    for number in (torch.eye(2), torch.ones(2, 2).T):
        product, *settings = ask(pool, number)
        assert torch.equal(product, torch.tensor([2.0, 3.0]) * number)
        assert settings == [torch.get_num_threads(), True, min(os.nice(0) + 3, 19)]
    pool.__exit__(None, None, None)
    assert multiprocessing.active_children() == []
    assert pool.submit(torch.eye(2)) is None


def test_no_call_is_accepted_before_a_new_interpreter_has_started(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torchslam.parallel.pool.can_fork", lambda: False)
    begun = time.monotonic()
    with WorkerPool(2, multiplier, torch.ones(1)) as pool:
        assert not pool.is_ready
        assert pool.submit(torch.eye(2)) is None
    assert time.monotonic() - begun < 1  # torch alone takes longer to import
    assert multiprocessing.active_children() == []
    with WorkerPool(0, multiplier, torch.ones(1)) as pool:
        assert pool.submit(torch.eye(2)) is None


@pytest.mark.skipif(sys.platform != "linux", reason="workers are forks on Linux alone")
def test_a_fork_accepts_calls_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torchslam.parallel.pool.can_fork", lambda: True)
    with WorkerPool(2, multiplier, torch.ones(1)) as pool:
        calls = [pool.submit(torch.full((2,), float(number))) for number in range(4)]
        assert len({call.worker.process.pid for call in calls if call is not None}) == 2
        for number, call in enumerate(calls):
            assert call is not None
            assert pool.result(call)[0].tolist() == [number, number]


@pytest.mark.skipif(sys.platform != "linux", reason="workers are forks on Linux alone")
def test_a_process_with_another_thread_is_not_forked() -> None:
    script = """
        import threading
        from torchslam.parallel.pool import can_fork
        print(can_fork())
        threading.Thread(target=threading.Event().wait, daemon=True).start()
        print(can_fork())
        """
    command = [sys.executable, "-c", textwrap.dedent(script)]
    alone = os.environ | {"OPENBLAS_NUM_THREADS": "1"}  # it begins its threads when NumPy is imported
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=alone)
    assert done.stdout.split() == ["True", "False"]


@pytest.mark.usefixtures("start_method")
@pytest.mark.parametrize("error", [ZeroDivisionError("what is this?"), FrameError("frame 3 is damaged")])
def test_an_error_is_raised_by_the_caller_with_its_traceback(error: Exception) -> None:
    with WorkerPool(1, partial, fail, error) as pool:
        wait_until_ready(pool)
        with pytest.raises(type(error), match=str(error)[:5]) as raised:
            ask(pool)
    assert "in fail" in str(raised.value.__cause__)


@usual_start
def test_a_killed_worker_is_reported_once(pool: WorkerPool) -> None:
    wait_until_ready(pool)
    calls = [pool.submit(None), pool.submit(torch.eye(2))]
    with pytest.warns(UserWarning, match="died; continuing without it"), pytest.raises(WorkerLostError):
        pool.result(calls[0])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(WorkerLostError):
            pool.result(calls[1])
        assert not pool.is_ready
        assert pool.submit(torch.eye(2)) is None


def test_a_new_interpreter_killed_while_it_starts_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torchslam.parallel.pool.can_fork", lambda: False)
    with WorkerPool(1, multiplier, torch.ones(1)) as pool:
        pool._workers[0].process.kill()
        pool._workers[0].process.join()
        with pytest.warns(UserWarning, match="died; continuing without it"):
            assert pool.submit(torch.eye(2)) is None


needs_stop = pytest.mark.skipif(not hasattr(signal, "SIGSTOP"), reason="processes cannot be stopped here")


@needs_stop
@usual_start
def test_a_stopped_worker_is_given_up(pool: WorkerPool, monkeypatch: pytest.MonkeyPatch) -> None:
    wait_until_ready(pool)
    (process,) = multiprocessing.active_children()
    os.kill(process.pid or 0, signal.SIGSTOP)
    call = pool.submit(torch.eye(2))
    assert call is not None
    monkeypatch.setattr("torchslam.parallel.pool.RESPONSE_TIMEOUT_S", 0.2)
    with (
        pytest.warns(UserWarning, match="does not answer; continuing without it"),
        pytest.raises(WorkerLostError),
    ):
        pool.result(call)
    assert pool.submit(torch.eye(2)) is None


def die(is_asked: bool) -> int:
    """End as if killed while the result is sent."""
    if not is_asked:
        return os.getpid()
    frame = inspect.currentframe()
    while frame is not None and "connection" not in frame.f_locals:
        frame = frame.f_back
    assert frame is not None
    os.write(frame.f_locals["connection"].fileno(), struct.pack("!i", 100) + b"half a result")
    os.kill(os.getpid(), signal.SIGKILL)
    return 0


@usual_start
@pytest.mark.usefixtures("start_method")
def test_a_worker_killed_while_it_sends_a_result_is_not_waited_for() -> None:
    with WorkerPool(2, partial, die) as pool:
        wait_until_ready(pool)
        first, second = pool.submit(True), pool.submit(False)
        assert first is not None
        assert second is not None
        with pytest.warns(UserWarning, match="died"), pytest.raises(WorkerLostError):
            pool.result(first)
        assert pool.result(second) == ask(pool, False) == second.worker.process.pid  # goes on
    assert multiprocessing.active_children() == []


@needs_stop
@usual_start
@pytest.mark.usefixtures("start_method")
def test_a_stopped_worker_takes_no_calls_larger_than_its_pipe(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torchslam.parallel.pool.RESPONSE_TIMEOUT_S", 0.5)
    with WorkerPool(1, multiplier, torch.ones(1)) as pool:
        wait_until_ready(pool)
        os.kill(pool._workers[0].process.pid or 0, signal.SIGSTOP)
        with pytest.warns(UserWarning, match="does not answer; continuing without it"):
            assert pool.submit(torch.zeros(10_000_000)) is None
        assert multiprocessing.active_children() == []


@needs_stop
@usual_start
@pytest.mark.usefixtures("start_method")
def test_a_worker_stopped_while_it_sends_a_result_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torchslam.parallel.pool.RESPONSE_TIMEOUT_S", 0.5)
    with WorkerPool(1, multiplier, torch.ones(1)) as pool:
        wait_until_ready(pool)
        call = pool.submit(torch.zeros(10_000_000))
        assert call is not None
        assert pool._workers[0].connection.poll(PATIENCE)  # it has begun
        os.kill(pool._workers[0].process.pid or 0, signal.SIGSTOP)
        with pytest.warns(UserWarning, match="does not answer"), pytest.raises(WorkerLostError):
            pool.result(call)


@usual_start
def test_a_worker_is_not_used_after_an_interrupt_within_a_message(
    pool: WorkerPool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(timeout: float) -> bool:
        worker.connection._recv(2)  # type: ignore[attr-defined]
        raise KeyboardInterrupt

    wait_until_ready(pool)
    (worker,) = pool._workers
    calls = [pool.submit(torch.eye(2)) for _ in range(2)]
    monkeypatch.setattr(worker, "receive", interrupted)
    with pytest.raises(KeyboardInterrupt):
        pool.result(calls[0])
    for call in calls:
        with pytest.raises(WorkerLostError):
            pool.result(call)
    assert pool.submit(torch.eye(2)) is None
    assert multiprocessing.active_children() == []


@needs_stop
@usual_start
def test_a_stopped_worker_can_be_ended(pool: WorkerPool) -> None:
    wait_until_ready(pool)
    os.kill(pool._workers[0].process.pid or 0, signal.SIGSTOP)
    for _ in range(4):
        assert pool.submit(torch.zeros(10)) is not None
    pool.__exit__(None, None, None)
    assert multiprocessing.active_children() == []


@usual_start
def test_large_calls_and_results_do_not_wait_for_each_other(pool: WorkerPool) -> None:
    wait_until_ready(pool)
    calls = [pool.submit(torch.full((500_000, 2), float(number))) for number in range(5)]
    for number, call in enumerate(calls):
        assert call is not None
        assert torch.equal(pool.result(call)[0][-1], number * torch.tensor([2.0, 3.0]))


@pytest.mark.parametrize("method", ["fork", pytest.param("spawn", marks=pytest.mark.slow)])
@pytest.mark.skipif(sys.platform != "linux", reason="workers are forks on Linux alone")
def test_a_program_that_does_not_end_its_workers_ends(method: str) -> None:
    script = f"""
        import os
        from functools import partial
        from torchslam.parallel import pool
        if __name__ == "__main__":
            pool.can_fork = lambda: {method == "fork"}
            workers = pool.WorkerPool(2, partial, os.getpid).__enter__()
            print("begun")
        """
    command = [sys.executable, "-c", textwrap.dedent(script)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=True)
    assert done.stdout.split() == ["begun"]  # once: forks write nothing of their parent's
