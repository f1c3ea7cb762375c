"""Live sources: a camera by number or a stream by address; frames are dropped if processing is too slow."""

from __future__ import annotations

import atexit
import re
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float
from torch import Tensor

from torchslam.data.calibration import GivenCamera
from torchslam.data.formats.image_file import gray_to_tensor
from torchslam.data.readers.video import SUFFIXES, Capture, Retriever, open_capture, pixel_aspect
from torchslam.data.sequence import EndOfSequence, Reader, Sequence
from torchslam.data.text_file import float64
from torchslam.errors import FrameError, SequenceError
from torchslam.utils.console import without_credentials
from torchslam.utils.forks import forget_in_forks, never_release

ADDRESS = re.compile(r"(rtsps?|rtmp|udp|tcp|https?)://\S+")
PATIENCE = 15.0  # seconds without a frame after which a stream has ended
STALE = 0.5  # age in seconds above which the frame read on opening is discarded


class LiveSequence(Sequence):
    """Frames of a live source, read by a thread that keeps the newest few; `image` waits for a new one.

    The thread starts with the first requested frame, since a process with threads cannot be forked.

    Frames are numbered as they are delivered, without gaps for dropped ones. Their number is unknown, so there is no
    `len`; after the last frame `EndOfSequence` is raised. Timestamps are seconds since 1970 at which a frame was
    captured, by the clock of the source if it has one.
    """

    def __init__(
        self,
        name: str,
        capture: Capture,
        camera: GivenCamera | None,
        patience: float = PATIENCE,
        backlog: int = 10,
    ) -> None:
        """Drop the oldest of more than `backlog` queued frames; after `patience` seconds the source has ended.

        Raises SequenceError where no frame comes, CalibrationError for a camera that does not fit.
        """
        self._capture = capture
        self._retriever = Retriever(capture, name, "recording.mp4")
        self._refusal: FrameError | None = None  # of a frame that cannot be converted
        self._patience = patience
        self._clock = CaptureClock()
        self._fresh = threading.Condition()
        self._arrived: deque[tuple[float, np.ndarray]] = deque(maxlen=backlog)
        self._ended = self._closing = False
        self._dropped = self._replaced = 0
        self._limit: int | None = None
        self._given, self._time = 0, 0.0
        self._is_watched = self._is_inherited = False
        _SOURCES.add(self)
        forget_in_forks(self)
        self._thread = self._watch_until(lambda: bool(self._arrived or self._refusal))
        self._thread.join(patience)
        if not self._arrived:
            self.close()
            if self._refusal is not None:
                raise SequenceError(f"{name}: {self._refusal}") from self._refusal
            raise SequenceError(f"{name}: no frame came within {patience:g} s: is it there, and free?")
        first = self._arrived[0][1]
        size = (first.shape[1], first.shape[0])
        aspect = pixel_aspect(capture, name)
        super().__init__(name, "live", camera, float64([]), size=size, pixel_aspect=aspect)

    def __len__(self) -> int:
        if self._limit is None:
            raise TypeError(f"{self.name}: a live source has no length")
        return self._limit

    @property
    def known_length(self) -> int | None:
        return self._limit

    @property
    def dropped(self) -> int:
        return self._dropped

    @property
    def backlog(self) -> int:
        return len(self._arrived)

    def part(self, start: int = 0, stop: int | None = None, stride: int = 1) -> Sequence:
        """The first `stop` frames: nothing else can be chosen of what is not there yet. Raises SequenceError."""
        if start or stride != 1:
            raise SequenceError(f"{self.name}: of a live source only the end can be chosen (--stop, --limit)")
        self._limit = stop
        return self

    def image(self, index: int) -> Float[Tensor, "1 1 H W"]:
        """The next frame. Raises EndOfSequence where the source has ended, FrameError for a frame that is gone."""
        if self._is_inherited:
            raise SequenceError(f"{self.name}: a live source can only be read by the process that opened it")
        if index < self._given:
            raise FrameError(
                f"{self.image_name(index)}: is gone; a live source gives each frame once, in order"
            )
        if not self._is_watched and not self._ended:
            self._begin()
        with self._fresh:
            self._fresh.wait_for(lambda: self._arrived or self._ended, self._patience)
            if not self._arrived:
                self.close()
                raise EndOfSequence(f"{self.name}: ended after {self._given} frames")
            self._time, frame = self._arrived.popleft()
            self._dropped += self._replaced  # what comes after the last frame that is asked for is not missed
            self._replaced = 0
        self._given = index + 1
        self._check_size(frame.shape, self.image_name(index))
        return gray_to_tensor(frame if frame.ndim == 2 else cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY))

    def image_name(self, index: int) -> str:
        return f"{self.name}#{index}"

    def timestamp(self, index: int) -> float:
        return self._time

    def forget_handle(self) -> None:
        never_release(self._capture)
        self._is_inherited = self._ended = True
        self._fresh = threading.Condition()  # a thread that is not here may have the lock

    def close_decoder(self) -> None:
        """Do nothing: a live source cannot be opened again."""

    def close(self) -> None:
        """Stop watching and let the source go."""
        self._closing = True
        if not self._thread.is_alive():
            self._end()

    def _begin(self) -> None:
        """Watch from now on, without what was seen long ago."""
        self._is_watched = True
        if time.time() - self._arrived[0][0] > STALE:
            self._arrived.clear()
        self._thread = self._watch_until(lambda: False)

    def _watch_until(self, is_enough: Callable[[], bool]) -> threading.Thread:
        """A thread that keeps the newest frames until that is enough, the source ends or it is closed."""

        def watch() -> None:
            ends = True
            try:
                while not self._closing and self._keep_next():
                    if is_enough():
                        ends = False
                        return
            finally:
                if ends:
                    self._end()

        thread = threading.Thread(target=watch, name="torchslam live source", daemon=True)
        thread.start()
        return thread

    def _keep_next(self) -> bool:
        """Return True if there was another frame, even one that could not be decoded."""
        if not self._capture.grab():
            return False
        captured = self._clock.at(self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000, time.time())
        try:
            frame = self._retriever.retrieve()
        except FrameError as refusal:
            self._refusal, frame = refusal, None
        if frame is not None:
            with self._fresh:
                self._replaced += len(self._arrived) == self._arrived.maxlen
                self._arrived.append((captured, frame))
                self._fresh.notify_all()
        return True

    def _end(self) -> None:
        with self._fresh:
            if not self._ended:
                self._capture.release()
            self._ended = True
            self._fresh.notify_all()


