"""A pool of worker processes: calls are submitted now, and their results are used later.

On Linux, a process with a single thread forks its workers, which are ready at once. Elsewhere a worker is a new
interpreter, which takes seconds to import everything. Calls are answered in this process until a worker is ready, and
after one was killed or stopped.
"""

from __future__ import annotations

import atexit
import gc
import io
import multiprocessing
import os
import pickle
import queue
import signal
import socket
import struct
import sys
import threading
import traceback
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any, Self

import torch
from torch import Tensor

from torchslam.utils.forks import close_decoders
from torchslam.utils.memory import keep_freed_memory

RESPONSE_TIMEOUT_S = 60.0
"""A worker that was stopped is given up after this time; a frame or a local adjustment takes less than a second."""
AHEAD = 2
"""Short tasks that each worker is sent at a time, so that it need not wait while this process does one of its own."""


class WorkerLostError(Exception):
    """A worker was killed or does not answer: whoever needs its result computes it."""


class RemoteError(Exception):
    """Traceback of an exception in a worker, as the cause of the exception raised here."""


@dataclass(eq=False)
class Call:
    """A call that a worker answers."""

    worker: _Worker
    answer: bytes | None = None


@dataclass(eq=False)
class _Worker:
    """A worker process, which answers calls in their order, and the connection to it.

    task: for the worker to begin with, until it was sent; waiting: calls without an answer
    """

    process: BaseProcess
    connection: Connection
    task: bytes | None
    waiting: deque[Call] = field(default_factory=deque)

    @classmethod
    def start(cls, task: bytes) -> _Worker:
        """Fork a worker, or begin to start a new interpreter."""
        ours, theirs = multiprocessing.Pipe()
        process: BaseProcess
        if is_forked := can_fork():
            fork = multiprocessing.get_context("fork")
            process = fork.Process(target=_serve_in_fork, args=(theirs, ours, task), daemon=True)
        else:
            spawn = multiprocessing.get_context("spawn")
            process = spawn.Process(target=_serve_when_imported, args=(theirs,), daemon=True)
        process.start()
        theirs.close()  # the end of the process is to be the end of the connection; later forks would have it open, too
        _limit_waiting(ours)
        return cls(process, ours, None if is_forked else task)

    def is_ready(self) -> bool:
        """Return whether calls are accepted. Raises OSError or EOFError if the process has ended."""
        if self.task is not None and self.connection.poll():
            self.connection.recv_bytes()  # its imports are done
            self.connection.send_bytes(self.task)
            self.task = None
        return self.task is None

    def send(self, question: bytes) -> Call:
        """Send a call. Raises OSError if the process has ended, BlockingIOError if it takes nothing."""
        self.connection.send_bytes(question)
        self.waiting.append(call := Call(self))
        return call

    def receive(self, timeout: float | None) -> bool:
        """Receive the answer of the first call that has none; return False if it does not come in time.

        Raises OSError or EOFError if the process has ended, BlockingIOError if it stopped within an answer.
        """
        if not self.connection.poll(timeout):
            return False
        self.waiting.popleft().answer = self.connection.recv_bytes()
        return True

    def end(self) -> None:
        """End the process at once, also one that is still starting or was stopped."""
        self.process.kill()
        self.process.join()
        self.connection.close()


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
        if self.count > 0:
            close_decoders()
        atexit.register(self._end)  # before multiprocessing waits for processes that wait for calls
        try:
            with _without_interrupts():
                for _ in range(self.count):
                    self._workers.append(_Worker.start(self._task))
        except BaseException:
            self._end()
            raise
        return self

    def __exit__(self, *error: object) -> None:
        self._end()

    def _end(self) -> None:
        while self._workers:
            self._workers.pop().end()
        atexit.unregister(self._end)

    @property
    def is_ready(self) -> bool:
        """Whether calls are accepted: a worker has started."""
        return len([each for each in list(self._workers) if self._is_ready(each)]) > 0

    def submit(self, *question: object) -> Call | None:
        """Begin a call, of the workers in turn; None if calls are not accepted."""
        if not self.is_ready:
            return None
        packed = _pack(question)
        for _ in range(len(self._workers)):
            worker = self._workers[0]
            self._workers.rotate(-1)
            if worker.task is not None:
                continue
            with self._lost_on_error(worker):
                return worker.send(packed)
        return None

    def result(self, call: Call) -> Any:
        """Wait for the result of a call.

        Raises WorkerLostError if there will be none, and what the call raised, with its traceback as the cause.
        """
        while call.answer is None:
            if call.worker not in self._workers:
                raise WorkerLostError
            with self._lost_on_error(call.worker):
                if not call.worker.receive(RESPONSE_TIMEOUT_S):
                    raise BlockingIOError
        found, trace = pickle.loads(call.answer)
        if trace:
            raise found from RemoteError(trace)
        return found

    def result_or(self, call: Call | None, here: Callable[[], Any]) -> Any:
        """Wait for the result of a call; return that of `here` if it was not accepted, or if its worker was lost."""
        if call is not None:
            with suppress(WorkerLostError):
                return self.result(call)
        return here()

    def has_answer(self, call: Call, timeout: float | None) -> bool:
        """Whether `result` returns or raises at once, after some seconds at most, or however many if None."""
        while call.answer is None and call.worker in self._workers:
            with self._lost_on_error(call.worker):
                if not call.worker.receive(timeout):
                    return False
        return True

    def _is_ready(self, worker: _Worker) -> bool:
        with self._lost_on_error(worker):
            return worker.is_ready()
        return False

    @contextmanager
    def _lost_on_error(self, worker: _Worker) -> Iterator[None]:
        """Warn and go on without a worker that has ended or does not answer.

        After Ctrl-C the worker is not used either: the next message would begin in the middle of this one.
        """
        try:
            yield
        except BaseException as error:
            self._workers.remove(worker)
            worker.end()
            if not isinstance(error, OSError | EOFError):
                raise
            reason = "does not answer" if isinstance(error, BlockingIOError) else "died"
            warnings.warn(f"a worker process {reason}; continuing without it", stacklevel=4)


