"""The scout in a process of its own: it follows, and looks for features, while this one tracks and maps.

It goes no further than a fixed number of frames before this one, and knows at each frame what it would know here: the
bytes are the same.
"""

from __future__ import annotations

import pickle
from collections import deque
from multiprocessing.connection import Connection
from typing import Protocol

import torch

from torchslam.config import Config
from torchslam.data.sequence import Sequence
from torchslam.map.submap import World
from torchslam.parallel.serialization import Arrays, as_arrays, from_arrays, packed, unpacked
from torchslam.parallel.worker import WithWorker, attempt, outcome, reply, task
from torchslam.system.front_end import check_order, check_size, image_extractor
from torchslam.tracking.patch_tracking import PatchTracking
from torchslam.tracking.scout import Scout
from torchslam.types import Anchor, Frame
from torchslam.utils.timing import Stopwatch

READS = "reads ahead"  # what the process does


class System(Protocol):
    """What the scout has to do with: of `torchslam.system.slam.SLAM`."""

    config: Config
    clock: Stopwatch
    patches: PatchTracking
    last_frame: tuple[int, float] | None

    @property
    def world(self) -> World | None: ...


class Scouting(WithWorker):
    """The frames of a sequence, followed or with their features; each is to be asked for once, in order.

    Until the process has started, the system's own scout goes before it, and then hands over what it knows; it begins
    anew where the process is ended by somebody else. There is a process while this is entered.
    """

    def __init__(self, sequence: Sequence, slam: System) -> None:
        super().__init__(_work)
        self._sequence, self._slam = sequence, slam
        self._is_away = False
        self._told = -1  # frame of the newest news that it knows
        self._frames: deque[Arrays | Exception] = deque()  # what has arrived before its turn

    def __getitem__(self, index: int) -> Frame:
        """Frame `index`. Raises FrameError where it cannot be read or does not fit the camera."""
        slam = self._slam
        if not self._is_away and self._worker.is_there():
            message = task(self._sequence, slam.config, slam.patches.scout, slam.last_frame, index)
            self._is_away = self._worker.send(message)
            self._told = slam.patches.news[0]
        if self._is_away:
            with slam.clock("features"):
                frame = self._ask(index)
            if frame is not None:
                return frame
            self._is_away = False
            slam.patches.forget()
        return self._sequence[index]

    def _ask(self, index: int) -> Frame | None:
        """A frame of which the system can make something; None where there is nobody to answer."""
        slam, news = self._slam, None
        newest, anchor = slam.patches.news
        if newest != self._told:
            self._told, news = newest, (newest, packed(anchor))
        if not self._worker.send(pickle.dumps((index, news, False))):
            return None
        answer = outcome(self._frames.popleft() if self._frames else self._worker.receive())
        if answer is None:
            return None
        frame = from_arrays(answer)
        if frame.features is not None or slam.patches.will_do(slam.world, frame.followed):
            return frame
        if not self._worker.send(pickle.dumps((index, None, True))):
            return None
        while (answer := self._worker.receive()) is not None:
            if isinstance(answer, dict) and answer["index"] == index:
                return from_arrays(answer)
            self._frames.append(answer)
        return None


def _work(
    connection: Connection,
    sequence: Sequence,
    config: Config,
    scout: Scout,
    last_frame: tuple[int, float] | None,
    start: int,
) -> None:
    """Go ahead from frame `start` on."""
    with torch.inference_mode():
        _Away(connection, sequence, config, scout, last_frame, start).go()


class _Away:
    """What the scout does away from home."""

    def __init__(
        self,
        connection: Connection,
        sequence: Sequence,
        config: Config,
        scout: Scout,
        last_frame: tuple[int, float] | None,
        start: int,
    ) -> None:
        self.connection, self.sequence, self.scout = connection, sequence, scout
        self.extract = image_extractor(config)
        self.delay = config.patches.delay
        self.last_frame = last_frame
        self.next = start
        self.wanted = start - 1  # the frame that is wanted at home: those before it are done with
        self.images: dict[int, Frame] = {}  # of the last frames
        self.read: Frame | Exception | None = None  # the next frame, if there was time

    def go(self) -> None:
        while True:
            is_over = self.next >= len(self.sequence)
            is_far = is_over or self.next > self.wanted + self.delay
            is_idle = is_far and not is_over and self.read is None
            if is_idle and not self.connection.poll():
                self.read = self.ahead(self.next)
            elif is_far or self.connection.poll():
                self.hear(*pickle.loads(self.connection.recv_bytes()))
            else:
                reply(self.connection, self.look(self.next))
                self.next += 1

    def hear(self, index: int, news: tuple[int, Arrays | None] | None, wants_features: bool) -> None:
        """A frame is wanted, or its features after all; news of a frame before it."""
        if wants_features:
            reply(self.connection, as_arrays(self.images[index], None, self.extract(self.images[index])))
            return
        self.wanted = index
        self.images = {i: frame for i, frame in self.images.items() if i >= index}
        if news is not None:
            self.scout.learn(news[0], unpacked(Anchor, news[1]))

    def ahead(self, index: int) -> Frame | Exception:
        """A frame, and all that can be done before it is its turn."""

        def prepared() -> Frame:
            frame = self.sequence[index]
            check_size(frame, self.scout.camera)
            self.scout.prepare(frame)
            return frame

        found: Frame | Exception = attempt(READS, prepared)
        return found

    def look(self, index: int) -> Arrays | Exception:
        """What there is to say of a frame."""
        frame, self.read = self.read or self.ahead(index), None
        if isinstance(frame, Exception):
            return frame
        found: Arrays | Exception = attempt(READS, self.follow, index, frame)
        return found

    def follow(self, index: int, frame: Frame) -> Arrays:
        """Where the next frame is, with its features where that will not do."""
        check_order(frame, self.last_frame)
        followed = self.scout.follow(frame)
        self.last_frame, self.images[index] = (frame.index, frame.timestamp), frame
        return as_arrays(frame, followed, self.extract(frame) if followed.why_not else None)
