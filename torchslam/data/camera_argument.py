"""The `--camera` argument: numbers, calibration files, presets, EXIF and focal-length guesses."""

from __future__ import annotations

import difflib
import io
import math
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from PIL import Image

from torchslam.data.calibration import (
    COUNTS,
    PRESETS,
    Calibration,
    FocalGuess,
    Preset,
    Size,
    parse_numbers,
    size_text,
)
from torchslam.data.formats.calibration_files import read_calibration
from torchslam.data.formats.image_file import MAX_BYTES
from torchslam.data.formats.text_file import parse_floats
from torchslam.errors import CalibrationError
from torchslam.geometry.camera import Camera
from torchslam.utils.files import read_bytes

if TYPE_CHECKING:
    from torchslam.data.sequence import Sequence

EXIF_BLOCK = 0x8769
FOCAL_LENGTH_35MM = 0xA405
FILM_DIAGONAL = math.hypot(36.0, 24.0)  # millimeters


@dataclass(frozen=True)
class FromExif:
    """Placeholder for the focal length in the EXIF block of the first image."""

    guessed: bool = True

    def camera(self, size: Size) -> Camera:
        """Raise CalibrationError: the first image is not an image file."""
        raise CalibrationError("--camera exif: only image files have an EXIF block")


def read_focal(path: Path) -> FocalGuess:
    """Read the 35 mm equivalent focal length of an image file (EXIF 2.32, tag 0xA405), relative to the diagonal.

    Raises CalibrationError for a file without one.
    """
    try:
        content = read_bytes(path, MAX_BYTES, "an image that is read")
        with Image.open(io.BytesIO(content)) as image:
            found = image.getexif().get_ifd(EXIF_BLOCK).get(FOCAL_LENGTH_35MM)
    except Exception as cause:  # a damaged block fails in any way
        raise CalibrationError(f"{path}: its EXIF block cannot be read: {cause}") from cause
    if not isinstance(found, int | float) or not 0 < found < math.inf:
        raise CalibrationError(
            f"{path}: no 35 mm focal length in its EXIF block; give --camera f=0.8w or fov=65 instead"
        )
    return FocalGuess(found / FILM_DIAGONAL, "diagonal", f"EXIF of {path.name}, {found:g} mm")


AUTO = "auto"
EXIF = "exif"
USUAL_FOCAL = 0.85  # image widths; phones and webcams have 0.7 to 1
FOCAL = re.compile(r"f=([^wpx,\s]+)(w|px)?")
FIELD_OF_VIEW = re.compile(r"fov=([^,\s]+)")

UNKNOWN = FocalGuess(USUAL_FOCAL, "w", AUTO)
"""Guess for an unknown camera."""

GivenCamera = Camera | Calibration | FocalGuess | Preset | FromExif
"""Camera argument of the readers: complete, or to be completed with the image size."""


def parse_camera(text: str, size: Size, example: Path | None = None) -> Camera:
    """Parse a `--camera` argument for images of `size` (width, height).

    Args:
        text: `fx,fy,cx,cy[,k1,k2,p1,p2[,k3[,k4,k5,k6]]]`, `fisheye,fx,fy,cx,cy,k1,k2,k3,k4`, a focal length as `f=0.8w`
            (widths of the image) or `f=500` (pixels), `fov=65` (horizontal, degrees), a preset such as
            `tum-fr1`, `exif`, `auto` (unknown), or a file (`read_calibration`)
        example: an image file, for `exif`

    Raises:
        CalibrationError: if the text or the file is invalid
    """
    return fit_camera(parse_calibration(text), size, "--camera", example)


def parse_calibration(text: str, source: str = "--camera") -> Calibration | FocalGuess | Preset | FromExif:
    """Parse a `--camera` argument before the image size is known; see `parse_camera`.

    Raises CalibrationError naming `source`.
    """
    word = text.strip()
    if word.lower() in PRESETS:
        return PRESETS[word.lower()]
    if word.lower() == EXIF:
        return FromExif()
    if word.lower() == AUTO:
        return UNKNOWN
    if os.path.isfile(word):  # Path.is_file raises for a name that is too long
        return read_calibration(word)
    if word.lower().startswith(("f=", "fov=")):
        return _parse_focal(word.lower(), source)
    if re.fullmatch(r"[^\s,]+", word) and not _is_number(word) and word not in COUNTS:
        near = difflib.get_close_matches(word.lower(), [*PRESETS, EXIF, AUTO], n=1)
        hint = f"did you mean {near[0]}?" if near else f"presets are {', '.join(PRESETS)}"
        raise CalibrationError(f"{source}: `{word}` is not a number, a file or a known camera; {hint}")
    return parse_numbers(text, source)


def fit_camera(
    camera: GivenCamera, size: Size, where: str, example: Path | None = None, pixel_aspect: float = 1.0
) -> Camera:
    """Return the camera for images of `size`. Raises CalibrationError at `where` for a camera of another size.

    Args:
        example: an image file of the sequence, for its EXIF block
        pixel_aspect: width to height of a pixel; the fy / fx of a focal length that is guessed
    """
    if isinstance(camera, FromExif) and example is not None:
        camera = read_focal(example)
    if isinstance(camera, FocalGuess):
        return camera.camera(size, pixel_aspect)
    if not isinstance(camera, Camera):
        return camera.camera(size)
    if camera.size != size:
        raise CalibrationError(
            f"{where}: the camera is for images of {size_text(camera.size)}, these are {size_text(size)}"
        )
    return camera


def unknown_camera(sequence: Sequence) -> Camera:
    """Return the initial guess of the unknown camera of a sequence."""
    return UNKNOWN.camera(sequence.size, sequence.pixel_aspect)


def is_guessed(camera: GivenCamera | None) -> bool:
    """True if a camera is only approximate."""
    return camera is not None and not isinstance(camera, Camera) and camera.guessed


def _parse_focal(word: str, source: str) -> FocalGuess:
    """`f=0.8w`, `f=500`, `f=500px` or `fov=65`."""
    angle, focal = FIELD_OF_VIEW.fullmatch(word), FOCAL.fullmatch(word)
    if angle is not None:
        (degrees,) = parse_floats(angle[1], source, CalibrationError)
        if not 0 < degrees < 180:
            raise CalibrationError(f"{source}: fov={degrees:g} is no angle between 0 and 180 degrees")
        return FocalGuess(0.5 / math.tan(math.radians(degrees) / 2), "w", word)
    if focal is None:
        raise CalibrationError(f"{source}: expected f=0.8w, f=500 or fov=65, got `{word}`")
    (length,) = parse_floats(focal[1], source, CalibrationError)
    if length <= 0:
        raise CalibrationError(f"{source}: the focal length must be positive, got {length:g}")
    return FocalGuess(length, focal[2] or "px", word)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
