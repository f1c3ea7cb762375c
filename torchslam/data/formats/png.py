"""PNG files as cameras' recordings have them, two to four times as fast as OpenCV decodes them, to the same pixels."""

from __future__ import annotations

import zlib

import cv2
import numpy as np
from kornia_rs import io

SIGNATURE = b"\x89PNG\r\n\x1a\n"
HEADER_BYTES = (13).to_bytes(4, "big")
CHUNK_FRAME = 12
"""Bytes of a chunk around its content: length, name, sum."""
PLAIN = frozenset({b"IHDR", b"pHYs", b"tEXt", b"zTXt", b"iTXt", b"tIME"})
"""Chunks before the pixels that change none of them. Others (of gamma, transparency, animation) are left to OpenCV."""
GRAY, COLOR = 0, 2  # color types of a PNG
TO_GRAY = np.array([[9797, 19234, 3737, 0.5 - 16384]], np.float32) / 32768
"""Red, green, blue to gray as OpenCV has libpng do it: 0.299, 0.587 and the rest of 32768, rounded down. Half of a
32768th more than -1/2 makes the rounding of `cv2.transform` that; all sums are whole in float32."""


def decode_gray(data: bytes) -> np.ndarray | None:
    """A plain PNG file (gray of 8 or 16 bits, color of 8) as (H, W) gray, uint8 or uint16.

    None for any other file, and for a damaged one: then OpenCV has to say. An image is made of the size that a sound
    header promises, so who calls this has looked at that. Source: PNG specification, sections 5 and 11.
    """
    if not _is_plain(data):
        return None
    size = int.from_bytes(data[20:24], "big"), int.from_bytes(data[16:20], "big")
    bits, color = data[24], data[25]
    try:
        if (bits, color) == (16, GRAY):
            return io.decode_image_png_u16(data, size, "mono")[..., 0]
        if (bits, color) == (8, GRAY):
            return io.decode_image_png_u8(data, size, "mono")[..., 0]
        if (bits, color) == (8, COLOR):
            return cv2.transform(io.decode_image_png_u8(data, size, "rgb"), TO_GRAY).reshape(size)
    except Exception:  # the decoder has no error of its own
        return None
    return None


def _is_plain(data: bytes) -> bool:
    """Whether a PNG file has a sound header, is not interlaced, and nothing before its pixels bears on them."""
    header, sum_ = data[12:29], data[29:33]
    if (
        not data.startswith(SIGNATURE + HEADER_BYTES + b"IHDR")
        or zlib.crc32(header).to_bytes(4, "big") != sum_
    ):
        return False
    if header[-1] or not any(data[16:20]) or not any(data[20:24]):
        return False
    position = len(SIGNATURE)
    while (name := data[position + 4 : position + 8]) in PLAIN:
        position += CHUNK_FRAME + int.from_bytes(data[position : position + 4], "big")
    return name == b"IDAT"
