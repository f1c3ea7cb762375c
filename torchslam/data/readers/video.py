"""OpenCV's decoder of videos, and video files, decoded in order; seeking backwards decodes from the start again.

FFmpeg allocates a table of all frames that the index of an MP4 declares, so that number is checked first. Source:
ISO/IEC 14496-12: boxes of a size and a name; stsz and stz2 hold the number of samples, stts and ctts run lengths of
durations and offsets, trun the samples of a fragment. A sample takes at least one byte of the file.
"""

from __future__ import annotations

import math
import os
import re
import struct
import sys
import tempfile
import threading
from collections.abc import Iterable, Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any, BinaryIO, Protocol

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor
from tqdm import tqdm

from torchslam.data.calibration import GivenCamera
from torchslam.data.formats.image_file import MAX_PIXELS, bgr_to_tensor, gray_to_tensor
from torchslam.data.sequence import Need, Reader, Sequence, aspect_text, exhaust
from torchslam.data.text_file import float64
from torchslam.errors import FrameError, SequenceError, TorchslamError
from torchslam.utils.console import printable, tqdm_options
from torchslam.utils.files import check_regular
from torchslam.utils.forks import forget_in_forks, never_release

SUFFIXES = frozenset(
    {".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".ts", ".mts", ".3gp", ".wmv"}
)
KIND = "video"  # of these sequences
MP4 = (".mp4", ".mov", ".m4v", ".3gp")
MAX_FRAMES = 2_000_000  # maximum number of frames: 18 hours at 30 frames per second
QUIET = 2.0  # seconds of decoding before a progress bar appears
MANY = 100  # frames that are skipped with a progress bar
MAX_ASPECT = 4.0  # largest ratio of the sides of a pixel; anamorphic lenses have 2
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
    # These send FFmpeg's log elsewhere, or silence it. OpenCV looks at them when it first opens a video.
    names = ("OPENCV_FFMPEG_DEBUG", "OPENCV_FFMPEG_LOGLEVEL")
    hidden = {name: os.environ.pop(name) for name in names if name in os.environ}
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

    OpenCV does not look whether FFmpeg has converted a frame. From FFmpeg 7.1 on (OpenCV 4.13), interlaced frames are
    not: `retrieve` still returns True, with what lies in its buffer, which is the frame before or memory of anything
    else. Only FFmpeg's log reports it. It is read where a frame may be such a one: the first one, and one that repeats
    the one before.

    Args:
        capture, source: where frames were grabbed, and its name for messages.
        progressive: name of a video without interlaced frames that it can be converted to.
    """

    def __init__(self, capture: Capture, source: str, progressive: str) -> None:
        self._capture = capture
        # It writes whole frames, at the same times.
        self._command = f'ffmpeg -i "{source}" -vf bwdif=send_frame -crf 16 "{progressive}"'
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
        sample = image[::16].copy()  # some of the rows
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
    stderr = 2
    with _LOCK, tempfile.TemporaryFile() as log:
        try:
            kept = os.dup(stderr)
        except OSError:  # it is closed
            kept = os.open(os.devnull, os.O_WRONLY)
        try:
            os.dup2(log.fileno(), stderr)
            try:
                decoded, image = capture.retrieve()
            finally:
                os.dup2(kept, stderr)
            log.seek(0)
            written = log.read()
            # The line about a failed conversion: from which format to which, and why.
            failure = re.search(rb"(Cannot convert interlaced)|: fmt:\S+ csp:", written)
            if failure is None and written:
                os.write(kept, written)
        finally:
            os.close(kept)
    return decoded, image, failure


class Bar(tqdm):
    """A progress bar without tqdm's monitor, which is a thread: this process may be forked."""

    monitor_interval = 0


class VideoSequence(Sequence):
    """Frames of a video at their presentation times, in seconds from the beginning of its stream.

    All frames that are needed are decoded once to determine their number and times, since the container's values are
    estimates and wrong for variable frame rates. Frames are rotated to the display orientation of the file.
    """

    def __init__(self, path: Path, camera: GivenCamera | None, need: Need = exhaust) -> None:
        """Raises SequenceError for a file that holds no video, CalibrationError for a camera that does not fit."""
        self._path = path
        self._last: tuple[int, np.ndarray] | None = None
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
        first, times, ended = self._read_times(need, promised)
        notes = []
        rate = self._capture.get(cv2.CAP_PROP_FPS)
        if len(times) > 1 and max(times) == min(times) and rate > 0:
            times = [index / rate for index in range(len(times))]
            notes.append(f"the file has no timestamps; {rate:g} frames per second are assumed")
        self._frames = list(_rising(times))
        if first is None or not self._frames:
            raise SequenceError(f"{path}: cannot be read as a video")
        if len(self._frames) < len(times):
            notes.append(
                f"left out {len(times) - len(self._frames)} frames whose time is not after the one before"
            )
        # Some containers do not know the number; a truncated stream has fewer frames than declared.
        if ended and len(times) < promised and path.suffix.lower() in (".mp4", ".mov", ".m4v", ".avi"):
            notes.append(f"{len(times)} frames can be decoded; the file declares {promised}")
        size = (first.shape[1], first.shape[0])
        aspect = pixel_aspect(self._capture, str(path))
        super().__init__(
            path.stem,
            KIND,
            camera,
            float64([times[frame] for frame in self._frames]),
            size=size,
            notes=notes,
            pixel_aspect=aspect,
        )
        ratio = aspect if self._camera is None else float(self._camera.fy / self._camera.fx)
        if abs(ratio / aspect - 1) > 0.02:
            contradiction = (
                f"the file declares pixels of {aspect_text(aspect)}, width to height, so fy should be "
                f"{aspect:.4g} fx; the given camera has {ratio:.4g}"
            )
            self.notes = (*self.notes, contradiction)

    def __getstate__(self) -> dict[str, Any]:
        return super().__getstate__() | {"_capture": None, "_retriever": None, "_last": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._rewind()

    def image(self, index: int) -> Float[Tensor, "1 1 H W"]:
        return gray_to_tensor(cv2.cvtColor(self._frame(index), cv2.COLOR_BGR2GRAY))

    def color(self, index: int) -> UInt8[Tensor, "H W 3"]:
        return bgr_to_tensor(self._frame(index))

    def image_name(self, index: int) -> str:
        return f"{self._path}#{index}"

    def forget_handle(self) -> None:
        never_release(self._capture)
        self._position = sys.maxsize  # so that the next frame opens the file anew

    def close_decoder(self) -> None:
        self._capture.release()
        self._position = sys.maxsize

    def _rewind(self) -> None:
        forget_in_forks(self)
        # As an absolute path: FFmpeg takes what stands before a colon for a protocol, unless a slash comes first.
        self._capture = open_capture(str(self._path.absolute()))
        self._capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
        progressive = f"{self._path.stem}-progressive.mp4"
        self._retriever = Retriever(self._capture, str(self._path.absolute()), progressive)
        self._position = 0  # of the decoder, among all frames that can be decoded

    def _read_times(self, need: Need, promised: int) -> tuple[np.ndarray | None, list[float], bool]:
        """The first frame, seconds of the frames that are needed as the container has them, and if these are all."""
        first: np.ndarray | None = None
        times: list[float] = []
        ended = False

        def grabbed() -> Iterator[float]:
            nonlocal first, ended
            while len(times) < MAX_FRAMES and self._capture.grab():
                self._position += 1
                if not times:
                    first = self._retrieve(str(self._path), SequenceError)
                times.append(self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000)
                bar.update()
                yield times[-1]
            ended = True

        total = promised if 0 < promised <= MAX_FRAMES else None
        with self._bar("times of the frames", total) as bar:
            need(times[frame] for frame in _rising(grabbed()))
        return first, times, ended

    def _bar(self, what: str, total: int | None) -> Bar:
        """A progress bar for what takes long."""
        words = f"{what} of {printable(self._path.name)}"
        return Bar(total=total, desc=words, delay=QUIET, leave=False, **tqdm_options())

    def _retrieve(self, where: str, error: type[TorchslamError]) -> np.ndarray | None:
        try:
            return self._retriever.retrieve()
        except FrameError as cause:
            raise error(f"{where}: {cause}") from cause

    def _frame(self, index: int) -> np.ndarray:
        """The frame, which is kept: its color after its gray image would take the decoder back to the beginning."""
        if self._last is None or self._last[0] != index:
            frame = self._read(self._frames[index], self.image_name(index))
            if frame is None:
                raise FrameError(f"{self.image_name(index)}: cannot be decoded")
            self._check_size(frame.shape, self.image_name(index))
            self._last = index, frame
        return self._last[1]

    def _read(self, frame: int, where: str) -> np.ndarray | None:
        """The (H, W, 3) uint8 frame, blue first; those in between are skipped without conversion. Raises FrameError."""
        if frame < self._position:
            self._rewind()
        skipped = frame - self._position
        with self._bar(f"to frame {frame}", skipped) if skipped >= MANY else nullcontext() as bar:
            while self._position < frame:
                if not self._capture.grab():
                    return None
                self._position += 1
                if bar is not None:
                    bar.update()
        self._position += 1
        return self._retrieve(where, FrameError) if self._capture.grab() else None


def _check(path: Path) -> None:
    """Raise SequenceError for a special file, a name that OpenCV crashes on, and an MP4 with more frames than bytes."""
    try:
        str(path.absolute()).encode()
    except UnicodeEncodeError:
        raise SequenceError(f"{path}: its name is not UTF-8, which OpenCV cannot open; rename it") from None
    try:
        check_regular(path, 1 << 40, "a video that is read")
        claimed = claimed_samples(path) if path.suffix.lower() in MP4 else 0
        size = path.stat().st_size
    except OSError as cause:
        raise SequenceError(f"{path}: cannot be read: {cause.strerror}") from cause
    if claimed > size:
        raise SequenceError(
            f"{path}: damaged: its index declares {claimed} frames, but the file has {size} bytes"
        )


def _rising(times: Iterable[float]) -> Iterator[int]:
    """Yield the indices of the times that are later than all before them."""
    latest = -math.inf
    for index, time in enumerate(times):
        if math.isfinite(time) and time > latest:
            latest = time
            yield index


CONTAINERS = (b"moov", b"trak", b"edts", b"mdia", b"minf", b"stbl", b"moof", b"traf")
HEADER, LARGE_HEADER = 8, 16
"""Bytes of the header of a box, with a size of 32 and of 64 bits (ISO/IEC 14496-12, 4.2)."""


def claimed_samples(path: Path) -> int:
    """The most samples that a table in the file speaks of; 0 where there is none. Raises OSError."""
    with path.open("rb") as file:
        size = file.seek(0, 2)
        # The number of boxes bounds the time for a damaged file; moov, trak, mdia, minf, stbl are five levels.
        boxes = _boxes(file, 0, size, left=[1_000_000], depth=8)
        return max((_samples(file, *box) for box in boxes), default=0)


def _boxes(
    file: BinaryIO, start: int, end: int, left: list[int], depth: int
) -> Iterator[tuple[bytes, int, int]]:
    """Name, and where the content begins and ends, of every box; those in containers too.

    `left` has one counter: the number of boxes that may still be read; `depth` is the maximum depth of nesting.
    """
    while start + HEADER <= end and left[0] > 0:
        left[0] -= 1
        file.seek(start)
        head = file.read(LARGE_HEADER).ljust(LARGE_HEADER, b"\0")
        size, kind = struct.unpack_from(">I4s", head)
        inside = HEADER
        if size == 1:  # it follows in eight bytes
            (size,), inside = struct.unpack_from(">Q", head, HEADER), LARGE_HEADER
        # 0: to the end; a size that is too large is cut, as FFmpeg cuts it
        stop = end if size == 0 else min(end, start + max(size, inside))
        yield kind, start + inside, stop
        if kind in CONTAINERS and depth > 0:
            yield from _boxes(file, start + inside, stop, left, depth - 1)
        start = stop


def _samples(file: BinaryIO, kind: bytes, start: int, end: int) -> int:
    """Return the number of samples that a table declares; 0 for other boxes."""
    at = {b"stsz": 8, b"stz2": 8, b"stts": 4, b"ctts": 4, b"trun": 4}.get(kind)
    if at is None or end - start < at + 4:
        return 0
    file.seek(start + at)
    (count,) = struct.unpack(">I", file.read(4))
    if kind not in (b"stts", b"ctts"):
        return int(count)
    samples, at_once = 0, 1 << 16  # runs of equal durations, 8 bytes each
    for runs in range(min(count, (end - file.tell()) // 8), 0, -at_once):
        some = file.read(8 * min(runs, at_once))
        samples += sum(run for run, _ in struct.iter_unpack(">II", some[: len(some) // 8 * 8]))
    return samples


VIDEO = Reader(
    f"a video ({', '.join(sorted(SUFFIXES))})",
    lambda path: Path(path).suffix.lower() in SUFFIXES and Path(path).is_file(),
    lambda path, camera, rate, need: VideoSequence(Path(path), camera, need),
    takes_need=True,
)
