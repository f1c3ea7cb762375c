"""Image files to tensors. A file that ends early is an error, also where decoders fill the rest with grey."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from torchslam.errors import FrameError

SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm"})


def read_grey(path: str | Path, where: str) -> Tensor:
    """An image file as (1, 1, H, W) float32 grey in [0, 1].

    Raises FrameError at `where` for a file that is missing, truncated or not an image.
    """
    return grey_to_tensor(_read(path, where, cv2.IMREAD_GRAYSCALE))


def read_colour(path: str | Path, where: str) -> Tensor:
    """An image file as (H, W, 3) uint8 red, green, blue. Raises FrameError as `read_grey` does."""
    return bgr_to_tensor(_read(path, where, cv2.IMREAD_COLOR))


def _read(path: str | Path, where: str, flags: int) -> np.ndarray:
    try:
        data = Path(path).read_bytes()
    except OSError as cause:
        raise FrameError(f"{where}: {path} cannot be read: {cause.strerror}") from cause
    if _is_truncated(data):
        raise FrameError(f"{where}: {path} is truncated: it lacks the mark of its end")
    image = _decode(data, flags)
    if image is None:
        raise FrameError(f"{where}: {path} is not an image, or a damaged one")
    return image


def grey_to_tensor(grey: np.ndarray) -> Tensor:
    """(H, W) uint8 -> (1, 1, H, W) float32 in [0, 1]."""
    return torch.from_numpy(grey).to(torch.float32).div_(255.0)[None, None]


def bgr_to_tensor(image: np.ndarray) -> Tensor:
    """(H, W, 3) uint8 blue, green, red, as OpenCV has it -> red, green, blue."""
    return torch.from_numpy(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))


def _decode(data: bytes, flags: int) -> np.ndarray | None:
    """(H, W) or (H, W, 3) uint8; None for anything that is not a whole image."""
    if not data:
        return None
    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:  # a header that promises more pixels than OpenCV takes
        return None


def _is_truncated(data: bytes) -> bool:
    """Whether a JPEG or PNG file lacks its end; other formats are left to the decoder."""
    if data.startswith(b"\x89PNG"):
        return b"IEND" not in data[-64:] and b"IEND\xaeB`\x82" not in data
    if data.startswith(b"\xff\xd8"):
        return data.rfind(b"\xff\xd9") < _start_of_scan(data)
    return False


def _start_of_scan(data: bytes) -> int:
    """Where a JPEG's own pixels start, behind any embedded thumbnail; the file's end if they never do."""
    position = 2
    while position + 4 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        if marker == 0xDA:
            return position
        if marker == 0xFF:  # a fill byte
            position += 1
            continue
        position += 2 + int.from_bytes(data[position + 2 : position + 4], "big")
    return len(data)
