"""Sequences of image files: plain folders of images and patterns, and the base of the readers of datasets."""

from __future__ import annotations

import contextlib
import os
import statistics
from collections import Counter
from collections.abc import Iterable
from collections.abc import Sequence as Listed
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor

from torchslam.data.calibration import CALIBRATION, FROM_EXIF, Calibration, GivenCamera
from torchslam.data.formats.calibration_files import read_calibration, read_focal
from torchslam.data.formats.frame_names import (
    FOLDERS,
    Found,
    find_frames,
    folder_kind,
    is_pattern,
    match_pattern,
    subfolder,
    times_in_names,
)
from torchslam.data.formats.image_file import (
    AS_COLOR,
    SAMPLES,
    bit_depth,
    has_transparency,
    is_turned,
    read_color,
    read_gray,
    read_pixels,
)
from torchslam.data.sequence import Reader, Sequence
from torchslam.data.text_file import check_rising, float64
from torchslam.errors import FrameError, SequenceError
from torchslam.types import Trajectory
from torchslam.utils.console import printable

DEFAULT_RATE = 30.0  # frame rate of images without timestamps
SHORTEST, LONGEST = 2e-4, 1e4
"""Seconds from image to image, beyond which times are taken to have another unit: microseconds read as nanoseconds, or
nanoseconds since the system was started as seconds."""
ATTEMPTS = 20  # number of unreadable images after which opening a sequence fails


@dataclass(frozen=True)
class ImageEntry:
    """One image of a list, at a time in seconds; `where` is file and line that name it, or the image, for messages."""

    timestamp: float
    path: Path
    where: str


class ImageSequence(Sequence):
    """Sequence of image files, decoded on access."""

    def __init__(
        self,
        name: str,
        kind: str,
        entries: Listed[ImageEntry],
        camera: GivenCamera | None,
        groundtruth: Trajectory | None = None,
        notes: Iterable[str] = (),
    ) -> None:
        """Raises SequenceError without images, for timestamps out of order or doubled, or where none of the
        first images can be read; CalibrationError for a camera of another image size."""
        if not entries:
            raise SequenceError(f"{name}: no images")
        times = [entry.timestamp for entry in entries]
        check_rising(times, [entry.where for entry in entries], SequenceError)
        interval = statistics.median(np.diff(times)) if len(times) > 1 else 1.0
        if not SHORTEST < interval < LONGEST:
            raise SequenceError(
                f"{entries[-1].where}: the images are {interval:.3g} s apart: their times seem to have another unit "
                "than the seconds that are expected (EuRoC's data.csv: nanoseconds)"
            )
        as_stored = isinstance(camera, Calibration) and camera.as_stored
        size, self._bits = _examine(entries, as_stored)
        notes = [*notes, f"{self._bits} of 16 bits are used"] if self._bits > 8 else notes
        if _are_transparent(entries):
            notes = [*notes, "images have transparent pixels, which are used as any other; --mask masks them"]
        super().__init__(
            name,
            kind,
            read_focal(entries[0].path) if camera == FROM_EXIF else camera,
            float64(times),
            groundtruth,
            size=size,
            notes=notes,
        )
        self._entries = entries
        self.as_stored = as_stored

    def image(self, index: int) -> Float[Tensor, "1 1 H W"]:
        entry = self._entries[index]
        image = read_gray(entry.path, entry.where, self._bits, self.as_stored)
        self._check_size(image.shape[2:], f"{entry.where}: {entry.path}")
        return image

    def color(self, index: int) -> UInt8[Tensor, "H W 3"]:
        entry = self._entries[index]
        image = read_color(entry.path, entry.where, self._bits, self.as_stored)
        self._check_size(image.shape, f"{entry.where}: {entry.path}")
        return image

    def image_name(self, index: int) -> str:
        return str(self._entries[index].path)

    def file_name(self, index: int) -> str:
        return printable(os.path.relpath(self._entries[index].path, self._root))

    def is_turned(self, index: int) -> bool:
        return is_turned(self._entries[index].path, self.as_stored)

    @cached_property
    def _root(self) -> str:
        """The folder of all images, also where it was unpacked: results must not depend on that place."""
        return os.path.commonpath({os.path.abspath(entry.path.parent) for entry in self._entries})