_SOURCES: weakref.WeakSet[LiveSequence] = weakref.WeakSet()  # those that there are; a thread keeps its source


def close_sources() -> bool:
    """Close all sources, and return whether their threads have ended after two seconds at most."""
    sources = list(_SOURCES)
    end = time.monotonic() + 2.0
    for source in sources:
        source.close()
    for source in sources:
        source._thread.join(max(0.0, end - time.monotonic()))
    return not any(source._thread.is_alive() for source in sources)


# Threads that end on their own before the interpreter does are not ended by it, in the middle of OpenCV.
atexit.register(close_sources)


class CaptureClock:
    """Capture times on our clock: by the source's own clock, from the first frame on, as long as both stay within 1 s.

    Arrival times jitter with the network and the load of the machine; the source's clock does not.
    """

    def __init__(self) -> None:
        self._offset: float | None = None
        self._own = self._last = 0.0

    def at(self, own: float, now: float) -> float:
        """Seconds since 1970 of a frame that has the time `own` and came at `now`; it never goes back."""
        stands = own <= self._own  # a source without a clock reports a constant time
        if self._offset is None or stands or abs(own + self._offset - now) > 1:
            self._offset = now - own
        self._own = own
        self._last = max(own + self._offset, self._last + 1e-6)
        return self._last


def is_address(path: str) -> bool:
    """Return True for the address of a stream or of a file."""
    return ADDRESS.fullmatch(path) is not None


def is_live(path: str) -> bool:
    """Return True for an address, and for the number of a camera that is not a file."""
    if is_address(path):  # a file does not drop frames
        return not path.startswith("http") or Path(path).suffix.lower() not in SUFFIXES
    return re.fullmatch(r"\d{1,2}", path) is not None and not Path(path).exists()


def _open_live(path: str, camera: GivenCamera | None, rate: float | None) -> LiveSequence:
    """A camera or a stream. Raises SequenceError where it cannot be opened."""
    number = path.isdecimal()
    shown = without_credentials(path)
    capture = cv2.VideoCapture(int(path)) if number else open_capture(path)
    if not capture.isOpened():
        file = "; download a file, and give that" if shown.startswith("http") else ""
        raise SequenceError(f"{shown}: cannot be opened as a {'camera' if number else 'stream'}{file}")
    return LiveSequence(f"camera {path}" if number else shown, capture, camera)


LIVE = Reader("a camera's number, or an rtsp:// or http:// address", is_live, _open_live)
