"""Camera calibrations from text: a file of numbers or a command-line argument, checked before use."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from torchslam.data.text_file import numbered_lines, parse_floats
from torchslam.errors import CalibrationError
from torchslam.geometry.camera import Camera

COUNTS = {"pinhole": (4,), "radial_tangential": (8, 9), "fisheye": (8,)}
AUTO = "auto"
"""What is given as a camera where nothing is known about it."""

USUAL_FOCAL = 0.85  # widths of the image: of most phones and webcams it is 0.7 to 1
EXPECTED = "fx fy cx cy [k1 k2 p1 p2 [k3]], or `fisheye` and fx fy cx cy k1 k2 k3 k4"


@dataclass(frozen=True)
class Calibration:
    """A camera whose image size is not known yet.

    model:  "pinhole", "radial_tangential" or "fisheye"
    params: fx fy cx cy, pixels, and all of the model's distortion coefficients
    source: where the numbers come from, for messages
    """

    model: str
    params: tuple[float, ...]
    source: str

    @staticmethod
    def from_numbers(numbers: list[float], source: str, model: str | None = None) -> Calibration:
        """Checked numbers; the model follows from how many there are unless it is named.

        Raises CalibrationError for a wrong count or a focal length that is not positive.
        """
        counts = COUNTS[model] if model else (4, 8, 9)
        if len(numbers) not in counts:
            raise CalibrationError(f"{source}: expected {EXPECTED}, got {len(numbers)} numbers")
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
        return Calibration(model, tuple(numbers), source)

    def camera(self, size: tuple[int, int]) -> Camera:
        """The camera for images of `size` (width, height)."""
        return Camera(self.model, torch.tensor(self.params, dtype=torch.float64), size)


class UnknownCamera(Calibration):
    """Nothing is known: the usual focal length for the size, the centre as principal point, no distortion."""

    def __init__(self) -> None:
        super().__init__("pinhole", (), AUTO)

    def camera(self, size: tuple[int, int]) -> Camera:
        """A first guess for images of `size` (width, height)."""
        width, height = size
        focal = USUAL_FOCAL * width
        return Camera.pinhole(focal, focal, 0.5 * (width - 1), 0.5 * (height - 1), size=size)


def parse_camera(text: str, source: str = "--camera") -> Calibration:
    """A calibration from `fx,fy,cx,cy[,k1,k2,p1,p2[,k3]]` or `fisheye,fx,fy,cx,cy,k1,k2,k3,k4`.

    Raises CalibrationError naming `source`.
    """
    words = text.replace(",", " ").split(maxsplit=1)
    if not words:
        raise CalibrationError(f"{source}: expected {EXPECTED}, got nothing")
    model = words[0] if words[0] in COUNTS else None
    numbers = parse_floats(" ".join(words[1:]) if model else text, source, CalibrationError)
    return Calibration.from_numbers(numbers, source, model)


def read_calibration(path: str | Path) -> Calibration:
    """A calibration from the first line of a file; the distortion may stand in a `distortion.txt` beside it.

    Raises CalibrationError naming file and line.
    """
    path = Path(path)
    number, line = _first_line(path)
    calibration = parse_camera(line, f"{path}:{number}")
    distortion = path.with_name("distortion.txt")
    if len(calibration.params) > 4 or path == distortion or not distortion.is_file():
        return calibration
    number, line = _first_line(distortion)
    where = f"{distortion}:{number}"
    numbers = parse_floats(line, where, CalibrationError)
    if len(numbers) not in (4, 5):
        raise CalibrationError(f"{where}: expected k1 k2 p1 p2 [k3], got {len(numbers)} numbers")
    return Calibration.from_numbers([*calibration.params, *numbers], calibration.source)


def fit_camera(camera: Camera | Calibration, size: tuple[int, int], where: str) -> Camera:
    """The camera for images of `size`. Raises CalibrationError at `where` for one that is for another size."""
    if isinstance(camera, Calibration):
        return camera.camera(size)
    if camera.size != size:
        raise CalibrationError(
            f"{where}: the camera is for images of {size_text(camera.size)}, these are {size_text(size)}"
        )
    return camera


def size_text(size: tuple[int, int]) -> str:
    """`640x480`."""
    return f"{size[0]}x{size[1]}"


def _first_line(path: Path) -> tuple[int, str]:
    for number, line in numbered_lines(path, CalibrationError):
        return number, line
    raise CalibrationError(f"{path}: no numbers; expected {EXPECTED}")