class SharedTasks(WorkerPool):
    """Workers that help this process with tasks while this is entered; what a killed one left undone is done here.

    Args:
        do: (*parts, *task) does a task; a function of a module, since workers import it.
        parts: what all tasks have in common.
        processes: number of processes, this one included.
        ahead: tasks that each worker is sent at a time; 1 where tasks are few and long.
    """

    def __init__(
        self, do: Callable[..., Any], parts: tuple[Any, ...], processes: int, ahead: int = AHEAD
    ) -> None:
        super().__init__(processes - 1, partial, do, *parts)
        self._do, self._ahead = partial(do, *parts), ahead

    def run(self, tasks: Sequence[tuple[Any, ...]]) -> Iterator[tuple[int, Any]]:
        """Do all tasks; yields the number of each with its result, in the order in which they end.

        Raises what a task raises, here or in a worker.
        """
        waiting, calls = deque(enumerate(tasks)), list[tuple[Call, int]]()
        while waiting or calls:
            while waiting and len(calls) < self._ahead * self.count:
                call = self.submit(*waiting[0][1])
                if call is None:
                    break
                calls.append((call, waiting.popleft()[0]))
            if waiting:
                number, task = waiting.popleft()
                yield number, self._do(*task)
            asked, timeout = (calls, 0) if waiting else (calls[:1], None)
            for each in [each for each in asked if self.has_answer(each[0], timeout)]:
                calls.remove(each)
                yield each[1], self.result_or(each[0], partial(self._do, *tasks[each[1]]))


def can_fork() -> bool:
    """Return whether this process may be forked: a lock that another thread holds would stay locked in the fork.

    The use of a GPU does not survive a fork either. Elsewhere than on Linux the system's libraries may have threads.
    """
    if sys.platform != "linux" or torch.cuda.is_initialized():
        return False
    return len(os.listdir("/proc/self/task")) == 1  # an entry for each thread


@contextmanager
def _without_interrupts() -> Iterator[None]:
    """Start processes that ignore Ctrl-C and SIGTERM, which this process handles: it ends them.

    A new interpreter that SIGTERM ends while it starts would leave this process waiting: it writes what to import into
    a pipe, whose other end it has open as well.
    """
    if not hasattr(signal, "pthread_sigmask"):  # not on Windows
        yield
        return
    if not can_fork():
        resource_tracker.ensure_running()  # its start would let signals through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT, signal.SIGTERM])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _limit_waiting(connection: Connection) -> None:
    """Let reading and writing within a message fail with BlockingIOError after RESPONSE_TIMEOUT_S without progress.

    Only where the connection is a socket: on Windows processes cannot be stopped.
    """
    if sys.platform == "win32":
        return
    limit = struct.pack("@ll", *divmod(round(1e6 * RESPONSE_TIMEOUT_S), 1_000_000))  # timeval: socket(7)
    with socket.socket(fileno=os.dup(connection.fileno())) as shared:
        shared.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, limit)
        shared.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, limit)


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


def _serve_in_fork(theirs: Connection, ours: Connection, task: bytes) -> None:
    """Answer calls in a fork of the process that asks."""
    ours.close()  # so that the end of the parent is the end of the connection
    gc.freeze()  # nothing of the parent is finalized here, and its memory stays shared
    _serve(theirs, task)


def _serve_when_imported(connection: Connection) -> None:
    """Answer calls in a new interpreter, which has imported everything to find this function."""
    keep_freed_memory()
    connection.send_bytes(b"")
    _serve(connection, connection.recv_bytes())


def _serve(connection: Connection, task: bytes) -> None:
    """Answer calls. Threads receive and send, so that neither process waits for the other one to receive."""
    received: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    answers: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    for ends in ((connection.recv_bytes, received.put), (answers.get, connection.send_bytes)):
        threading.Thread(target=_forward, args=ends, daemon=True).start()
    threads, niceness, make, parts = pickle.loads(task)
    torch.set_num_threads(threads)
    if hasattr(os, "nice"):  # not on Windows
        os.nice(niceness)
    answer = make(*parts)
    while True:
        question = received.get()
        try:
            with torch.inference_mode():
                answers.put(_pack((answer(*pickle.loads(question)), "")))
        except Exception as error:
            answers.put(_pack((error, traceback.format_exc())))


def _forward(take: Callable[[], bytes], give: Callable[[bytes], object]) -> None:
    """Pass messages on; end with the parent, which may have been killed: nobody waits for the answers."""
    try:
        while True:
            give(take())
    except (OSError, EOFError):
        os._exit(1)
