"""Feature prefetching: worker processes read frames and extract their features ahead of their turn.

A frame's image and features do not depend on the frames before it, so the results are the same as without workers.
`FeaturePrefetcher` reads ahead in a recorded sequence; `LivePrefetcher` extracts the features of a frame that has
already arrived from a live source, while the frame before it is tracked.
"""

from __future__ import annotations

import os
import pickle
from dataclasses import fields, replace
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchslam.config import Config
from torchslam.data.sequence import EndOfSequence, Sequence
from torchslam.errors import FrameError
from torchslam.geometry import Camera
from torchslam.parallel.worker import WithWorker, Worker, pack_task, requests, send_result, try_call, unwrap
from torchslam.system.front_end import check_size, image_extractor
from torchslam.types import Features, Frame
from torchslam.utils.timing import Stopwatch

AHEAD = 8
"""Frames that are requested from a worker ahead of their turn: it may be held up while a keyframe is adjusted."""
NICENESS = 5
"""Niceness of prefetch workers, relative to this process and to the bundle worker that it waits for."""

Arrays = dict[str, Any]
"""Columns as NumPy arrays, as tensors are slow to pickle."""


class FeaturePrefetcher:
    """The frames of a sequence with their features; each is to be read once, in the order of its index.

    The workers run while this is entered. Frames are read in this process until a worker has started, and after one
    was killed.

    Args:
        camera: frames must have its size
        clock: records the time spent waiting for features as "features"
        processes: number of workers
    """

    def __init__(
        self, sequence: Sequence, camera: Camera, config: Config, clock: Stopwatch, processes: int = 1
    ) -> None:
        self._sequence, self._clock, self._count = sequence, clock, processes
        self._task = pack_task(sequence, camera, config)
        self._workers: list[Worker] = []
        self._busy: set[Worker] = set()  # have the task
        self._requested: dict[int, Worker] = {}
        self._next: int | None = None  # first frame that was not requested yet

    def __enter__(self) -> FeaturePrefetcher:
        self._workers = [Worker(_read_frames) for _ in range(self._count)]
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for worker in self._workers:
            worker.end()

    def begin(self, start: int) -> None:
        """Request the frames after the first one, which is read here, if all workers have started already."""
        if all(worker.is_there() for worker in self._workers):
            self._request(start)

    def __getitem__(self, index: int) -> Frame:
        """Frame `index`. Raises FrameError if it cannot be read or does not fit the camera."""
        self._request(index)
        worker = self._requested.pop(index, None)
        if worker is not None:
            with self._clock("features"):
                answer = unwrap(worker.receive())
            if answer is not None:
                return unpack_frame(answer)
        return self._sequence[index]

    def _request(self, index: int) -> None:
        """Request the frames after `index`, every n-th from each of the n workers that have started."""
        until = min(index + 1 + AHEAD * self._count, len(self._sequence))
        for later in range(max(index + 1, self._next or 0), until):
            worker = self._workers[later % self._count]
            if worker not in self._busy and worker.is_there() and worker.send(self._task):
                self._busy.add(worker)
            if worker in self._busy and worker.send(pickle.dumps(later)):
                self._requested[later] = worker
        self._next = until


class LivePrefetcher(WithWorker):
    """The frames of a live source; each is to be read once, in order.

    The worker runs while this is entered. Frames whose features it did not extract come without.

    Args:
        camera: frames must have its size
        clock: records the time spent waiting for features as "features"
    """

    def __init__(self, sequence: Sequence, camera: Camera, config: Config, clock: Stopwatch) -> None:
        super().__init__(_extract_features)
        self._sequence, self._camera, self._clock = sequence, camera, clock
        self._task = pack_task(config)
        self._has_task = False
        self._next: Frame | FrameError | None = None  # taken from the source before its turn
        self._is_sent = False  # to the worker

    def __getitem__(self, index: int) -> Frame:
        """Frame `index`. Raises FrameError if it cannot be read or does not fit the camera."""
        taken, self._next = self._next, None
        if isinstance(taken, FrameError):
            raise taken
        frame = self._sequence[index] if taken is None else taken
        if self._is_sent:
            frame = self._with_features(frame)
        self._send_next(index + 1)
        return replace(frame, backlog=self._sequence.backlog + (self._next is not None))

    def _with_features(self, frame: Frame) -> Frame:
        self._is_sent = False
        with self._clock("features"):
            answer = unwrap(self._worker.receive())
        return frame if answer is None else replace(frame, features=unpack_features(answer))

    def _send_next(self, index: int) -> None:
        """Send the next frame to the worker, if both are there."""
        if not self._sequence.backlog or not self._worker.is_there():
            return
        if not self._has_task:
            self._has_task = self._worker.send(self._task)
        try:
            self._next = frame = self._sequence[index]
            check_size(frame, self._camera)
        except (EndOfSequence, IndexError):  # raised again when it is read
            return
        except FrameError as error:
            self._next = error
            return
        mask = None if frame.mask is None else frame.mask.numpy()
        self._is_sent = self._worker.send(pickle.dumps((frame.image.numpy(), mask)))


def _read_frames(connection: Connection, sequence: Sequence, camera: Camera, config: Config) -> None:
    """Read the requested frames, and extract their features."""
    if hasattr(os, "nice"):  # not on every system
        os.nice(NICENESS)
    extract = image_extractor(config)

    def read(index: int) -> Arrays:
        frame = sequence[index]
        check_size(frame, camera)
        return pack_frame(frame, extract(frame))

    for index in requests(connection):
        send_result(connection, try_call("reads ahead", read, index))


def _extract_features(connection: Connection, config: Config) -> None:
    """Extract the features of images, each with its mask or None."""
    extract = image_extractor(config)

    def extract_from(image: np.ndarray, mask: np.ndarray | None) -> Arrays | None:
        frame = Frame(0, 0.0, torch.from_numpy(image))
        if mask is not None:
            frame = replace(frame, mask=torch.from_numpy(mask))
        return pack_features(extract(frame))

    for question in requests(connection):
        send_result(connection, try_call("reads ahead", extract_from, *question))


def pack_features(features: Features | None) -> Arrays | None:
    """The fields of features as arrays."""
    if features is None:
        return None
    columns = {each.name: getattr(features, each.name) for each in fields(features)}
    return {
        name: column.numpy() if isinstance(column, Tensor) else column for name, column in columns.items()
    }


def unpack_features(arrays: Arrays | None) -> Features | None:
    """The features that `pack_features` packed."""
    if arrays is None:
        return None
    columns: dict[str, Any] = {
        name: torch.from_numpy(each) if isinstance(each, np.ndarray) else each
        for name, each in arrays.items()
    }
    return Features(**columns)


def pack_frame(frame: Frame, features: Features | None) -> Arrays:
    """A frame without its image."""
    truth = None if frame.T_cw_groundtruth is None else frame.T_cw_groundtruth.numpy()
    return {
        "index": frame.index,
        "timestamp": frame.timestamp,
        "name": frame.name,
        "truth": truth,
        "features": pack_features(features),
    }


def unpack_frame(arrays: Arrays) -> Frame:
    """The frame that `pack_frame` packed, with an empty image."""
    truth = arrays["truth"]
    return Frame(
        arrays["index"],
        arrays["timestamp"],
        torch.zeros(1, 1, 0, 0, dtype=torch.float32, device="cpu"),
        arrays["name"],
        None if truth is None else torch.from_numpy(truth),
        features=unpack_features(arrays["features"]),
    )
