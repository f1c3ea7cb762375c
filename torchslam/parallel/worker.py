"""A process beside this one, with a pipe to it: started, asked, noticed when it ends, ended; and what it does there.

It is a copy of this one where that is safe, and then there at once; elsewhere a new interpreter has to import all.
"""

from __future__ import annotations

import multiprocessing
import pickle
import signal
import sys
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

READY = b""  # what a process says when it is there
THREADS = Path("/proc/self/task")  # one entry each, on Linux


def starts_at_once() -> bool:
    """Whether a process may be a copy of this one: a lock that another thread holds would stay locked in the copy.

    That a process computes on a GPU does not survive being copied either. Elsewhere than on Linux the system's own
    libraries may hold such locks.
    """
    return sys.platform == "linux" and len(list(THREADS.iterdir())) == 1 and not torch.cuda.is_initialized()


class Worker:
    """A process that does `work` at the other end of a pipe, once it has said READY and was sent its `task`.

    work: (connection, *task) -> None, until the pipe is closed
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

    def is_there(self) -> bool:
        """Whether the process has started, which takes a while, and has not ended."""
        try:
            if not self._is_there and not self._has_ended and self._ours.poll():
                self._is_there = self._ours.recv_bytes() == READY
        except (EOFError, OSError):
            self._lose()
        return self._is_there

    def send(self, message: bytes) -> bool:
        """Whether there is somebody to read it."""
        try:
            if self._is_there:
                self._ours.send_bytes(message)
        except (EOFError, OSError):
            self._lose()
        return self._is_there

    def receive(self) -> Any:
        """The next answer, unpickled; None where the process has ended."""
        try:
            return pickle.loads(self._ours.recv_bytes())
        except (EOFError, OSError):
            self._lose()
            return None

    def end(self) -> None:
        """Let the process go."""
        self._ours.close()
        self._process.terminate()
        self._process.join()

    def _lose(self) -> None:
        """The process was ended by somebody else."""
        if not self._has_ended:
            self._process.join()
            status = self._process.exitcode
            warnings.warn(
                f"another process of this run has ended ({status}): going on without it", stacklevel=2
            )
        self._is_there, self._has_ended = False, True


def _copied(work: Callable[..., None], theirs: Connection, ours: Connection) -> None:
    """A process that begins as a copy of the one that started it, whose ends of pipes and signals are not its own."""
    ours.close()  # so that the other's end is noticed
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # what `end` sends
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGTERM])
    serve(work, theirs)


class WithWorker:
    """What has a process beside this one that does `work`, while it is entered."""

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
    """What a process is to be sent first: `work` is called with the parts, and torch has as many threads as here.

    Not by multiprocessing's own pickling, which would move tensors to shared memory.
    """
    return pickle.dumps((torch.get_num_threads(), *parts))


def serve(work: Callable[..., None], connection: Connection) -> None:
    """A process: say that there is somebody, take the task, then work until the one that asks has gone."""
    try:
        connection.send_bytes(READY)
        threads, *parts = pickle.loads(connection.recv_bytes())
        torch.set_num_threads(threads)
        work(connection, *parts)
    except (EOFError, OSError):
        return


def requests(connection: Connection) -> Iterator[Any]:
    """What is asked, one after the other. Raises EOFError, or OSError, when nobody asks any more."""
    while True:
        yield pickle.loads(connection.recv_bytes())


def send_result(connection: Connection, answer: object) -> None:
    """Send an answer; raises OSError where nobody waits for it."""
    connection.send_bytes(pickle.dumps(answer))


def try_call(what: str, answer: Callable[..., object], *question: object) -> Any:
    """The answer to a question, found in inference mode; an error is an answer too, for `unwrap` to raise.

    what: the process does, to be said of errors that are not torchslam's own, which say all by themselves
    """
    try:
        with torch.inference_mode():
            return answer(*question)
    except Exception as error:
        if not isinstance(error, TorchslamError):
            error.add_note(f"in the process that {what}:\n{traceback.format_exc()}")
        return error


def unwrap(answer: Any) -> Any:
    """An answer where it is wanted. Raises what was raised on the other side."""
    if isinstance(answer, BaseException):
        raise answer
    return answer


@contextmanager
def _without_interrupts(is_copied: bool) -> Iterator[None]:
    """Processes that are started in here are not ended by Ctrl-C, which is for this one to see to; none is lost.

    is_copied: SIGTERM has to wait as well, until a copy no longer has this process's handler for it
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
