"""What is known of a camera before its images: numbers, guessed focal lengths, dataset presets, and calibration.txt."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from pathlib import Path

from torchslam.data.text_file import float64, numbered_lines, parse_floats
from torchslam.errors import CalibrationError, ResultsError
from torchslam.geometry.camera import Camera
from torchslam.geometry.distortion import MODELS
from torchslam.utils.files import write_whole

COUNTS = {"pinhole": (4,), "radial_tangential": (8, 9), "rational": (12,), "fisheye": (8,)}
"""Numbers of parameters that a text may have, by camera model."""
NUMBERS = "fx fy cx cy [k1 k2 p1 p2 [k3 [k4 k5 k6]]], or `fisheye` and fx fy cx cy k1 k2 k3 k4"
Size = tuple[int, int]
LEAST_FOCAL_PX = 3.0
"""A tenth of the width of the smallest image that is read; parts of a width are .2 to 2. Tried at this value only."""
MAX_OFF_CENTER = 0.08
"""Largest distance of the principal point from the middle, in longer sides of the image, without a stated size.

The real cameras of the presets have up to 0.02; the rectified ones of KITTI-360 have 0.04. Half of a 4:3 image that is
shown as 16:9, or a calibration made at 1.2 times the size, has 0.09 or more."""


@dataclass(frozen=True)
class Calibration:
    """A camera whose image size may not be known yet.

    Attributes:
        model: "pinhole", "radial_tangential", "rational" or "fisheye".
        params: fx fy cx cy in pixels, and all distortion coefficients of the model. A guess has fx alone, in `unit`:
            no distortion, centered principal point. That of EXIF has nothing before the first image is known.
        source: origin of the numbers, for messages.
        size: (width, height) of the images, if known.
        guessed: True if only approximate.
        std: relative standard deviation of the focal length, if the source states it.
        as_stored: True if it is of a program that ignores the orientation in the EXIF block of images.
        unit: of a guess: "px" (pixels), "w" (image widths) or "diagonal" (image diagonals).
        others: the cameras of the same source for images of other sizes.
    """

    model: str
    params: tuple[float, ...]
    source: str
    size: Size | None = None
    guessed: bool = False
    std: float | None = None
    as_stored: bool = False
    unit: str = "px"
    others: tuple[Calibration, ...] = ()

    @staticmethod
    def from_numbers(
        numbers: list[float], source: str, model: str | None = None, size: Size | None = None
    ) -> Calibration:
        """Build a calibration from numbers; without `model`, their count determines it.

        Raises CalibrationError for a wrong count, a number that is not finite, and a focal length or a size that is not
        positive.
        """
        counts = COUNTS[model] if model else (4, 8, 9, 12)
        if len(numbers) not in counts:
            raise CalibrationError(f"{source}: expected {NUMBERS}, got {len(numbers)} numbers")
        if not all(map(math.isfinite, numbers)):
            raise CalibrationError(f"{source}: the parameters must be finite, got {numbers[:12]}")
        if numbers[0] <= 0 or numbers[1] <= 0:
            raise CalibrationError(
                f"{source}: focal lengths must be positive, got {numbers[0]:g} and {numbers[1]:g}"
            )
        at_corner = size is not None and -1 <= min(numbers[2:4]) <= max(numbers[2:4]) <= 1
        if min(numbers[:2]) < LEAST_FOCAL_PX or at_corner:
            focal, center = (f"{one:g}, {other:g}" for one, other in (numbers[:2], numbers[2:4]))
            raise CalibrationError(
                f"{source}: focal lengths of {focal} pixels with the principal point {center}: are these parts of the "
                "width or of the height of the image? Give pixels"
            )
        if size is not None and min(size) <= 0:
            raise CalibrationError(
                f"{source}: the size of the images must be positive, got {size_text(size)}"
            )
        if model is None and any(numbers[9:]):
            model = "rational"
        elif model is None and any(numbers[4:]):
            model = "radial_tangential"
        elif model is None:
            model, numbers = "pinhole", numbers[:4]
        if model == "radial_tangential":
            numbers = [*numbers, 0.0][:9]
        return Calibration(model, tuple(numbers), source, size)

    @staticmethod
    def guess(focal: float, unit: str, source: str) -> Calibration:
        """A guessed focal length, in units of `unit`."""
        return Calibration("pinhole", (focal,), source, guessed=True, unit=unit)

    def camera(self, size: Size, pixel_aspect: float = 1.0) -> Camera:
        """Return the camera for images of `size` (width, height); `pixel_aspect` is the fy / fx of a guess.

        Raises CalibrationError if it is for another size, or that of EXIF, which needs an image.
        """
        if not self.params:
            raise CalibrationError(f"{self.source}: only image files have an EXIF block")
        if len(self.params) == 1:
            width, height = size
            unit = {"px": 1.0, "w": float(width), "diagonal": math.hypot(width, height / pixel_aspect)}
            focal = self.params[0] * unit[self.unit]
            return Camera.pinhole(focal, focal * pixel_aspect, (width - 1) / 2, (height - 1) / 2, size=size)
        if self.size is None and not self.guessed:
            self._check_center(size)
        for each in (self, *self.others):
            if each.size in (None, size):
                return Camera(each.model, float64(each.params), size)
        sizes = " or ".join(size_text(each.size) for each in (self, *self.others) if each.size)
        raise CalibrationError(
            f"{self.source}: the camera is for images of {sizes}, these are {size_text(size)}"
        )

    def _check_center(self, size: Size) -> None:
        """Raise CalibrationError if the principal point implies another image size."""
        center = self.params[2], self.params[3]
        off = max(abs(at - (side - 1) / 2) for at, side in zip(center, size, strict=True))
        if off <= MAX_OFF_CENTER * max(size):
            return
        fitting = " x ".join(f"{2 * at + 1:.0f}" for at in center)
        raise CalibrationError(
            f"{self.source}: the principal point {center[0]:g}, {center[1]:g} is far from the middle of images of "
            f"{size_text(size)}: it would fit about {fitting} pixels; give the calibration of this size, or, if the "
            "images are cropped, a file that states their size (image_width, image_height)"
        )


UNKNOWN = Calibration.guess(0.85, "w", "auto")
"""An unknown camera; the focal lengths of phones and webcams are 0.7 to 1 image widths."""
FROM_EXIF = Calibration("pinhole", (), "--camera exif", guessed=True)
"""The focal length is in the EXIF block of the first image."""

GivenCamera = Camera | Calibration
"""Camera argument of the readers: complete, or to be completed with the image size."""


def parse_numbers(text: str, source: str) -> Calibration:
    """Parse `fx,fy,cx,cy[,k1,k2,p1,p2[,k3[,k4,k5,k6]]]` or `fisheye,fx,fy,cx,cy,k1,k2,k3,k4`.

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
    """Read a calibration from the first line of a file, and the distortion from a `distortion.txt` next to it.

    Raises CalibrationError naming file and line.
    """
    where, line = _first_line(path)
    calibration = parse_numbers(line, where)
    if is_found(path):  # with what `write_calibration` states
        text = path.read_text(encoding="utf-8")
        size = re.search(rf"^# {IMAGE_SIZE}: (\d{{1,9}})x(\d{{1,9}})$", text, re.MULTILINE)
        std = re.search(rf"^# {FOCAL_STD}: ([0-9.e+-]+)$", text, re.MULTILINE)
        calibration = replace(
            calibration,
            size=None if size is None else (int(size[1]), int(size[2])),
            std=None if std is None else float(std[1]),
        )
    distortion = path.with_name("distortion.txt")
    if len(calibration.params) > 4 or path == distortion or not distortion.is_file():
        return calibration
    where, line = _first_line(distortion)
    numbers = parse_floats(line, where, CalibrationError)
    if len(numbers) not in (4, 5, 8):
        raise CalibrationError(f"{where}: expected k1 k2 p1 p2 [k3 [k4 k5 k6]], got {len(numbers)} numbers")
    whole = Calibration.from_numbers([*calibration.params, *numbers], calibration.source)
    return replace(whole, size=calibration.size, std=calibration.std)


