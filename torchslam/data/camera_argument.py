"""The `--camera` argument: numbers, calibration files, presets, EXIF and focal-length guesses."""

from __future__ import annotations

import difflib
import io
import math
import os
import re
from pathlib import Path

from PIL import Image

from torchslam.data.calibration import (
    AUTO,
    COUNTS,
    EXIF,
    FROM_EXIF,
    PRESETS,
    UNKNOWN,
    Calibration,
    Size,
    parse_numbers,
)
from torchslam.data.formats.calibration_files import read_calibration
from torchslam.data.formats.image_file import MAX_BYTES
from torchslam.data.text_file import parse_floats
from torchslam.errors import CalibrationError
from torchslam.geometry.camera import Camera
from torchslam.utils.files import read_bytes

EXIF_BLOCK = 0x8769
"""Tag of the block of camera data (EXIF 2.32)."""
FOCAL_LENGTH_35MM = 0xA405
"""Tag of the focal length of a 35 mm film camera with the same diagonal field of view, mm (EXIF 2.32)."""
FILM_DIAGONAL = math.hypot(36.0, 24.0)  # millimeters


def read_focal(path: Path) -> Calibration:
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
    return Calibration.guess(found / FILM_DIAGONAL, "diagonal", f"EXIF of {path.name}, {found:g} mm")


FOCAL = re.compile(r"f=([^wpx,\s]+)(w|px)?")
FIELD_OF_VIEW = re.compile(r"fov=([^,\s]+)")


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
    given = parse_calibration(text)
    return (read_focal(example) if given == FROM_EXIF and example is not None else given).camera(size)


def parse_calibration(text: str, source: str = "--camera") -> Calibration:
    """Parse a `--camera` argument before the image size is known; see `parse_camera`.

    Raises CalibrationError naming `source`.
    """
    word = text.strip()
    if word.lower() in PRESETS:
        return PRESETS[word.lower()]
    if word.lower() == EXIF:
        return FROM_EXIF
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


def _parse_focal(word: str, source: str) -> Calibration:
    """`f=0.8w`, `f=500`, `f=500px` or `fov=65`."""
    angle, focal = FIELD_OF_VIEW.fullmatch(word), FOCAL.fullmatch(word)
    if angle is not None:
        (degrees,) = parse_floats(angle[1], source, CalibrationError)
        if not 0 < degrees < 180:
            raise CalibrationError(f"{source}: fov={degrees:g} is no angle between 0 and 180 degrees")
        return Calibration.guess(0.5 / math.tan(math.radians(degrees) / 2), "w", word)
    if focal is None:
        raise CalibrationError(f"{source}: expected f=0.8w, f=500 or fov=65, got `{word}`")
    (length,) = parse_floats(focal[1], source, CalibrationError)
    if length <= 0:
        raise CalibrationError(f"{source}: the focal length must be positive, got {length:g}")
    return Calibration.guess(length, focal[2] or "px", word)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
