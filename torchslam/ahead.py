"""Frames with their features, found ahead of their turn by other processes: the same bytes in less time.

A frame's image and its features need nothing that the frames before it have taught: another processor can see to them
while this one tracks and maps.
"""

from __future__ import annotations

import os
import pickle
import traceback
from multiprocessing.connection import Connection
from types import TracebackType

import torch

from torchslam.config import Config
from torchslam.data.sequence import Sequence
from torchslam.errors import TorchslamError
from torchslam.front_end import check_size, image_extractor
from torchslam.geometry import Camera
from torchslam.parcel import as_arrays, from_arrays
from torchslam.stopwatch import Stopwatch
from torchslam.values import Frame
from torchslam.worker import READY, Worker

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
    if config.matching.matcher != "descriptors":
        return "the matcher may want images"
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
        self._busy: set[Worker] = set()  # those that have the task
        self._asked: dict[int, Worker] = {}
        self._next: int | None = None  # first frame of which nobody was asked yet

    def __enter__(self) -> Ahead:
        self._workers = [Worker(_work) for _ in range(self._count)]
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
                answer = worker.receive()
            if isinstance(answer, BaseException):
                raise answer
            if answer is not None:
                return from_arrays(answer)
        return self._sequence[index]

    def _ask(self, index: int) -> None:
        """Ask for the frames after `index`, of those that have started, each process for every n-th."""
        until = min(index + 1 + AHEAD * self._count, len(self._sequence))
        for later in range(max(index + 1, self._next or 0), until):
            worker = self._workers[later % self._count]
            if worker not in self._busy and worker.is_there() and worker.send(self._task):
                self._busy.add(worker)
            if worker in self._busy and worker.send(pickle.dumps(later)):
                self._asked[later] = worker
        self._next = until


def _work(connection: Connection) -> None:
    """A process: say that there is somebody, take the task, then answer until the one that asks has gone."""
    try:
        connection.send_bytes(READY)
        sequence, camera, config, threads = pickle.loads(connection.recv_bytes())
        torch.set_num_threads(threads)
        extract = image_extractor(config)
        while True:
            index = pickle.loads(connection.recv_bytes())
            try:
                with torch.inference_mode():
                    frame = sequence[index]
                    check_size(frame, camera)
                    answer: object = as_arrays(frame, None, extract(frame))
            except Exception as error:  # an error is an answer too, and raised where it was asked for
                if not isinstance(error, TorchslamError):
                    error.add_note(f"in the process that reads ahead:\n{traceback.format_exc()}")
                answer = error
            connection.send_bytes(pickle.dumps(answer))
    except (EOFError, OSError):
        return
