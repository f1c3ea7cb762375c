"""Feature prefetching: worker processes read frames and extract their features ahead of their turn.

A frame's image and features do not depend on the frames before it, so the results are the same as without workers.
`FeaturePrefetcher` reads ahead in a recorded sequence; `LivePrefetcher` extracts the features of a frame that has
already arrived from a live source, while the frame before it is tracked.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch

from torchslam.data.sequence import EndOfSequence, Sequence
from torchslam.data.transforms import reduced
from torchslam.errors import FrameError
from torchslam.parallel.pool import Call, WorkerPool
from torchslam.types import Features, Frame
from torchslam.utils.timing import Stopwatch

AHEAD = 8
"""Frames that are requested from a worker ahead of their turn: it may be held up while a keyframe is adjusted."""
NICENESS = 5
"""Niceness of prefetch workers, relative to this process and to the bundle worker that it waits for."""

Extractor = Callable[[Frame], Features]
"""Extracts the features of a frame. Raises FrameError if the frame does not fit the camera."""


class FeaturePrefetcher(WorkerPool):
    """The frames of a sequence with their features; each is to be read once, in the order of its index.

    The workers, which call `make_extractor`, run while this is entered. Frames are read in this process until a worker
    has started, and after one was killed. `clock` records the time spent waiting as "features".
    """

    def __init__(
        self,
        sequence: Sequence,
        make_extractor: Callable[[], Extractor],
        clock: Stopwatch,
        processes: int = 1,
    ) -> None:
        super().__init__(processes, _frame_reader, sequence, make_extractor, niceness=NICENESS)
        self._sequence, self._clock = sequence, clock
        self._requested: dict[int, Call] = {}
        self._next = 0  # first frame that was not requested yet

    def __getitem__(self, index: int) -> Frame:
        """Frame `index`. Raises FrameError if it cannot be read or does not fit the camera."""
        until = min(index + 1 + AHEAD * self.count, len(self._sequence))
        for later in range(max(index + 1, self._next), until):
            call = self.submit(later)
            if call is None:
                break
            self._requested[later], self._next = call, later + 1
        with self._clock("features"):
            frame: Frame | None = self.result_or(self._requested.pop(index, None), lambda: None)
        return self._sequence[index] if frame is None else frame


class LivePrefetcher(WorkerPool):
    """The frames of a live source; each is to be read once, in order.

    The worker runs while this is entered. Frames whose features it did not extract come without. `clock` records the
    time spent waiting as "features".
    """

    def __init__(self, sequence: Sequence, make_extractor: Callable[[], Extractor], clock: Stopwatch) -> None:
        super().__init__(1, make_extractor, niceness=NICENESS)
        self._sequence, self._clock = sequence, clock
        self._next: Frame | FrameError | None = None  # taken from the source before its turn
        self._call: Call | None = None  # for its features

    def __getitem__(self, index: int) -> Frame:
        """Frame `index`. Raises FrameError if it cannot be read or does not fit the camera."""
        taken, self._next = self._next, None
        if isinstance(taken, FrameError):
            raise taken
        frame = self._sequence[index] if taken is None else taken
        call, self._call = self._call, None
        with self._clock("features"):
            features = self.result_or(call, lambda: frame.features)
        self._take_next(index + 1)
        return replace(frame, features=features, backlog=self._sequence.backlog + (self._next is not None))

    def _take_next(self, index: int) -> None:
        """Take the next frame from the source and submit it, if it has arrived and the worker has started."""
        if not self._sequence.backlog or not self.is_ready:
            return
        try:
            self._next = self._sequence[index]
        except (EndOfSequence, IndexError):  # raised again when it is read
            return
        except FrameError as error:
            self._next = error
            return
        self._call = self.submit(self._next)


def _frame_reader(sequence: Sequence, make_extractor: Callable[[], Extractor]) -> Callable[[int], Frame]:
    """The function that reads frames with their features, and without images, which would take time to send."""
    extract = make_extractor()
    no_image = torch.zeros(1, 1, 0, 0, dtype=torch.float32, device="cpu")

    def read(index: int) -> Frame:
        frame = sequence[index]
        picture = (
            torch.from_numpy(reduced(sequence.color(index).numpy())) if sequence.sends_pictures else None
        )
        return replace(frame, image=no_image, mask=None, features=extract(frame), picture=picture)

    return read
