"""The frames of a live source with their features, found by another process where a frame already waits.

While one frame is tracked the next one is looked at, if it has come by then: where this process is in time nothing is
looked at elsewhere, and no frame comes later for it.
"""

from __future__ import annotations

import pickle
from dataclasses import replace
from multiprocessing.connection import Connection

import numpy as np
import torch

from torchslam.config import Config
from torchslam.data.sequence import EndOfSequence, Sequence
from torchslam.errors import FrameError
from torchslam.geometry import Camera
from torchslam.parallel.serialization import Arrays, pack_features, unpack_features
from torchslam.parallel.worker import WithWorker, pack_task, requests, send_result, try_call, unwrap
from torchslam.system.front_end import check_size, image_extractor
from torchslam.types import Frame
from torchslam.utils.timing import Stopwatch


class LivePrefetcher(WithWorker):
    """The frames of a live source; each is to be asked for once, in order.

    There is a process while this is entered; what it has not done, or where it was ended, is done by who tracks.

    camera: what the frames must fit; clock: is told as "features" how long the features of a frame were waited for
    """

    def __init__(self, sequence: Sequence, camera: Camera, config: Config, clock: Stopwatch) -> None:
        super().__init__(_work)
        self._sequence, self._camera, self._clock = sequence, camera, clock
        self._task = pack_task(config)
        self._has_task = False
        self._next: Frame | FrameError | None = None  # what was taken from the source before its turn
        self._is_sent = False  # whether that is being looked at

    def __getitem__(self, index: int) -> Frame:
        """Frame `index`. Raises FrameError where it cannot be read or does not fit the camera."""
        taken, self._next = self._next, None
        if isinstance(taken, FrameError):
            raise taken
        frame = self._sequence[index] if taken is None else taken
        if self._is_sent:
            frame = self._with_features(frame)
        self._look_ahead(index + 1)
        return replace(frame, backlog=self._sequence.backlog + (self._next is not None))

    def _with_features(self, frame: Frame) -> Frame:
        self._is_sent = False
        with self._clock("features"):
            answer = unwrap(self._worker.receive())
        return frame if answer is None else replace(frame, features=unpack_features(answer))

    def _look_ahead(self, index: int) -> None:
        """Have the next frame looked at, if it has come and there is somebody to do it."""
        if not self._sequence.backlog or not self._worker.is_there():
            return
        if not self._has_task:
            self._has_task = self._worker.send(self._task)
        try:
            self._next = frame = self._sequence[index]
            check_size(frame, self._camera)
        except (EndOfSequence, IndexError):  # said again when it is asked for
            return
        except FrameError as error:
            self._next = error
            return
        mask = None if frame.mask is None else frame.mask.numpy()
        self._is_sent = self._worker.send(pickle.dumps((frame.image.numpy(), mask)))


def _work(connection: Connection, config: Config) -> None:
    """Find the features of the images that come, each with its mask or None."""
    extract = image_extractor(config)

    def look(image: np.ndarray, mask: np.ndarray | None) -> Arrays | None:
        frame = Frame(0, 0.0, torch.from_numpy(image))
        if mask is not None:
            frame = replace(frame, mask=torch.from_numpy(mask))
        return pack_features(extract(frame))

    for question in requests(connection):
        send_result(connection, try_call("reads ahead", look, *question))
