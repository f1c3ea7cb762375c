"""A pool of worker processes: calls are submitted now, and their results are used later.

A worker is a new interpreter, which takes seconds to import everything. Calls are answered in this process until a
worker is ready, and after one was killed or stopped.
"""

from __future__ import annotations

import io
import multiprocessing
import os
import pickle
import signal
import threading
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from multiprocessing import connection, resource_tracker
from multiprocessing.process import BaseProcess
from types import TracebackType
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor

RESPONSE_TIMEOUT_S = 60.0
"""A worker that was stopped is given up after this time; a frame or a local adjustment takes less than a second."""

AHEAD = 2
"""Tasks that each worker is sent at a time, so that it need not wait while this process does one of its own."""

_answer: Callable[..., object]
"""Answers the calls, in a worker."""


class WorkerLostError(Exception):
    """A worker was killed or does not answer: whoever needs its result computes it."""


@dataclass(eq=False)
class _Worker:
    """A worker process with an executor of its own: where one is lost, the others go on."""

    executor: ProcessPoolExecutor
    process: BaseProcess
    started: Future[int]

    @classmethod
    def spawn(cls, task: bytes) -> _Worker:
        """Begin to start a worker."""
        context, before = multiprocessing.get_context("spawn"), multiprocessing.active_children()
        executor = ProcessPoolExecutor(1, context, _begin, (task,))
        started = executor.submit(os.getpid)
        (process,) = (each for each in multiprocessing.active_children() if each not in before)
        # As long as this process could write to the pipe of the results, too, the executor would wait for ever for the
        # rest of a result whose sender was killed.
        executor._result_queue._writer.close()  # type: ignore[attr-defined]
        return cls(executor, process, started)

    def end(self) -> None:
        """End the process at once, also one that is still starting or was stopped."""
        self.process.kill()
        self.executor.shutdown()


class Call(NamedTuple):
    """A call that a worker answers."""

    worker: _Worker
    answer: Future[bytes]


class WorkerPool:
    """Worker processes that answer calls while this is entered.

    Args:
        count: Number of processes; with 0 no call is accepted.
        make: Called with the parts in each worker once, it returns the function that answers calls.
        parts: Arguments of `make`, pickled as it is.
        niceness: Of the workers, relative to this process.
    """

    def __init__(
        self, count: int, make: Callable[..., Callable[..., object]], *parts: object, niceness: int = 0
    ) -> None:
        self.count = count
        self._task = _pack((torch.get_num_threads(), niceness, make, parts))
        self._workers: deque[_Worker] = deque()

    def __enter__(self) -> Self:
        with _without_interrupts():
            for _ in range(self.count):
                self._workers.append(_Worker.spawn(self._task))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        while self._workers:
            self._workers.pop().end()

    @property
    def is_ready(self) -> bool:
        """Whether calls are accepted: a worker has started."""
        return any(each.started.done() for each in self._workers)

    def submit(self, *question: object) -> Call | None:
        """Begin a call, of the workers in turn; None if calls are not accepted."""
        for _ in range(len(self._workers)):
            worker = self._workers[0]
            self._workers.rotate(-1)
            if not worker.started.done():
                continue
            try:
                return Call(worker, worker.executor.submit(_call, _pack(question)))
            except BrokenProcessPool:
                self._lose(worker, "has ended")
        return None

    def result(self, call: Call) -> Any:
        """Wait for the result of a call.

        Raises:
            WorkerLostError: If there will be none.
            Exception: What the call raised, with its traceback as the cause.
        """
        if not wait([call.answer], RESPONSE_TIMEOUT_S).done:
            self._lose(call.worker, "does not answer")
            raise WorkerLostError
        try:
            return pickle.loads(call.answer.result())
        except BrokenProcessPool:
            self._lose(call.worker, "has ended")
            raise WorkerLostError from None

    def _lose(self, worker: _Worker, reason: str) -> None:
        """Go on without a worker, and warn once."""
        if worker in self._workers:
            self._workers.remove(worker)
            worker.end()
            warnings.warn(f"another process of this run {reason}: going on without it", stacklevel=3)


class SharedTasks(WorkerPool):
    """Workers that help this process with tasks while this is entered.

    Tasks that a worker did not finish, because it was killed, are done here.

    Args:
        do: (*parts, *task) -> None does a task; a function of a module, since workers import it.
        parts: what all tasks have in common.
        processes: number of processes, this one included.
    """

    def __init__(self, do: Callable[..., None], parts: tuple[Any, ...], processes: int) -> None:
        super().__init__(processes - 1, partial, do, *parts)
        self._do = partial(do, *parts)

    def run(self, tasks: Sequence[tuple[Any, ...]]) -> Iterator[None]:
        """Do all tasks; yields once after each.

        Raises what a task raises, here or in a worker.
        """
        waiting = deque(tasks)
        calls: dict[Call, tuple[Any, ...]] = {}
        while waiting or calls:
            while waiting and len(calls) < AHEAD * self.count:
                call = self.submit(*waiting[0])
                if call is None:
                    break
                calls[call] = waiting.popleft()
            if waiting:
                self._do(*waiting.popleft())
                yield
            else:
                wait([each.answer for each in calls], return_when=FIRST_COMPLETED)
            for call in [each for each in calls if each.answer.done()]:
                task = calls.pop(call)
                try:
                    self.result(call)
                except WorkerLostError:
                    waiting.append(task)
                else:
                    yield


@contextmanager
def _without_interrupts() -> Iterator[None]:
    """Start processes that ignore Ctrl-C and SIGTERM, which this process handles: it ends them.

    A process that SIGTERM ends while it starts would leave this one waiting: it writes what the process is to do into a
    pipe, whose other end it has open as well.
    """
    if not hasattr(signal, "pthread_sigmask"):  # not on Windows
        yield
        return
    resource_tracker.ensure_running()  # its start would let signals through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT, signal.SIGTERM])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class _Pickler(pickle.Pickler):
    """Pickles tensors as arrays, which is faster, and does not move them to shared memory as multiprocessing would."""

    def reducer_override(self, value: object) -> Any:
        if type(value) is Tensor and value.device.type == "cpu" and not value.requires_grad:
            return torch.from_numpy, (value.numpy(),)
        return NotImplemented


def _pack(value: object) -> bytes:
    packed = io.BytesIO()
    _Pickler(packed).dump(value)
    return packed.getvalue()


# --- in a worker -----------------------------------------------------------------------------------------------


def _begin(task: bytes) -> None:
    """Make the function that answers calls."""
    global _answer
    threading.Thread(target=_end_with_parent, daemon=True).start()
    threads, niceness, make, parts = pickle.loads(task)
    torch.set_num_threads(threads)
    if hasattr(os, "nice"):  # not on Windows
        os.nice(niceness)
    _answer = make(*parts)


def _end_with_parent() -> None:
    """End when the parent was killed: it left calls that nobody waits for, and workers would wait for more."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    connection.wait([parent.sentinel])
    os._exit(1)


def _call(question: bytes) -> bytes:
    with torch.inference_mode():
        return _pack(_answer(*pickle.loads(question)))
