"""A folder of images, or the images a pattern names, in natural order (`9.png` before `10.png`), at a constant rate."""

from __future__ import annotations

from pathlib import Path

from torchslam.data.camera_argument import GivenCamera
from torchslam.data.formats.frame_names import (
    FOLDERS,
    Found,
    find_frames,
    folder_kind,
    is_pattern,
    match_pattern,
    subfolder,
)
from torchslam.data.readers.eth3d_tum import find_calibration
from torchslam.data.readers.image_sequence import ImageEntry, ImageSequence

LOOKS_FOR = f"images, or a folder {'/, '.join(FOLDERS)}/ with images"
DEFAULT_RATE = 30.0
"""Frame rate of images without timestamps."""


def matches(path: str) -> bool:
    """Whether there are frames, in a folder or one of `FOLDERS` in it, or for a pattern such as `left-*.png`."""
    if is_pattern(path):
        return bool(match_pattern(path).frames)
    folder = Path(path)
    if not folder.is_dir() or folder_kind(folder):
        return False
    return bool(subfolder(folder) or find_frames(folder).frames)


def open(path: str, camera: GivenCamera | None, rate: float | None) -> ImageSequence:
    """Images at `rate` frames per second; `camera` overrides a calibration.txt with them or above them.

    Raises SequenceError or CalibrationError.
    """
    base = Path(path).parent if is_pattern(path) else Path(path)
    found, folder = _find(path, base)
    camera = camera if camera is not None else find_calibration(folder) or find_calibration(base)
    entries = at_rate(found.frames, rate or DEFAULT_RATE)
    return ImageSequence(base.resolve().name, "image folder", entries, camera, None, found.notes)


def at_rate(frames: list[Path], rate: float) -> list[ImageEntry]:
    """Build entries for frames without timestamps, `rate` per second."""
    return [ImageEntry(index / rate, image, str(image)) for index, image in enumerate(frames)]


def _find(path: str, base: Path) -> tuple[Found, Path]:
    if is_pattern(path):
        return match_pattern(path), base
    found = find_frames(base)
    inner = None if found.frames else subfolder(base)
    return (found, base) if inner is None else (find_frames(inner), inner)
