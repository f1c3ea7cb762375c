"""What an MP4 claims to hold, before a decoder believes it: FFmpeg makes a table of all frames that the index names.

Source: ISO/IEC 14496-12: boxes of a size and a name; stsz and stz2 say how many samples there are, stts and ctts how
many last or wait equally long, trun how many a fragment has. No sample takes less than a byte of the file.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

CONTAINERS = (b"moov", b"trak", b"edts", b"mdia", b"minf", b"stbl", b"moof", b"traf")
HEADER, LARGE_HEADER = 8, 16
DEPTH = 8  # moov, trak, mdia, minf, stbl are five
MAX_BOXES = 1_000_000
RUNS_AT_ONCE = 1 << 16


def claimed_samples(path: Path) -> int:
    """The most samples that a table in the file speaks of; 0 where there is none. Raises OSError."""
    with path.open("rb") as file:
        size = file.seek(0, 2)
        return max((_samples(file, *box) for box in _boxes(file, 0, size, [MAX_BOXES], DEPTH)), default=0)


def _boxes(
    file: BinaryIO, start: int, end: int, left: list[int], depth: int
) -> Iterator[tuple[bytes, int, int]]:
    """Name, and where the content begins and ends, of every box; those in containers too.

    left: how many more; depth: how many containers in each other
    """
    while start + HEADER <= end and left[0] > 0:
        left[0] -= 1
        file.seek(start)
        head = file.read(LARGE_HEADER).ljust(LARGE_HEADER, b"\0")
        size, kind = struct.unpack_from(">I4s", head)
        inside = HEADER
        if size == 1:  # it follows in eight bytes
            (size,), inside = struct.unpack_from(">Q", head, HEADER), LARGE_HEADER
        # 0: to the end; a size that is too large is cut, as FFmpeg cuts it
        stop = end if size == 0 else min(end, start + max(size, inside))
        yield kind, start + inside, stop
        if kind in CONTAINERS and depth > 0:
            yield from _boxes(file, start + inside, stop, left, depth - 1)
        start = stop


def _samples(file: BinaryIO, kind: bytes, start: int, end: int) -> int:
    """How many samples a table speaks of; 0 for other boxes."""
    at = {b"stsz": 8, b"stz2": 8, b"stts": 4, b"ctts": 4, b"trun": 4}.get(kind)
    if at is None or end - start < at + 4:
        return 0
    file.seek(start + at)
    (count,) = struct.unpack(">I", file.read(4))
    if kind not in (b"stts", b"ctts"):
        return int(count)
    samples, runs = 0, min(count, (end - file.tell()) // 8)
    while runs > 0:
        some = file.read(8 * min(runs, RUNS_AT_ONCE))
        samples += sum(run for run, _ in struct.iter_unpack(">II", some[: len(some) // 8 * 8]))
        runs -= RUNS_AT_ONCE
    return samples
