"""A process beside this one, with a pipe to it: started, asked, noticed when it ends, ended."""

from __future__ import annotations

import multiprocessing
import pickle
import signal
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from typing import Any

READY = b""  # what a process says when it is there


class Worker:
    """A process that does `work` at the other end of a pipe, after it has said READY."""

    def __init__(self, work: Callable[[Connection], None]) -> None:
        context = multiprocessing.get_context("spawn")
        self._ours, theirs = context.Pipe()
        # What it needs comes through the pipe: `start` would wait for ever for a process that dies before it reads.
        self._process = context.Process(target=work, args=(theirs,), name="torchslam ahead", daemon=True)
        self._is_there = self._has_ended = False
        with _without_interrupts():
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
                f"a process that reads ahead has ended ({status}): going on without it", stacklevel=2
            )
        self._is_there, self._has_ended = False, True


@contextmanager
def _without_interrupts() -> Iterator[None]:
    """Processes that are started in here are not ended by Ctrl-C, which is for this one to see to; none is lost."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    resource_tracker.ensure_running()  # it would let signals through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
