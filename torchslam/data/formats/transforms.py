"""What can be done to any sequence, one after the other: a part of it, fewer frames, another size, a mask."""

from __future__ import annotations

import math
import re

import cv2
import torch
import torch.nn.functional as F
from torch import Tensor

from torchslam.data.calibration import size_text
from torchslam.data.formats.image_file import MAX_PIXELS
from torchslam.data.sequence import Sequence, Transformed
from torchslam.errors import SequenceError
from torchslam.geometry.camera import Camera

TOLERANCE = 0.25
"""Share of the interval by which a frame may come early when frames are thinned out: real rates waver."""
SMALLEST = 32
"""Pixels: no front end finds a feature in less."""


def cut(sequence: Sequence, start: str | int = 0, stop: str | int | None = None) -> Sequence:
    """The frames from `start` to before `stop`: numbers of frames, or times after the first one as `12.5s` or `1:30`.

    Raises SequenceError where that leaves none.
    """
    first = _frame_at(sequence, start, "start")
    last = None if stop is None else _frame_at(sequence, stop, "stop")
    return sequence if first == 0 and last is None else sequence.part(first, last)


def thin(sequence: Sequence, rate: float) -> Sequence:
    """At most `rate` frames per second, by their timestamps: all of them where there are fewer."""
    _check_known(sequence, "--fps")
    elapsed = (sequence.timestamps - sequence.timestamps[:1]).tolist()
    chosen: list[int] = []
    last = -1
    for index, time in enumerate(elapsed):
        slot = math.floor(time * rate + TOLERANCE)
        if slot > last:
            chosen.append(index)
            last = slot
    return sequence if len(chosen) == len(sequence) else Transformed(sequence, chosen)


def resize(sequence: Sequence, text: str) -> Sequence:
    """Images of another size, and the camera with them: `640x480`, `640` (width; the height follows) or `0.5`.

    Raises SequenceError for anything else, and for sizes without pixels.
    """
    size = _new_size(sequence.size, text)
    return sequence if size == sequence.size else Resized(sequence, size)


class Resized(Transformed):
    """Images at another size: averaged where they shrink, interpolated where they grow."""

    def __init__(self, whole: Sequence, size: tuple[int, int]) -> None:
        camera = whole._camera
        super().__init__(whole, camera=None if camera is None else scale_camera(camera, size), size=size)

    def image(self, index: int) -> Tensor:
        return self._resized(super().image(index)[0, 0])[None, None]

    def color(self, index: int) -> Tensor:
        return self._resized(super().color(index))

    def mask(self, index: int) -> Tensor | None:
        mask = super().mask(index)
        if mask is None:
            return None
        return F.interpolate(mask.float(), self.size[::-1], mode="nearest-exact") > 0

    def _resized(self, image: Tensor) -> Tensor:
        smaller = self.size[0] <= image.shape[1] and self.size[1] <= image.shape[0]
        interpolation = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
        return torch.from_numpy(cv2.resize(image.numpy(), self.size, interpolation=interpolation))


def scale_camera(camera: Camera, size: tuple[int, int]) -> Camera:
    """The same camera for images resized to `size`; pixel (0, 0) is a center before and after."""
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


def _frame_at(sequence: Sequence, text: str | int, which: str) -> int:
    """The number of the first frame that is not before `text`."""
    if isinstance(text, int) or re.fullmatch(r"\d{1,12}", text):
        if int(text) < 0:
            raise SequenceError(f"{sequence.name}: --{which} must be at least 0, not {text}")
        return int(text)
    found = re.fullmatch(r"(?:(?:(\d{1,4}):)?(\d{1,4}):)?(\d{1,9}(?:\.\d+)?)s?", text)
    if found is None:
        raise SequenceError(f"--{which}: expected a frame, as 120, or a time, as 12.5s or 1:30, got `{text}`")
    seconds = 3600 * int(found[1] or 0) + 60 * int(found[2] or 0) + float(found[3])
    _check_known(sequence, f"--{which} as a time")
    elapsed = sequence.timestamps - sequence.timestamps[:1]
    # Times as text are rounded; half a microsecond is less than any frame lasts.
    return int(torch.searchsorted(elapsed, seconds - 5e-7))


def _check_known(sequence: Sequence, what: str) -> None:
    """Raises SequenceError where the times of the frames are not known in advance."""
    if not len(sequence.timestamps):
        raise SequenceError(
            f"{sequence.name}: {what} needs times that are known in advance, a live source has none"
        )
