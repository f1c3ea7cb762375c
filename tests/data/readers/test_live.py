"""A source that does not wait: the newest frame, what was dropped, when it was captured."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.data.mp4 import write_mp4
from torchslam import SLAM
from torchslam.config import load_config
from torchslam.data import EndOfSequence, open_sequence
from torchslam.data.formats.calibration_files import parse_calibration
from torchslam.data.readers import live
from torchslam.data.readers.live import CaptureClock, LiveSequence
from torchslam.data.transforms import Resized, Selection
from torchslam.errors import FrameError, SequenceError

RATE = 50.0
FRAMES = 30


class Played:
    """A video file that plays in real time: a frame that is not grabbed when it is due is gone."""

    def __init__(self, path: Path, has_clock: bool = True) -> None:
        self._capture = cv2.VideoCapture(str(path))
        self._has_clock = has_clock
        self._start: float | None = None
        self._frame = 0
        self.released = threading.Event()

    def grab(self) -> bool:
        self._start = time.monotonic() if self._start is None else self._start
        time.sleep(max(0.0, self._start + self._frame / RATE - time.monotonic()))
        self._frame += 1
        return self._capture.grab()

    def retrieve(self) -> tuple[bool, np.ndarray]:
        return self._capture.retrieve()

    def get(self, property_id: int) -> float:
        return self._capture.get(property_id) if self._has_clock else 0.0

    def release(self) -> None:
        self._capture.release()
        self.released.set()


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    """Thirty frames, each of its own brightness."""
    path = tmp_path / "clip.mp4"
    write_mp4(path, [np.full((48, 64, 3), 8 * index, np.uint8) for index in range(FRAMES)], RATE)
    return path


def numbers_of(frames) -> list[int]:
    return [round(float(frame.image.mean()) * 255 / 8) for frame in frames]


def test_a_slow_reader_gets_the_newest_frames(clip: Path) -> None:
    capture, began = Played(clip), time.time()
    sequence = LiveSequence("clip", capture, parse_calibration("f=0.8w"), backlog=1)
    frames = []
    for frame in sequence:
        frames.append(frame)
        time.sleep(0.1)
    numbers = numbers_of(frames)
    assert numbers == sorted(set(numbers))
    assert numbers[-1] == FRAMES - 1
    assert len(frames) < FRAMES / 2
    assert sequence.dropped == FRAMES - len(frames)
    assert [frame.index for frame in frames] == list(range(len(frames)))
    # Captured when the file says, on our clock.
    times = np.array([frame.timestamp for frame in frames])
    assert times - times[0] == pytest.approx((np.array(numbers) - numbers[0]) / RATE, abs=1e-3)
    assert began - 0.1 < times[0] < time.time()
    assert capture.released.wait(1.0)


def test_a_reader_that_is_slow_once_gets_all_frames(clip: Path) -> None:
    sequence = LiveSequence("clip", Played(clip), parse_calibration("f=0.8w"))
    frames = []
    for frame in sequence:
        frames.append(frame)
        time.sleep(0.12 if frame.index == 5 else 0.0)  # six frames
    assert numbers_of(frames) == list(range(FRAMES))
    assert sequence.dropped == 0


def test_a_fast_reader_gets_all_frames(clip: Path) -> None:
    sequence = LiveSequence("clip", Played(clip), None)
    assert sequence.known_length is None
    with pytest.raises(TypeError, match="has no length"):
        len(sequence)
    assert sequence.describe()["frames"] == "as they come"
    frames = list(sequence)
    assert len(frames) + sequence.dropped == FRAMES
    assert len(frames) > FRAMES / 2
    with pytest.raises(EndOfSequence, match="ended after"):
        sequence[len(frames)]


def test_each_frame_is_delivered_once(clip: Path) -> None:
    sequence = LiveSequence("clip", Played(clip), None)
    assert sequence[0].index == 0
    assert sequence[5].index == 5  # a run that goes on
    with pytest.raises(FrameError, match="clip#3: is gone"):
        sequence[3]
    sequence.close()


def test_without_a_clock_arrival_times_are_used(clip: Path) -> None:
    sequence = LiveSequence("clip", Played(clip, has_clock=False), None)
    before = time.time()
    frames = [sequence[index] for index in range(5)]
    times = [frame.timestamp for frame in frames]
    assert before - 0.5 < times[0] < times[-1] < time.time() + 0.1
    assert times == sorted(set(times))
    sequence.close()


def test_the_last_frame_can_be_chosen(clip: Path) -> None:
    part = LiveSequence("clip", Played(clip), None).part(stop=4)
    assert (len(part), part.known_length) == (4, 4)
    with pytest.raises(SequenceError, match="only the end can be chosen"):
        part.part(start=2)
    for wrong in (Selection(rate=5.0), Selection(stop="10s")):
        with pytest.raises(SequenceError, match="a live source does not have"):
            wrong.of(part)
    assert Selection(stop=2).of(part).known_length == 2
    assert Resized(part, (32, 24))[0].image.shape == (1, 1, 24, 32)
    part.close()


def test_frames_after_the_last_one_are_not_counted(clip: Path) -> None:
    sequence = LiveSequence("clip", Played(clip), None, backlog=1).part(stop=2)
    for _ in sequence:
        time.sleep(0.1)
    dropped = sequence.dropped
    assert dropped > 0
    time.sleep(0.2)
    assert sequence.dropped == dropped


def test_capture_starts_with_the_first_request(clip: Path) -> None:
    capture = Played(clip)
    others = threading.active_count()
    sequence = LiveSequence("clip", capture, None)
    assert threading.active_count() == others  # processes can be copies of this one
    assert capture._frame == 1
    time.sleep(live.STALE + 0.1)
    late = sequence[0]  # not the frame that was seen when it was opened
    assert numbers_of([late]) != [0]
    assert sequence.dropped == 0
    sequence.close()
    assert capture.released.wait(1.0)


def test_an_unused_source_is_released(clip: Path) -> None:
    capture = Played(clip)
    sequence = LiveSequence("clip", capture, None)
    assert not capture.released.is_set()
    sequence.close()
    assert capture.released.is_set()
    sequence.close()  # twice does no harm


def test_capture_clock() -> None:
    clock = CaptureClock()
    assert clock.at(5.0, 1000.0) == 1000.0
    assert clock.at(5.1, 1000.4) == pytest.approx(1000.1)  # came late, was captured in time
    assert clock.at(5.2, 1000.2) == pytest.approx(1000.2)
    assert clock.at(9.0, 1000.3) == pytest.approx(1000.3)  # the source's clock jumped
    assert clock.at(0.0, 1000.4) == pytest.approx(1000.4)  # and began anew
    assert clock.at(0.0, 1000.5) == pytest.approx(1000.5)  # and stands
    assert clock.at(0.0, 1000.5) > 1000.5


def test_a_source_without_frames_times_out() -> None:
    class Silent(Played):
        def __init__(self) -> None:
            pass

        def grab(self) -> bool:
            time.sleep(0.05)
            return False

        def release(self) -> None:
            pass

    with pytest.raises(SequenceError, match="no frame came"):
        LiveSequence("camera 0", Silent(), None, patience=0.5)


def test_live_sources_are_recognized(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert live.is_live("0")
    assert live.is_live("rtsp://user@camera:554/stream?x=1")
    assert live.is_live("http://camera/video.mjpg")
    assert not live.is_live("video.mp4")
    assert not live.is_live("https://server/video.mp4")
    (tmp_path / "0").mkdir()
    assert not live.is_live("0")
    with pytest.raises(SequenceError, match="97: cannot be opened as a camera"):
        open_sequence("97")
    with pytest.raises(SequenceError, match=r"^rtsp://127\.0\.0\.1:9/x: cannot be opened as a stream"):
        open_sequence("rtsp://user:secret@127.0.0.1:9/x")


def test_a_run_ends_with_the_source(clip: Path) -> None:
    sequence = LiveSequence("clip", Played(clip), parse_calibration("f=0.8w"))
    run = SLAM(sequence.camera, load_config(None, ["features.kind=opencv-orb"])).run(sequence)
    assert 0 < len(run.results) <= FRAMES
    assert run.skipped == []
    assert len(run.results) + sequence.dropped == FRAMES


def test_a_stream_that_is_stuck_does_not_keep_or_abort_the_process(tmp_path: Path) -> None:
    code = f"""
import sys, time
import cv2, numpy as np
class Stuck:
    frames = 0
    def __init__(self, address): pass
    def isOpened(self): return True
    def grab(self):
        self.frames += 1
        time.sleep(0.02 if self.frames < 6 else 600)
        return True
    def retrieve(self): return True, np.full((48, 64, 3), 100, np.uint8)
    def get(self, property_id): return 0.0
    def release(self): pass
cv2.VideoCapture = Stuck
from torchslam.cli.main import console
options = "--camera f=0.8w --limit 3 --processes 1".split()
sys.argv[1:] = ["run", "rtsp://camera/x", *options, "-o", {str(tmp_path)!r}]
console()
"""
    began = time.monotonic()
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 3, done.stderr
    assert "too little texture" in done.stderr
    assert "frames    3" in done.stdout
    assert time.monotonic() - began < 200
