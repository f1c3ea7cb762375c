"""Frames of a live source that another process looks at while they wait."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from functools import partial

import numpy as np
import pytest
import torch

from tests.parallel.test_pool import PATIENCE, wait_until_ready
from tests.parallel.test_prefetch import SIZE, picture
from torchslam import Features, Frame, load_config
from torchslam.data.readers.live import LiveSequence
from torchslam.data.sequence import EndOfSequence
from torchslam.errors import FrameError
from torchslam.geometry import Camera
from torchslam.parallel.prefetch import LivePrefetcher
from torchslam.system.front_end import checked_extractor, image_extractor
from torchslam.utils.timing import Stopwatch

CONFIG = load_config(None, ["features.kind=opencv-orb", "features.num_keypoints=300"])
CAMERA = Camera.pinhole(100.0, 100.0, 79.5, 59.5, size=SIZE)
EXTRACTOR = partial(checked_extractor, CONFIG, CAMERA)
SMALL = 3  # a frame of another size


class Source:
    """A camera that gives its frames as fast as they are taken, or one at a time."""

    def __init__(self, frames: int, pause: float = 0.0) -> None:
        self.frames, self.pause, self.frame = frames, pause, -1

    def grab(self) -> bool:
        time.sleep(self.pause)
        self.frame += 1
        return self.frame < self.frames

    def retrieve(self) -> tuple[bool, np.ndarray]:
        image = picture(self.frame)
        return True, image[:50] if self.frame == SMALL else image

    def get(self, property_id: int) -> float:
        return 0.0

    def release(self) -> None:
        pass


def live(frames: int, pause: float = 0.0) -> LiveSequence:
    sequence = LiveSequence("camera", Source(frames, pause), CAMERA, backlog=frames)
    if not pause:
        sequence._begin()  # as the first requested frame does
    while not pause and sequence.backlog < frames:
        time.sleep(0.01)
    return sequence


@pytest.fixture
def reader() -> Iterator[LivePrefetcher]:
    clock = Stopwatch()
    with LivePrefetcher(live(8), EXTRACTOR, clock) as frames:
        wait_until_ready(frames)
        yield frames


def expected(index: int) -> Features:
    image = torch.from_numpy(picture(index)).float()[None, None] / 255
    return image_extractor(CONFIG)(Frame(index, 0.0, image))


def test_a_queued_frame_is_extracted_by_the_worker_with_the_same_result(reader: LivePrefetcher) -> None:
    found = []
    for index in range(8):
        if index == SMALL:
            with pytest.raises(FrameError, match="160x50, the others are 160x120"):
                reader[index]
            continue
        frame = reader[index]
        assert frame.index == index
        assert frame.backlog == 7 - index  # also with one of them taken from the source before its turn
        assert frame.image.shape[-1] == SIZE[0]  # for those who want it
        found.append(frame.features is not None)
        if frame.features is not None:
            right = expected(index)
            for name in ("keypoints", "descriptors", "mask"):
                assert torch.equal(getattr(frame.features, name), getattr(right, name))
    # The first frame and the one after the failed frame are not prefetched.
    assert found == [False, True, True, False, True, True, True]
    assert reader._clock.take()["features"] > 0
    with pytest.raises(EndOfSequence):
        reader[8]


def test_a_frame_that_has_not_arrived_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torchslam.data.readers.live.STALE", PATIENCE)
    with LivePrefetcher(live(4, pause=0.05), EXTRACTOR, Stopwatch()) as frames:
        wait_until_ready(frames)
        frames[0], frames[1]
        deadline = time.monotonic() + 10
        while frames._sequence.backlog == 0 and time.monotonic() < deadline:
            time.sleep(0.01)
        assert frames._next is None or frames._call is not None  # nothing was taken that is not looked at
        assert frames[2].index == 2


def test_the_source_continues_without_the_worker(reader: LivePrefetcher) -> None:
    reader[0], reader[1]
    reader._call = reader.submit(reader._next)  # not answered yet
    os.kill(reader._workers[0].process.pid or 0, signal.SIGKILL)
    with pytest.warns(UserWarning, match="died"):
        frame = reader[2]
    assert frame.index == 2
    assert frame.features is None
    with pytest.raises(FrameError):
        reader[SMALL]
    assert [reader[index].features for index in (4, 5)] == [None, None]
