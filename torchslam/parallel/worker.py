"""A worker process with a pipe to it: start, request, receive, detect its end, stop; and the loop that it runs.

It is forked where that is safe, which takes no time; elsewhere a new interpreter has to import everything.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import socket
import struct
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import torch

from torchslam.errors import TorchslamError

READY = b""  # first message of a worker
THREADS = Path("/proc/self/task")  # one entry each, on Linux
SILENCE = 10.0
"""Seconds without an answer, and without use of the processor, after which a worker is given up."""
SILENCE_UNKNOWN = 60.0
"""The same where the system does not tell how much of the processor a process used."""
LOOK = 0.5  # seconds from one look at its use of the processor to the next
END = 5.0  # seconds in which a process that is told to end has to


def starts_at_once() -> bool:
    """Return True if workers may be forked: a lock that another thread holds would stay locked in the fork.

    The use of a GPU does not survive a fork either. Elsewhere than on Linux the system's own libraries may hold locks.
    """
    return sys.platform == "linux" and len(list(THREADS.iterdir())) == 1 and not torch.cuda.is_initialized()


class Worker:
    """A process that does `work` at the other end of a pipe, once it is READY and was sent its task.

    Args:
        work: (connection, *task) -> None, which returns when the pipe is closed
    """

    def __init__(self, work: Callable[..., None]) -> None:
        self._ours, theirs = multiprocessing.Pipe()
        # What it needs comes through the pipe: `start` would wait for ever for a process that dies before it reads.
        name = "torchslam helper"
        self._process: BaseProcess
        is_copied = starts_at_once()
        if is_copied:
            fork = multiprocessing.get_context("fork")
            self._process = fork.Process(
                target=_copied, args=(work, theirs, self._ours), name=name, daemon=True
            )
        else:
            spawn = multiprocessing.get_context("spawn")
            self._process = spawn.Process(target=serve, args=(work, theirs), name=name, daemon=True)
        self._is_there = self._has_ended = False
        with _without_interrupts(is_copied):
            self._process.start()
        theirs.close()  # so that its end is noticed
        _limit_send_time(self._ours)

    def is_there(self) -> bool:
        """Return True once the process has started, which takes a while, until it ends."""
        try:
            if not self._is_there and not self._has_ended and self._ours.poll():
                self._is_there = self._ours.recv_bytes() == READY
        except (EOFError, OSError):
            self._lose()
        return self._is_there

    def send(self, message: bytes) -> bool:
        """Send a message; return whether the worker is there to read it."""
        try:
            if self._is_there:
                self._ours.send_bytes(message)
        except BlockingIOError:
            self._give_up()
        except (EOFError, OSError):
            self._lose()
        return self._is_there

    def has_result(self) -> bool:
        """Return True if `receive` need not wait: there is a result, or the process has ended."""
        try:
            return self._ours.poll()
        except (EOFError, OSError):
            return True

    def receive(self) -> Any:
        """Wait for the next result, unpickled; None if the process has ended, or does not answer."""
        if self._has_ended:
            return None
        try:
            if self._answers():
                return pickle.loads(self._ours.recv_bytes())
            self._give_up()
        except (EOFError, OSError):
            self._lose()
        return None

    def end(self) -> None:
        """Stop the process."""
        self._ours.close()
        self._process.terminate()
        self._process.join(END)
        if self._process.exitcode is None:  # it is stopped, and takes no other signal
            self._process.kill()
            self._process.join()

    def _answers(self) -> bool:
        """Wait for a message or the end of the process; False if it neither sends one nor works on it.

        However long it works, on however busy a machine, it is waited for.
        """
        used, heard = _processor_time(self._process), time.monotonic()
        patience = SILENCE_UNKNOWN if used is None else SILENCE
        while not self._ours.poll(LOOK):
            now = _processor_time(self._process)
            if now != used:
                used, heard = now, time.monotonic()
            elif time.monotonic() - heard > patience:
                return False
        return True

    def _give_up(self) -> None:
        """Kill the process, which was stopped or is stuck, and warn."""
        self._process.kill()
        self._process.join()
        self._end_with("does not answer")

    def _lose(self) -> None:
        """Warn that the process was killed."""
        if not self._has_ended:
            self._process.join()
            self._end_with(f"has ended ({self._process.exitcode})")

    def _end_with(self, reason: str) -> None:
        self._is_there, self._has_ended = False, True
        warnings.warn(f"another process of this run {reason}: going on without it", stacklevel=3)


def _processor_time(process: BaseProcess) -> int | None:
    """Ticks of the processor that a process has used; None where the system does not tell."""
    try:
        fields = Path(f"/proc/{process.pid}/stat").read_bytes().rpartition(b")")[2].split()
    except OSError:
        return None
    return int(fields[11]) + int(fields[12])  # utime and stime: proc(5)


def _limit_send_time(connection: Connection) -> None:
    """Let a message that nobody takes for SILENCE seconds fail with BlockingIOError, where the pipe is a socket."""
    if sys.platform == "win32":
        return
    with socket.socket(fileno=os.dup(connection.fileno())) as ours:  # the option is of both
        ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, struct.pack("@ll", int(SILENCE), 0))


def _copied(work: Callable[..., None], theirs: Connection, ours: Connection) -> None:
    """Run `serve` in a fork, without the pipe ends and signal handlers of the parent."""
    ours.close()  # so that the other's end is noticed
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # what `end` sends
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGTERM])
    serve(work, theirs)


class WithWorker:
    """Owner of a worker that does `work` while this is entered."""

    def __init__(self, work: Callable[..., None]) -> None:
        self._work = work

    def __enter__(self) -> Self:
        self._worker = Worker(self._work)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._worker.end()


# --- the other end ---------------------------------------------------------------------------------------------


def pack_task(*parts: object) -> bytes:
    """Pickle the arguments of `work`, and the number of threads of torch.

    Not by multiprocessing's own pickling, which would move tensors to shared memory.
    """
    return pickle.dumps((torch.get_num_threads(), *parts))


def serve(work: Callable[..., None], connection: Connection) -> None:
    """Main function of a worker: report READY, receive the task, then work until the pipe is closed."""
    try:
        connection.send_bytes(READY)
        threads, *parts = pickle.loads(connection.recv_bytes())
        torch.set_num_threads(threads)
        work(connection, *parts)
    except (EOFError, OSError):
        return


def requests(connection: Connection) -> Iterator[Any]:
    """Yield one request after the other. Raises EOFError, or OSError, when the pipe is closed."""
    while True:
        yield pickle.loads(connection.recv_bytes())


def send_result(connection: Connection, answer: object) -> None:
    """Send a result. Raises OSError when the pipe is closed."""
    connection.send_bytes(pickle.dumps(answer))


def try_call(what: str, answer: Callable[..., object], *question: object) -> Any:
    """Call a function in inference mode, and return its result or its exception, for `unwrap` to raise.

    Args:
        what: description of the task, added as a note to exceptions from outside of torchslam
    """
    try:
        with torch.inference_mode():
            return answer(*question)
    except Exception as error:
        if not isinstance(error, TorchslamError):
            error.add_note(f"in the process that {what}:\n{traceback.format_exc()}")
        return error


def unwrap(answer: Any) -> Any:
    """The result of `try_call`. Raises the exception that was raised in the worker."""
    if isinstance(answer, BaseException):
        raise answer
    return answer


@contextmanager
def _without_interrupts(is_copied: bool) -> Iterator[None]:
    """Start processes that ignore Ctrl-C, which this process handles; no signal is lost.

    Args:
        is_copied: the process is a fork: block SIGTERM too, until the copy has removed the inherited handler
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    resource_tracker.ensure_running()  # it would let signals through again
    held = [signal.SIGINT, signal.SIGTERM] if is_copied else [signal.SIGINT]
    before = signal.pthread_sigmask(signal.SIG_BLOCK, held)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
