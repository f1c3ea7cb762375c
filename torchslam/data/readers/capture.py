"""Frames of OpenCV's video decoder that are certain to be frames of the video.

OpenCV does not look whether FFmpeg has converted a frame. From FFmpeg 7.1 on (OpenCV 4.13), interlaced frames are not:
`retrieve` still returns True, with what lies in its buffer, which is the frame before or memory of anything else. Only
FFmpeg's log reports it. It is read where a frame may be such a one: the first one, and one that repeats the one before.
"""

from __future__ import annotations

import os
import re
import tempfile
import threading
from typing import Protocol

import cv2
import numpy as np
from jaxtyping import UInt8

from torchslam.errors import FrameError, SequenceError

STDERR = 2
"""File descriptor to which FFmpeg writes its log."""
SAMPLED = 16
"""Step of the rows that are compared with the previous frame."""
FAILURE = re.compile(rb"(Cannot convert interlaced)|: fmt:\S+ csp:")
"""Line of FFmpeg's log about a failed conversion: from which format to which, and why."""

SILENCING = ("OPENCV_FFMPEG_DEBUG", "OPENCV_FFMPEG_LOGLEVEL")
"""Variables that send FFmpeg's log elsewhere, or silence it. OpenCV looks at them when it first opens a video."""

MAX_ASPECT = 4.0
"""Largest ratio of the sides of a pixel; anamorphic lenses have 2."""

_LOCK = threading.Lock()


class Capture(Protocol):
    """The part of cv2.VideoCapture that is used."""

    def grab(self) -> bool:
        """Wait for the next frame; False at the end."""

    def retrieve(self) -> tuple[bool, np.ndarray]:
        """Decode the last frame, BGR; False if it is damaged."""

    def get(self, property_id: int) -> float:
        """Return a property, one of cv2.CAP_PROP_*; 0 if it is unknown."""

    def release(self) -> None:
        """Close the source."""


def open_capture(source: str) -> cv2.VideoCapture:
    """Open a video or a stream; FFmpeg's errors go to the error stream, whatever the environment variables are."""
    hidden = {name: os.environ.pop(name) for name in SILENCING if name in os.environ}
    try:
        return cv2.VideoCapture(source)
    finally:
        os.environ.update(hidden)


def pixel_aspect(capture: Capture, where: str) -> float:
    """Return width to height of a pixel as it is shown, which may be turned; 1 where the source does not say.

    Raises SequenceError for pixels that no camera has.
    """
    across, down = (capture.get(side) for side in (cv2.CAP_PROP_SAR_NUM, cv2.CAP_PROP_SAR_DEN))
    if across <= 0 or down <= 0:
        return 1.0
    aspect = across / down
    if not 1 / MAX_ASPECT <= aspect <= MAX_ASPECT:
        raise SequenceError(
            f"{where}: damaged: its pixels are {across:.0f}:{down:.0f}, wide to high; "
            f"no camera has more than {MAX_ASPECT:g}:1"
        )
    return 1 / aspect if capture.get(cv2.CAP_PROP_ORIENTATION_META) % 180 == 90 else aspect


class Retriever:
    """Retrieves the frames of one capture, and refuses those that were not converted.

    Args:
        capture: where frames were grabbed.
        command: how the video is converted to one without interlaced frames, for messages.
    """

    def __init__(self, capture: Capture, command: str) -> None:
        self._capture, self._command = capture, command
        self._before: np.ndarray | None = None

    def retrieve(self) -> UInt8[np.ndarray, "H W 3"] | None:
        """Return the frame that was grabbed last; None if it is damaged. Raises FrameError if it was not converted."""
        failure = None
        if self._before is None:
            decoded, image, failure = _retrieve_with_log(self._capture)
        else:
            decoded, image = self._capture.retrieve()
        if not decoded or image is None:  # both happen
            return None
        sample = image[::SAMPLED].copy()
        if self._before is not None and np.array_equal(sample, self._before):
            _, _, failure = _retrieve_with_log(self._capture)
        if failure is not None:
            self._before = None  # the next one is likely to be such a frame, too
            what = "interlaced" if failure[1] else "of a format"
            raise FrameError(f"{what}, which this OpenCV does not decode; convert it: {self._command}")
        self._before = sample
        return image


def _retrieve_with_log(capture: Capture) -> tuple[bool, np.ndarray, re.Match[bytes] | None]:
    """Retrieve a frame; also the log of a failure. Other lines go on to the error stream."""
    with _LOCK, tempfile.TemporaryFile() as log:
        try:
            kept = os.dup(STDERR)
        except OSError:  # it is closed
            kept = os.open(os.devnull, os.O_WRONLY)
        try:
            os.dup2(log.fileno(), STDERR)
            try:
                decoded, image = capture.retrieve()
            finally:
                os.dup2(kept, STDERR)
            log.seek(0)
            written = log.read()
            failure = FAILURE.search(written)
            if failure is None and written:
                os.write(kept, written)
        finally:
            os.close(kept)
    return decoded, image, failure
