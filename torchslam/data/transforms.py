"""Transformations of a sequence: a range of frames, a lower rate, another size, masks, another ground truth."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from torchslam.data.calibration import size_text
from torchslam.data.formats.frame_names import files_in, in_order
from torchslam.data.formats.image_file import MAX_PIXELS, SUFFIXES, has_transparency, read_gray
from torchslam.data.sequence import Sequence, Transformed
from torchslam.errors import FrameError, SequenceError
from torchslam.geometry.camera import Camera
from torchslam.types import Trajectory

TOLERANCE = 0.25  # tolerated earliness of a frame when frames are thinned out, as a ratio of the interval
DARK = 32
"""Gray level of 255 below which the darkest pixels of a mask with white ones are meant to be black: 16 in videos."""
SMALLEST = 32  # minimum width and height in pixels
SHOWN_SIDE = 480
"""Longer side of the pictures of a run that goes on, pixels. Tried at this value only: one takes 0.2 ms of a frame to
draw where there is no GPU."""


class Selection(NamedTuple):
    """Which frames of a sequence are used, as for `open_sequence`; `rate` is by their timestamps."""

    start: str | int = 0
    stop: str | int | None = None
    rate: float | None = None
    limit: int | None = None
    stride: int = 1

    def indices(self, times: Iterable[float]) -> Iterator[int]:
        """Yield the indices of the selected frames among all; no more times are taken than are needed."""
        begin, end = _place(self.start, "start"), math.inf if self.stop is None else _place(self.stop, "stop")
        frames = _between(times, begin, end)
        if self.rate is not None:
            frames = _thinned(frames, self.rate)
        most = None if self.limit is None else self.limit * self.stride
        return itertools.islice((index for index, _ in frames), 0, most, self.stride)

    def of(self, sequence: Sequence) -> Sequence:
        """Return the selected frames of a sequence. Raises SequenceError if none are left."""
        if self.stride < 1:
            raise SequenceError(f"{sequence.name}: the stride must be positive, not {self.stride}")
        if sequence.is_live:
            return self._of_live(sequence)
        indices = list(self.indices(sequence.timestamps.tolist()))
        if not indices:
            raise SequenceError(f"{sequence.name}: no frames left of {len(sequence)}")
        return sequence if len(indices) == len(sequence) else Transformed(sequence, indices)

    def _of_live(self, sequence: Sequence) -> Sequence:
        first, last = _place(self.start, "start"), None if self.stop is None else _place(self.stop, "stop")
        for place, what in ((first, "--start as a time"), (last, "--stop as a time"), (self.rate, "--fps")):
            if isinstance(place, float):
                raise SequenceError(
                    f"{sequence.name}: {what} needs timestamps known in advance, which a live source does not have"
                )
        last = last if self.limit is None else self.limit * self.stride
        if (first, last, self.stride) == (0, None, 1):
            return sequence
        return sequence.part(int(first), None if last is None else int(last), self.stride)


def _between(times: Iterable[float], begin: int | float, end: int | float) -> Iterator[tuple[int, float]]:
    """Yield the frames of [begin, end), which are numbers of frames, or seconds if they are floats, and their times."""
    first: float | None = None
    for index, time in enumerate(times):
        first = time if first is None else first
        # A time given as text is rounded, by less than the duration of a frame.
        begun, ended = (
            time - first >= place - 5e-7 if isinstance(place, float) else index >= place
            for place in (begin, end)
        )
        if ended:
            return
        if begun:
            yield index, time


def _thinned(frames: Iterable[tuple[int, float]], rate: float) -> Iterator[tuple[int, float]]:
    """Yield the frames to keep for at most `rate` a second."""
    first: float | None = None
    last = -1
    for index, time in frames:
        first = time if first is None else first
        slot = math.floor((time - first) * rate + TOLERANCE)
        if slot > last:
            yield index, time
            last = slot


def _place(text: str | int, which: str) -> int | float:
    """Return a number of a frame as int, a time in seconds as float. Raises SequenceError for anything else."""
    if isinstance(text, int) or re.fullmatch(r"\d{1,12}", text):
        if int(text) < 0:
            raise SequenceError(f"--{which} must be at least 0, not {text}")
        return int(text)
    found = re.fullmatch(r"(?:(?:(\d{1,4}):)?(\d{1,4}):)?(\d{1,9}(?:\.\d+)?)s?", text)
    if found is None:
        raise SequenceError(f"--{which}: expected a frame, as 120, or a time, as 12.5s or 1:30, got `{text}`")
    return 3600.0 * int(found[1] or 0) + 60.0 * int(found[2] or 0) + float(found[3])


def resize(sequence: Sequence, text: str) -> Sequence:
    """Resize images and camera to `640x480`, `640` (width; the height follows) or by a factor `0.5`.

    Raises SequenceError for anything else and for sizes that are too small or too large.
    """
    size = _new_size(sequence.size, text)
    return sequence if size == sequence.size else Resized(sequence, size)


class Resized(Transformed):
    """Sequence with resized images: averaged when shrinking, interpolated when growing."""

    def __init__(self, whole: Sequence, size: tuple[int, int]) -> None:
        camera = whole._camera
        super().__init__(whole, camera=None if camera is None else scale_camera(camera, size), size=size)

    def image(self, index: int) -> Float[Tensor, "1 1 H W"]:
        return self._resized(super().image(index)[0, 0])[None, None]

    def color(self, index: int) -> UInt8[Tensor, "H W 3"]:
        return self._resized(super().color(index))

    def mask(self, index: int) -> Bool[Tensor, "1 1 H W"] | None:
        mask = super().mask(index)
        if mask is None:
            return None
        return F.interpolate(mask.float(), self.size[::-1], mode="nearest-exact") > 0

    def _resized(self, image: Tensor) -> Tensor:
        smaller = self.size[0] <= image.shape[1] and self.size[1] <= image.shape[0]
        interpolation = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
        return torch.from_numpy(cv2.resize(image.numpy(), self.size, interpolation=interpolation))


def scale_camera(camera: Camera, size: tuple[int, int]) -> Camera:
    """Scale a camera to images of another size; integer pixel coordinates stay pixel centers."""
    x, y = size[0] / camera.width, size[1] / camera.height
    fx, fy, cx, cy = camera.params[..., :4].unbind(-1)
    scaled = torch.stack((fx * x, fy * y, (cx + 0.5) * x - 0.5, (cy + 0.5) * y - 0.5), dim=-1)
    return Camera(camera.model, torch.cat((scaled, camera.params[..., 4:]), dim=-1), size)


def _new_size(size: tuple[int, int], text: str) -> tuple[int, int]:
    width, height = size
    if both := re.fullmatch(r"(\d{1,6})[xX*](\d{1,6})", text):
        new = int(both[1]), int(both[2])
    elif re.fullmatch(r"\d{2,6}", text):
        new = int(text), round(height * int(text) / width)
    elif re.fullmatch(r"\d{0,2}\.\d+|\d{1,2}", text):
        new = round(width * float(text)), round(height * float(text))
    else:
        raise SequenceError(f"--resize: expected 640x480, 640 or 0.5, got `{text}`")
    if min(new) < SMALLEST or new[0] * new[1] > MAX_PIXELS:
        raise SequenceError(
            f"--resize {text}: images of {size_text(new)}; at least {SMALLEST} pixels each way "
            f"and at most {MAX_PIXELS} in all are possible"
        )
    return new


class Masked(Transformed):
    """Sequence with masks: no features are used where a mask is black, such as on a car's hood or a logo.

    Args:
        whole: the sequence.
        path: one mask of the image size for all frames, or a folder with one mask per frame, matched by name (`7.png`
            or `7.jpg.png` for `7.jpg`) or, if there are as many as frames, by order. Frames without a mask are used
            entirely.

    Raises SequenceError if there is no mask, or one of another size.
    """

    def __init__(self, whole: Sequence, path: str | Path) -> None:
        path = Path(path)
        self._files = _by_frame(path, whole) if path.is_dir() else {}
        count = len(self._files)
        notes = [f"masks for {count} of {len(whole)} frames"] if 0 < count < len(whole) else []
        super().__init__(whole, notes=notes)
        first = self._read(next(iter(self._files.values()), path))
        self._mask = None if self._files else first

    def mask(self, index: int) -> Bool[Tensor, "1 1 H W"] | None:
        """Return the mask of a frame. Raises FrameError if it cannot be read."""
        if index not in self._files:
            return self._mask
        try:
            return self._read(self._files[index])
        except SequenceError as error:
            raise FrameError(str(error)) from error

    def _read(self, path: Path) -> Tensor:
        try:
            gray = read_gray(path, "--mask")
            is_uniform = bool(gray.min() == gray.max())
            is_alpha = is_uniform and has_transparency(path)
        except FrameError as error:
            raise SequenceError(str(error)) from error
        size = (gray.shape[-1], gray.shape[-2])
        if size != self.size:
            raise SequenceError(
                f"{path}: the mask is {size_text(size)}, the images are {size_text(self.size)}"
            )
        if is_alpha:
            raise SequenceError(
                f"{path}: the mask is in the alpha channel, which is not read: save it as a black and white image"
            )
        if path.suffix.lower() in (".jpg", ".jpeg"):  # in which black is not exactly 0
            return gray > 0.5 * float(gray.max())
        darkest = round(255 * float(gray.min()))
        if 0 < darkest < DARK and gray.max() > 1 - DARK / 255:
            raise SequenceError(
                f"{path}: the darkest pixels of the mask are {darkest}, not 0, so that nothing would be masked; "
                "save it as a black and white image"
            )
        return gray > 0


def _by_frame(folder: Path, sequence: Sequence) -> dict[int, Path]:
    """Return the mask file of each frame."""
    if sequence.known_length is None:
        raise SequenceError(f"{folder}: a live source takes one mask for all frames")
    files = in_order(file for file in files_in(folder, SUFFIXES) if not file.name.startswith("."))
    by_name = {file.stem: file for file in files}
    names = [Path(sequence.image_name(index)) for index in range(len(sequence))]
    named = {index: by_name.get(name.name) or by_name.get(name.stem) for index, name in enumerate(names)}
    found = {index: file for index, file in named.items() if file is not None}
    if not found and len(files) == len(sequence):
        return dict(enumerate(files))
    if not found:
        raise SequenceError(f"{folder}: none of its {len(files)} images is the mask of a frame by its name")
    return found


class WithGroundTruth(Transformed):
    """Sequence with another ground truth, whose timestamps are of the same clock."""

    def __init__(self, whole: Sequence, groundtruth: Trajectory) -> None:
        super().__init__(whole, groundtruth=groundtruth)

    def pose(self, index: int) -> Float[Tensor, "4 4"] | None:
        return Sequence.pose(self, index)


def reduced(image: UInt8[np.ndarray, "H W 3"], side: int = SHOWN_SIDE) -> UInt8[np.ndarray, "h w 3"]:
    """Return an image reduced to a longer side; a smaller one as it is."""
    scale = min(1.0, side / max(image.shape[:2]))
    size = [max(1, round(scale * each)) for each in image.shape[1::-1]]
    return np.ascontiguousarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))
