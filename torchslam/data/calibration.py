"""Cameras whose image size is not known yet: numbers that are checked, focal lengths that are guessed, presets."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import torch

from torchslam.data.formats.text_file import numbered_lines, parse_floats
from torchslam.errors import CalibrationError
from torchslam.geometry.camera import Camera

COUNTS = {"pinhole": (4,), "radial_tangential": (8, 9), "fisheye": (8,)}
NUMBERS = "fx fy cx cy [k1 k2 p1 p2 [k3]], or `fisheye` and fx fy cx cy k1 k2 k3 k4"

Size = tuple[int, int]


@dataclass(frozen=True)
class Calibration:
    """A camera whose image size may not be known yet.

    model:   "pinhole", "radial_tangential" or "fisheye"
    params:  fx fy cx cy, pixels, and all of the model's distortion coefficients
    source:  where the numbers come from, for messages
    size:    (width, height) of the images it is for, where the source says
    guessed: whether it is only near the truth
    """

    model: str
    params: tuple[float, ...]
    source: str
    size: Size | None = None
    guessed: bool = False

    @staticmethod
    def from_numbers(
        numbers: list[float], source: str, model: str | None = None, size: Size | None = None
    ) -> Calibration:
        """Checked numbers; the model follows from how many there are unless it is named.

        Raises CalibrationError for a wrong count or a focal length that is not positive.
        """
        counts = COUNTS[model] if model else (4, 8, 9)
        if len(numbers) not in counts:
            raise CalibrationError(f"{source}: expected {NUMBERS}, got {len(numbers)} numbers")
        if numbers[0] <= 0 or numbers[1] <= 0:
            raise CalibrationError(
                f"{source}: focal lengths must be positive, got {numbers[0]:g} and {numbers[1]:g}"
            )
        if model is None and any(numbers[4:]):
            model = "radial_tangential"
        elif model is None:
            model, numbers = "pinhole", numbers[:4]
        if model == "radial_tangential":
            numbers = [*numbers, 0.0][:9]
        return Calibration(model, tuple(numbers), source, size)

    def camera(self, size: Size) -> Camera:
        """The camera for images of `size`. Raises CalibrationError where it is for another one."""
        if self.size not in (None, size):
            raise CalibrationError(
                f"{self.source}: the camera is for images of {size_text(self.size or size)}, "
                f"these are {size_text(size)}"
            )
        return Camera(self.model, torch.tensor(self.params, dtype=torch.float64), size)


@dataclass(frozen=True)
class FocalGuess:
    """A focal length alone: square pixels, no distortion, the principal point in the middle.

    focal:  in units of `unit`: "px" pixels, "w" widths of the image, "diagonal" diagonals of it
    source: what it comes from, for messages
    """

    focal: float
    unit: str
    source: str
    guessed: bool = True

    def camera(self, size: Size) -> Camera:
        """The camera for images of `size`."""
        unit = {"px": 1.0, "w": float(size[0]), "diagonal": math.hypot(*size)}[self.unit]
        focal = self.focal * unit
        return Camera.pinhole(focal, focal, (size[0] - 1) / 2, (size[1] - 1) / 2, size=size)


@dataclass(frozen=True)
class Preset:
    """The published cameras of a dataset, told apart by the size of their images."""

    name: str
    cameras: tuple[Calibration, ...]

    @property
    def guessed(self) -> bool:
        return any(camera.guessed for camera in self.cameras)

    def camera(self, size: Size) -> Camera:
        """The one for images of `size`. Raises CalibrationError where there is none."""
        for calibration in self.cameras:
            if calibration.size == size:
                return calibration.camera(size)
        sizes = " or ".join(size_text(each.size) for each in self.cameras if each.size)
        raise CalibrationError(
            f"camera `{self.name}`: it is for images of {sizes}, these are {size_text(size)}"
        )


def parse_numbers(text: str, source: str) -> Calibration:
    """A calibration from `fx,fy,cx,cy[,k1,k2,p1,p2[,k3]]` or `fisheye,fx,fy,cx,cy,k1,k2,k3,k4`.

    Raises CalibrationError naming `source`.
    """
    words = text.replace(",", " ").split(maxsplit=1)
    if not words:
        raise CalibrationError(f"{source}: expected {NUMBERS}, got nothing")
    model = words[0] if words[0] in COUNTS else None
    numbers = parse_floats(" ".join(words[1:]) if model else text, source, CalibrationError)
    return Calibration.from_numbers(numbers, source, model)


def size_text(size: Size) -> str:
    """`640x480`."""
    return f"{size[0]}x{size[1]}"


def read_numbers(path: Path) -> Calibration:
    """A calibration from the first line of a file; the distortion may stand in a `distortion.txt` beside it.

    Raises CalibrationError naming file and line.
    """
    number, line = _first_line(path)
    calibration = parse_numbers(line, f"{path}:{number}")
    distortion = path.with_name("distortion.txt")
    if len(calibration.params) > 4 or path == distortion or not distortion.is_file():
        return calibration
    number, line = _first_line(distortion)
    where = f"{distortion}:{number}"
    numbers = parse_floats(line, where, CalibrationError)
    if len(numbers) not in (4, 5):
        raise CalibrationError(f"{where}: expected k1 k2 p1 p2 [k3], got {len(numbers)} numbers")
    return Calibration.from_numbers([*calibration.params, *numbers], calibration.source)


def _first_line(path: Path) -> tuple[int, str]:
    for number, line in numbered_lines(path, CalibrationError):
        return number, line
    raise CalibrationError(f"{path}: no numbers; expected {NUMBERS}")
