"""MP4 files with times and rotations of our choice: OpenCV writes them, and their boxes are edited."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np

CONTAINERS = (b"moov", b"trak", b"edts", b"mdia", b"minf", b"stbl")
ROTATED = {0: (1, 0, 0, 1), 90: (0, 1, -1, 0), 180: (-1, 0, 0, -1), 270: (0, -1, 1, 0)}


def write_mp4(path: Path, images: list[np.ndarray], rate: float = 25.0) -> None:
    """Frames (H, W, 3) at a constant rate."""
    height, width = images[0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), rate, (width, height))
    assert writer.isOpened()
    for image in images:
        writer.write(image)
    writer.release()


def set_durations(path: Path, milliseconds: list[int]) -> None:
    """Let each frame last as long as said: the table of durations (stts) gets an entry per frame."""
    scale = 1000
    table = struct.pack(">II", 0, len(milliseconds)) + b"".join(
        struct.pack(">II", 1, d) for d in milliseconds
    )

    def edit(kind: bytes, body: bytes) -> bytes:
        if kind == b"stts":
            return table
        if kind == b"mdhd":  # version 0: flags, created, modified, ticks per second, duration
            return body[:12] + struct.pack(">II", scale, sum(milliseconds)) + body[20:]
        if kind == b"elst":  # version 0: flags, count, duration in milliseconds: what is shown ends there
            return body[:8] + struct.pack(">I", sum(milliseconds)) + body[12:]
        return body

    path.write_bytes(edited(path.read_bytes(), edit))


def set_rotation(path: Path, degrees: int) -> None:
    """Say that the frames are to be shown turned clockwise."""

    def edit(kind: bytes, body: bytes) -> bytes:
        if kind != b"tkhd":  # version 0: the matrix follows after 40 bytes
            return body
        a, b, c, d = (65536 * value for value in ROTATED[degrees])
        return body[:40] + struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30) + body[76:]

    path.write_bytes(edited(path.read_bytes(), edit))


def edited(data: bytes, edit) -> bytes:
    """The boxes of a file, each through `edit`, with sizes that fit; no data may lie behind the index (moov)."""
    out, position = b"", 0
    while position < len(data):
        size, kind = struct.unpack_from(">I4s", data, position)
        body = data[position + 8 : position + size]
        body = edited(body, edit) if kind in CONTAINERS else edit(kind, body)
        out += struct.pack(">I4s", len(body) + 8, kind) + body
        position += size
    return out