def _first_line(path: Path) -> tuple[str, str]:
    for where, line in numbered_lines(path, CalibrationError):
        return where, line
    raise CalibrationError(f"{path}: no numbers; expected {NUMBERS}")


VGA = (640, 480)  # image size of several datasets, pixels


def _published(size: Size, *numbers: float) -> Calibration:
    return Calibration.from_numbers(list(numbers), "preset", size=size)


_CAMERAS: dict[str, tuple[Calibration, ...]] = {
    # https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats, calibration of the color cameras;
    # the images of fr3 are undistorted already.
    "tum-fr1": (_published(VGA, 517.3, 516.5, 318.6, 255.3, 0.2624, -0.9531, -0.0054, 0.0026, 1.1633),),
    "tum-fr2": (_published(VGA, 520.9, 521.0, 325.1, 249.7, 0.2312, -0.7849, -0.0033, -0.0001, 0.9172),),
    "tum-fr3": (_published(VGA, 535.4, 539.2, 320.1, 247.6),),
    # sensor.yaml of cam0 in every sequence of https://projects.asl.ethz.ch/datasets/doku.php?id=kmavvisualinertialdatasets
    "euroc": (
        _published(
            (752, 480),
            *(458.654, 457.296, 367.215, 248.375, -0.28340811, 0.07395907, 0.00019359, 1.76187114e-05),
        ),
    ),
    # P0 in calib.txt of the odometry benchmark, by the size of its images: sequences 00-02 (and 13-21), 03, 04-12.
    "kitti": (
        _published((1241, 376), 718.856, 718.856, 607.1928, 185.2157),
        _published((1242, 375), 721.5377, 721.5377, 609.5593, 172.854),
        _published((1226, 370), 707.0912, 707.0912, 601.8873, 183.1104),
    ),
    # The dataset gives no calibration of the color camera: 525 is the Kinect's nominal focal length.
    "7-scenes": (replace(_published(VGA, 525.0, 525.0, 319.5, 239.5), guessed=True),),
    # https://github.com/castacks/tartanair_tools/blob/master/data_type.md (90 degrees over 640 pixels); the second
    # version of the dataset has the same angle over square images.
    "tartanair": (
        _published(VGA, 320.0, 320.0, 320.0, 240.0),
        _published((640, 640), 320.0, 320.0, 320.0, 320.0),
    ),
    # https://www.doc.ic.ac.uk/~ahanda/VaFRIC/codes.html; there fy is -480, as its camera's y axis points up.
    "icl": (_published(VGA, 481.2, 480.0, 319.5, 239.5),),
}

