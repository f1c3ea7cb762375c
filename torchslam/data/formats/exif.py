"""The focal length that a camera writes into its photographs.

Source: Exif 2.32 (CIPA DC-008), tag 0xA405 FocalLengthIn35mmFilm, which is by the diagonal of the image (CIPA DCG-001).
"""

from __future__ import annotations

import io
import math
from dataclasses import dataclass
from pathlib import Path

from PIL import Image

from torchslam.data.calibration import FocalGuess, Size
from torchslam.data.formats.image_file import MAX_BYTES
from torchslam.errors import CalibrationError
from torchslam.geometry.camera import Camera
from torchslam.utils import bounded_read as regular_file

EXIF_BLOCK = 0x8769
FOCAL_LENGTH_35MM = 0xA405
FILM_DIAGONAL = math.hypot(36.0, 24.0)  # millimeters


@dataclass(frozen=True)
class FromExif:
    """The focal length that the first image's EXIF block tells."""

    guessed: bool = True

    def camera(self, size: Size) -> Camera:
        raise CalibrationError("--camera exif: only image files say what they were taken with")


def read_focal(path: Path) -> FocalGuess:
    """The 35 mm equivalent focal length of an image file.

    Raises CalibrationError for a file without one.
    """
    try:
        content = regular_file.read_bytes(path, MAX_BYTES, "an image that is read")
        with Image.open(io.BytesIO(content)) as image:
            found = image.getexif().get_ifd(EXIF_BLOCK).get(FOCAL_LENGTH_35MM)
    except Exception as cause:  # a damaged block fails in any way
        raise CalibrationError(f"{path}: its EXIF block cannot be read: {cause}") from cause
    if not isinstance(found, int | float) or not 0 < found < math.inf:
        raise CalibrationError(
            f"{path}: no 35 mm focal length in its EXIF block; give --camera f=0.8w or fov=65 instead"
        )
    return FocalGuess(found / FILM_DIAGONAL, "diagonal", f"EXIF of {path.name}, {found:g} mm")