def _examine(entries: Listed[ImageEntry], as_stored: bool) -> tuple[tuple[int, int], int]:
    """Return the most common size of the first three readable images, since the first may differ, and their bit depth.

    The depth of images of 16 bits is that of the brightest color of a sample over the whole sequence.
    """
    sizes: list[tuple[int, int]] = []
    failures: list[FrameError] = []
    bits = 8
    is_deep = False
    for entry in entries:
        try:
            image = read_pixels(entry.path, entry.where, as_stored)
            sizes.append((image.shape[1], image.shape[0]))
            bits, is_deep = max(bits, bit_depth([image])), is_deep or image.dtype == np.uint16
        except FrameError as failure:
            failures.append(failure)
        if len(sizes) == 3 or len(failures) == ATTEMPTS:
            break
    if not sizes:
        raise SequenceError(f"none of the first {len(failures)} images can be read; the first: {failures[0]}")
    for entry in entries[:: max(1, len(entries) // SAMPLES)] if is_deep else ():
        with contextlib.suppress(FrameError):  # said when the frame is read
            bits = max(bits, bit_depth([read_pixels(entry.path, entry.where, as_stored, AS_COLOR)]))
    return Counter(sizes).most_common(1)[0][0], bits


def _are_transparent(entries: Listed[ImageEntry]) -> bool:
    """Return whether the first image that can be read has transparent pixels."""
    for entry in entries[:ATTEMPTS]:
        if entry.path.suffix.lower() not in (".png", ".webp", ".tif", ".tiff"):
            return False
        with contextlib.suppress(FrameError):  # said when the frame is read
            return has_transparency(entry.path)
    return False


def find_calibration(path: Path) -> Calibration | None:
    """The calibration file of a folder, if it has one."""
    for name in (CALIBRATION, "calib.txt"):
        if (path / name).is_file():
            return read_calibration(path / name)
    return None


def _is_folder(path: str) -> bool:
    """Return True if there are frames: in a folder, in one of its `FOLDERS`, or for a pattern such as `left-*.png`."""
    if is_pattern(path):
        return bool(match_pattern(path).frames)
    folder = Path(path)
    if not folder.is_dir() or folder_kind(folder):
        return False
    return bool(subfolder(folder) or find_frames(folder).frames)


def _open_folder(path: str, camera: GivenCamera | None, rate: float | None) -> ImageSequence:
    """Images in natural order (`9.png` before `10.png`), at the times in their names, or `rate` a second.

    `camera` overrides a calibration.txt with them or above them. Raises SequenceError or CalibrationError.
    """
    base = Path(path).parent if is_pattern(path) else Path(path)
    found, folder = _find(path, base)
    camera = camera if camera is not None else find_calibration(folder) or find_calibration(base)
    times, notes = times_in_names(found.frames), found.notes
    entries = at_rate(found.frames, rate or DEFAULT_RATE)
    if times is not None:
        entries = [replace(entry, timestamp=time) for entry, time in zip(entries, times, strict=True)]
        notes = [*notes, "the names of the images are their times"]
    sequence = ImageSequence(base.resolve().name, "image folder", entries, camera, None, notes)
    if times is None:
        sequence.counted_until = (len(entries) - 0.5) / (rate or DEFAULT_RATE)
    return sequence


def at_rate(frames: list[Path], rate: float) -> list[ImageEntry]:
    """Build entries for frames without timestamps, `rate` per second."""
    return [ImageEntry(index / rate, image, str(image)) for index, image in enumerate(frames)]


def _find(path: str, base: Path) -> tuple[Found, Path]:
    if is_pattern(path):
        return match_pattern(path), base
    found, inner = find_frames(base), subfolder(base)
    if inner is None:
        return found, base
    inside = find_frames(inner)
    if len(inside.frames) > len(found.frames):  # a preview beside them, or nothing
        inside.left_out[f"images beside {inner.name}/"] += len(found.frames)
        return Found(inside.frames, +inside.left_out), inner
    found.left_out[f"images in {inner.name}/"] += len(inside.frames)
    return Found(found.frames, +found.left_out), base


FOLDER = Reader(f"images, or a folder {'/, '.join(FOLDERS)}/ with images", _is_folder, _open_folder)
