"""A plain folder of images, in natural order of their names (`9.png` before `10.png`), at a constant rate."""

from __future__ import annotations

import re
from pathlib import Path

from torchslam.data.calibration import Calibration
from torchslam.data.eth3d_tum import find_calibration
from torchslam.data.image_file import SUFFIXES
from torchslam.data.image_sequence import ImageEntry, ImageSequence
from torchslam.errors import MissingCalibrationError, SequenceError
from torchslam.geometry.camera import Camera

DEFAULT_RATE = 30.0
"""Frames per second where the images do not say."""


def list_images(path: Path) -> list[Path]:
    """The images of a folder in natural order."""
    images = [file for file in path.iterdir() if file.suffix.lower() in SUFFIXES and file.is_file()]
    return sorted(images, key=lambda file: _natural(file.name))


def open_folder(
    path: Path, camera: Camera | Calibration | None = None, rate: float | None = None
) -> ImageSequence:
    """A folder of images at `rate` frames per second; `camera` overrides the folder's calibration.txt.

    Raises SequenceError or CalibrationError.
    """
    images = list_images(path)
    if not images:
        raise SequenceError(f"{path}: no images ({', '.join(sorted(SUFFIXES))})")
    camera = camera if camera is not None else find_calibration(path)
    if camera is None:
        raise MissingCalibrationError(
            f"{path}: a plain image folder says nothing about its camera; "
            "give it with --camera fx,fy,cx,cy[,k1,k2,p1,p2,k3] or put a calibration.txt into the folder"
        )
    rate = DEFAULT_RATE if rate is None else rate
    entries = [ImageEntry(index / rate, image, str(image)) for index, image in enumerate(images)]
    return ImageSequence(path.name, "image folder", entries, camera)


def _natural(name: str) -> list[tuple[bool, int, str]]:
    """A sort key under which runs of digits compare as numbers."""
    parts = re.split(r"(\d+)", name.lower())
    return [(part.isdigit(), int(part) if part.isdigit() else 0, part) for part in parts]
