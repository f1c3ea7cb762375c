"""Frames with their features, found ahead of their turn by other processes: the same bytes in less time.

A frame's image and its features need nothing that the frames before it have taught: another processor can see to them
while this one tracks and maps.
"""

from __future__ import annotations

import os
import pickle
from multiprocessing.connection import Connection
from types import TracebackType

from torchslam.config import Config
from torchslam.data.sequence import Sequence
from torchslam.geometry import Camera
from torchslam.parallel.serialization import Arrays, pack_frame, unpack_frame
from torchslam.parallel.worker import Worker, pack_task, requests, send_result, try_call, unwrap
from torchslam.system.front_end import check_size, image_extractor
from torchslam.types import Frame
from torchslam.utils.timing import Stopwatch

AHEAD = 8
"""Frames that a process is asked for before their turn: while a keyframe is mapped and adjusted it may be held up."""
GIVES_WAY = 5
"""By how much nicer a process that reads ahead is than this one, and than the one whose adjustment is waited for."""


class FeaturePrefetcher:
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
        self._task = pack_task(sequence, camera, config)
        self._workers: list[Worker] = []
        self._busy: set[Worker] = set()  # those that have the task
        self._asked: dict[int, Worker] = {}
        self._next: int | None = None  # first frame of which nobody was asked yet

    def __enter__(self) -> FeaturePrefetcher:
        self._workers = [Worker(_work) for _ in range(self._count)]
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for worker in self._workers:
            worker.end()

    def begin(self, start: int) -> None:
        """Ask for the frames after the first one, which is read here, if everybody is there already."""
        if all(worker.is_there() for worker in self._workers):
            self._ask(start)

    def __getitem__(self, index: int) -> Frame:
        """Frame `index`. Raises FrameError where it cannot be read or does not fit the camera."""
        self._ask(index)
        worker = self._asked.pop(index, None)
        if worker is not None:
            with self._clock("features"):
                answer = unwrap(worker.receive())
            if answer is not None:
                return unpack_frame(answer)
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


def _work(connection: Connection, sequence: Sequence, camera: Camera, config: Config) -> None:
    """Read the frames that are asked for, by their index, and find their features."""
    if hasattr(os, "nice"):  # not on every system
        os.nice(GIVES_WAY)
    extract = image_extractor(config)

    def read(index: int) -> Arrays:
        frame = sequence[index]
        check_size(frame, camera)
        return pack_frame(frame, extract(frame))

    for index in requests(connection):
        send_result(connection, try_call("reads ahead", read, index))