PRESETS = {
    name: replace(first, source=f"preset `{name}`", others=tuple(others))
    for name, (first, *others) in _CAMERAS.items()
}
"""Published cameras of datasets, by name."""

CALIBRATION = "calibration.txt"
"""Name of the file, also in the folder of a run that estimated the camera from the images."""
ESTIMATED_HEADER = "# torchslam: camera estimated from the images"
IMAGE_SIZE = "size of the images"
FOCAL_STD = "relative standard error of the focal length"


def is_found(path: Path) -> bool:
    """True for a file that `write_calibration` wrote."""
    return path.exists() and path.read_text(encoding="utf-8", errors="replace").startswith(ESTIMATED_HEADER)


def check_replaceable(path: Path) -> None:
    """Raise ResultsError if a file exists that `write_calibration` did not write."""
    if path.exists() and not is_found(path):
        raise ResultsError(f"{path}: not replaced, since this calibration was not written by torchslam")


def write_calibration(path: Path, camera: Camera, remarks: list[str], std: float | None = None) -> None:
    """Write an estimated camera as a calibration file, with remarks as comments, one line each.

    `std` is the relative standard deviation of the focal length, if known.
    """
    stated = [*remarks, f"{IMAGE_SIZE}: {size_text(camera.size)}"]
    stated += [] if std is None else [f"{FOCAL_STD}: {std:.2g}"]
    stated += [" ".join(("fx fy cx cy", *MODELS[camera.model].coefficients))]
    model = ["fisheye"] if camera.model == "fisheye" else []
    numbers = " ".join([*model, *(f"{number:.9g}" for number in camera.params.tolist())])
    lines = [ESTIMATED_HEADER, *(f"# {remark}" for remark in stated), numbers]
    write_whole(path, ("\n".join(lines) + "\n").encode())
