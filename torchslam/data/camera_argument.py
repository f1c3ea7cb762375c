"""What `--camera` may say. `parse_camera` is the one way from such an argument to a camera."""

from __future__ import annotations

import difflib
import math
import os
import re
from pathlib import Path

from torchslam.data.calibration import COUNTS, Calibration, FocalGuess, Preset, Size, parse_numbers, size_text
from torchslam.data.formats.calibration_files import read_calibration
from torchslam.data.formats.exif import FromExif, read_focal
from torchslam.data.formats.text_file import parse_floats
from torchslam.data.presets import PRESETS
from torchslam.errors import CalibrationError
from torchslam.geometry.camera import Camera

AUTO = "auto"
EXIF = "exif"
USUAL_FOCAL = 0.85  # widths of the image: of most phones and webcams it is 0.7 to 1
FOCAL = re.compile(r"f=([^wpx,\s]+)(w|px)?")
FIELD_OF_VIEW = re.compile(r"fov=([^,\s]+)")

UNKNOWN = FocalGuess(USUAL_FOCAL, "w", AUTO)
"""Where nothing is known."""

GivenCamera = Camera | Calibration | FocalGuess | Preset | FromExif
"""A camera as a reader takes it: whole, or as soon as the size of the images is known."""


def parse_camera(text: str, size: Size, example: Path | None = None) -> Camera:
    """The camera that a `--camera` argument means, for images of `size` (width, height).

    text:    `fx,fy,cx,cy[,k1,k2,p1,p2[,k3]]`, `fisheye,fx,fy,cx,cy,k1,k2,k3,k4`, a focal length as `f=0.8w` (widths
             of the image) or `f=500` (pixels), `fov=65` (horizontal, degrees), a preset such as `tum-fr1`, `exif`,
             `auto` (nothing is known), or a file (`read_calibration`)
    example: an image file, for `exif`

    Raises CalibrationError.
    """
    return fit_camera(parse_calibration(text), size, "--camera", example)


def parse_calibration(text: str, source: str = "--camera") -> Calibration | FocalGuess | Preset | FromExif:
    """What a `--camera` argument means, before the size of the images is known; see `parse_camera`.

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


def fit_camera(camera: GivenCamera, size: Size, where: str, example: Path | None = None) -> Camera:
    """The camera for images of `size`. Raises CalibrationError at `where` for one that is for another size.

    example: an image file of the sequence, for its EXIF block
    """
    if isinstance(camera, FromExif) and example is not None:
        return read_focal(example).camera(size)
    if not isinstance(camera, Camera):
        return camera.camera(size)
    if camera.size != size:
        raise CalibrationError(
            f"{where}: the camera is for images of {size_text(camera.size)}, these are {size_text(size)}"
        )
    return camera


def unknown_camera(size: Size) -> Camera:
    """A first guess for images of `size` where nothing is known."""
    return UNKNOWN.camera(size)


def is_guessed(camera: GivenCamera | None) -> bool:
    """Whether a camera is only near the truth."""
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
