"""MPEG-2 videos with flags of our choice: OpenCV writes them, and single bits are edited.

Source: ISO/IEC 13818-2, 6.2.2.1 (sequence header), 6.2.2.3 (sequence extension), 6.2.3.1 (picture coding extension).
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

SEQUENCE, EXTENSION = b"\x00\x00\x01\xb3", b"\x00\x00\x01\xb5"
PROGRESSIVE_SEQUENCE = 0x08  # in the second byte of a sequence extension
PROGRESSIVE_FRAME = 0x80  # in the fifth byte of a picture coding extension
WIDE = 3  # aspect_ratio_information: the picture is shown 16:9


def write_mpeg2(path: Path, images: list[np.ndarray]) -> None:
    """Frames (H, W, 3) at 25 Hz, as whole frames with square pixels."""
    height, width = images[0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MPG2"), 25.0, (width, height))
    assert writer.isOpened()
    for image in images:
        writer.write(image)
    writer.release()


def set_interlaced(path: Path, frames: list[bool]) -> None:
    """Say of each frame, in the order of the stream, whether it consists of two fields."""
    data = bytearray(path.read_bytes())
    number = 0
    at = data.find(EXTENSION)
    while at >= 0:
        kind = data[at + 4] >> 4
        if kind == 1:
            data[at + 5] &= ~PROGRESSIVE_SEQUENCE
        if kind == 8:
            if frames[number]:
                data[at + 8] &= ~PROGRESSIVE_FRAME
            number += 1
        at = data.find(EXTENSION, at + 4)
    assert number == len(frames)
    path.write_bytes(data)


def set_wide(path: Path) -> None:
    """Say that the pictures are to be shown 16:9."""
    data = bytearray(path.read_bytes())
    at = data.find(SEQUENCE)
    while at >= 0:
        data[at + 7] = WIDE << 4 | data[at + 7] & 0x0F
        at = data.find(SEQUENCE, at + 4)
    path.write_bytes(data)
