"""Frames with their features, found ahead of their turn by other processes: the same bytes in less time.

A frame's image and its features need nothing that the frames before it have taught: another processor can see to them
while this one tracks and maps.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import traceback
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Any

import torch

from torchslam.config import Config
from torchslam.data.sequence import Sequence
from torchslam.errors import TorchslamError
from torchslam.front_end import check_size, image_extractor
from torchslam.geometry import Camera
from torchslam.stopwatch import Stopwatch
from torchslam.values import Features, Frame

AHEAD = 4
"""Frames that a process is asked for before their turn: about as many as it reads while a keyframe is mapped."""
WORTH = 100
"""Frames of a run for which a second process is worth its start, which costs as much as some 40 frames."""


def processors() -> int:
    """How many processors this process may use."""
    known = getattr(os, "sched_getaffinity", None)  # not on every system
    return os.cpu_count() or 1 if known is None else len(known(0))


def why_alone(sequence: Sequence, config: Config, device: torch.device) -> str:
    """Why the frames of a sequence cannot be read ahead, in words; nothing where they can."""
    if config.features.kind == "simulated":
        return "simulated features need no images"
    if not len(sequence.timestamps):
        return "a live source is read as it comes"
    if device.type != "cpu":
        return f"features are found on {device}"
    return ""


class Ahead:
    """The frames of a sequence with their features; each is to be asked for once, in the order of its index.

    Until a process has started its frames are read here, and so they are where one is ended by somebody else. There are
    processes while this is entered; they end with this one, however it ends.

    camera:    what the frames must fit
    clock:     is told as "features" how long the features of a frame were waited for
    processes: how many, beside this one
    """

    def __init__(
        self, sequence: Sequence, camera: Camera, config: Config, clock: Stopwatch, processes: int = 1
    ) -> None:
        self._sequence, self._clock, self._count = sequence, clock, processes
        # Not by multiprocessing's own pickling, which would move tensors to shared memory.
        self._task = pickle.dumps((sequence, camera, config, torch.get_num_threads()))
        self._workers: list[Worker] = []
        self._asked: dict[int, Worker] = {}
        self._next: int | None = None  # first frame of which nobody was asked yet

    def __enter__(self) -> Ahead:
        self._workers = [Worker(self._task) for _ in range(self._count)]
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for worker in self._workers:
            worker.end()

    def __getitem__(self, index: int) -> Frame:
        """Frame `index`. Raises FrameError where it cannot be read or does not fit the camera."""
        self._ask(index)
        worker = self._asked.pop(index, None)
        if worker is not None:
            with self._clock("features"):
                answer = worker.answer()
            if isinstance(answer, BaseException):
                raise answer
            if answer is not None:
                return _unpacked(answer)
        return self._sequence[index]

    def _ask(self, index: int) -> None:
        """Ask for the frames after `index`, of those that have started, each process for every n-th."""
        until = min(index + 1 + AHEAD * self._count, len(self._sequence))
        for later in range(max(index + 1, self._next or 0), until):
            worker = self._workers[later % self._count]
            if worker.ask(later):
                self._asked[later] = worker
        self._next = until


class Worker:
    """A process that finds the features of the frames that it is asked for."""

    def __init__(self, task: bytes) -> None:
        context = multiprocessing.get_context("spawn")
        self._ours, theirs = context.Pipe()
        self._process = context.Process(target=_work, args=(theirs,), name="torchslam ahead", daemon=True)
        self._task = (
            task  # no argument: `start` would wait for ever for a process that dies before it reads it
        )
        self._is_ready = self._has_ended = False
        with _without_interrupts():
            self._process.start()
        theirs.close()  # so that its end is noticed

    def ask(self, index: int) -> bool:
        """Ask for a frame; whether there is somebody to answer."""
        try:
            if not self._is_ready and not self._has_ended and self._ours.poll():
                self._is_ready = self._ours.recv_bytes() == b""
                self._ours.send_bytes(self._task)
            if self._is_ready:
                self._ours.send_bytes(pickle.dumps(index))
        except (EOFError, OSError):
            self._lose()
        return self._is_ready

    def answer(self) -> Any:
        """What came of the frame asked for first, packed, or the error; None where the process has ended."""
        try:
            return pickle.loads(self._ours.recv_bytes())
        except (EOFError, OSError):
            self._lose()
            return None

    def end(self) -> None:
        """Let the process go; it holds nothing that would be lost."""
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
        self._is_ready, self._has_ended = False, True


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


def _work(connection: Connection) -> None:
    """A process: say that there is somebody, take the task, then answer until the one that asks has gone."""
    try:
        connection.send_bytes(b"")
        sequence, camera, config, threads = pickle.loads(connection.recv_bytes())
        torch.set_num_threads(threads)
        extract = image_extractor(config)
        while True:
            index = pickle.loads(connection.recv_bytes())
            try:
                with torch.inference_mode():
                    frame = sequence[index]
                    check_size(frame, camera)
                    answer: object = _packed(frame, extract(frame))
            except Exception as error:  # an error is an answer too, and raised where it was asked for
                if not isinstance(error, TorchslamError):
                    error.add_note(f"in the process that reads ahead:\n{traceback.format_exc()}")
                answer = error
            connection.send_bytes(pickle.dumps(answer))
    except (EOFError, OSError):
        return


def _packed(frame: Frame, features: Features) -> dict[str, Any]:
    """A frame with features, without its image, as arrays: tensors are slow to pickle."""
    truth = None if frame.T_cw_groundtruth is None else frame.T_cw_groundtruth.numpy()
    columns = [getattr(features, name).numpy() for name in Features.__dataclass_fields__]
    return {"frame": (frame.index, frame.timestamp, frame.name), "truth": truth, "features": columns}


def _unpacked(packed: dict[str, Any]) -> Frame:
    """What `_packed` packed."""
    (index, timestamp, name), truth = packed["frame"], packed["truth"]
    features = Features(*map(torch.from_numpy, packed["features"]))
    return Frame(
        index,
        timestamp,
        torch.zeros(1, 1, 0, 0),
        name,
        None if truth is None else torch.from_numpy(truth),
        features=features,
    )
