"""A video file, decoded in order; going back decodes from the start again."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from torchslam.data.camera_argument import GivenCamera, fit_camera, is_guessed
from torchslam.data.formats.image_file import MAX_PIXELS, bgr_to_tensor, gray_to_tensor
from torchslam.data.formats.mp4 import claimed_samples
from torchslam.data.sequence import Sequence
from torchslam.errors import FrameError, SequenceError
from torchslam.utils.bounded_read import check_regular

SUFFIXES = frozenset(
    {".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".ts", ".mts", ".3gp", ".wmv"}
)
LOOKS_FOR = f"a video ({', '.join(sorted(SUFFIXES))})"
MP4 = (".mp4", ".mov", ".m4v", ".3gp")
MAX_BYTES = 1 << 40
MAX_FRAMES = 2_000_000
"""Frames of a video that are counted: 18 hours at 30 a second."""


class VideoSequence(Sequence):
    """Frames of a video at their presentation times, in seconds from the beginning of its stream.

    All frames are decoded once to learn how many there are and when: what a container says of them in advance is an
    estimate, and wrong where the rate varies. Frames are turned as the file says that they are to be shown.
    """

    def __init__(self, path: Path, camera: GivenCamera | None) -> None:
        """Raises SequenceError for a file that holds no video, CalibrationError for a camera that does not fit."""
        self._path = path
        _check(path)
        self._rewind()
        width, height = (
            self._capture.get(side) for side in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)
        )
        if width * height > MAX_PIXELS:
            raise SequenceError(
                f"{path}: frames of {width:.0f}x{height:.0f}, more than the {MAX_PIXELS} pixels that are read"
            )
        promised = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        times, notes = self._read_times(), []
        rate = self._capture.get(cv2.CAP_PROP_FPS)
        if len(times) > 1 and max(times) == min(times) and rate > 0:
            times = [index / rate for index in range(len(times))]
            notes.append(f"the file has no times; {rate:g} frames per second are taken")
        self._frames = _rising(times)
        first = self._read(0) if self._frames else None
        if first is None:
            raise SequenceError(f"{path}: cannot be read as a video")
        if len(self._frames) < len(times):
            notes.append(
                f"left out {len(times) - len(self._frames)} frames whose time is not after the one before"
            )
        # Some containers do not know; a stream that breaks off has fewer than promised.
        if len(times) < promised and path.suffix.lower() in (".mp4", ".mov", ".m4v", ".avi"):
            notes.append(f"{len(times)} frames can be decoded; the file speaks of {promised}")
        size = (first.shape[1], first.shape[0])
        super().__init__(
            path.stem,
            "video",
            None if camera is None else fit_camera(camera, size, str(path)),
            torch.tensor([times[frame] for frame in self._frames], dtype=torch.float64),
            size=size,
            guessed=is_guessed(camera),
            notes=notes,
        )

    def __getstate__(self) -> dict[str, Any]:
        return super().__getstate__() | {"_capture": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._rewind()

    def image(self, index: int) -> Tensor:
        return gray_to_tensor(cv2.cvtColor(self._frame(index), cv2.COLOR_BGR2GRAY))

    def color(self, index: int) -> Tensor:
        return bgr_to_tensor(self._frame(index))

    def image_name(self, index: int) -> str:
        return f"{self._path}#{index}"

    def _rewind(self) -> None:
        self._capture = cv2.VideoCapture(str(self._path))
        self._capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
        self._position = 0  # of the decoder, among all frames that can be decoded

    def _read_times(self) -> list[float]:
        """Seconds of every frame that can be decoded, as the container has them."""
        times: list[float] = []
        while len(times) < MAX_FRAMES and self._capture.grab():
            times.append(self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000)
            self._position += 1
        return times

    def _frame(self, index: int) -> np.ndarray:
        frame = self._read(self._frames[index])
        if frame is None:
            raise FrameError(f"{self.image_name(index)}: cannot be decoded")
        if (frame.shape[1], frame.shape[0]) != self.size:
            raise FrameError(f"{self.image_name(index)}: has another size than the first frame")
        return frame

    def _read(self, frame: int) -> np.ndarray | None:
        """The (H, W, 3) uint8 frame, blue first; those in between are skipped without conversion."""
        if frame < self._position:
            self._rewind()
        while self._position < frame:
            if not self._capture.grab():
                return None
            self._position += 1
        self._position += 1
        decoded, image = self._capture.read()
        return image if decoded else None


def matches(path: str) -> bool:
    """Whether the file has a video's suffix."""
    return Path(path).suffix.lower() in SUFFIXES and Path(path).is_file()


def open(path: str, camera: GivenCamera | None, rate: float | None) -> VideoSequence:
    """A video file; its times are its own. Raises SequenceError or CalibrationError."""
    return VideoSequence(Path(path), camera)


def _check(path: Path) -> None:
    """Raises SequenceError for what is no regular file, and for an MP4 that claims more frames than it has bytes."""
    try:
        check_regular(path, MAX_BYTES, "a video that is read")
        claimed = claimed_samples(path) if path.suffix.lower() in MP4 else 0
        size = path.stat().st_size
    except OSError as cause:
        raise SequenceError(f"{path}: cannot be read: {cause.strerror}") from cause
    if claimed > size:
        raise SequenceError(
            f"{path}: damaged: its index speaks of {claimed} frames, the file has {size} bytes"
        )


def _rising(times: list[float]) -> list[int]:
    """Which times are later than all before them."""
    chosen: list[int] = []
    for index, time in enumerate(times):
        if np.isfinite(time) and (not chosen or time > times[chosen[-1]]):
            chosen.append(index)
    return chosen
