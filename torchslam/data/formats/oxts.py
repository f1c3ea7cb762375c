"""Packets of the GPS/INS of KITTI: a folder `oxts` with `timestamps.txt` and a text file for each packet in `data`.

Source: dataformat.txt of the development kit of https://www.cvlibs.net/datasets/kitti/raw_data.php.
"""

from __future__ import annotations

import datetime
import re
from pathlib import Path
from typing import NamedTuple

from torchslam.data.text_file import check_later, numbered_lines, parse_floats
from torchslam.errors import TorchslamError, TrajectoryError

TIME = re.compile(r"(\d{4}-\d\d-\d\d \d\d:\d\d:\d\d)(\.\d{1,9})?")


class Packet(NamedTuple):
    """One packet: latitude, longitude, altitude, roll, pitch, yaw and more; seconds since its recording's day began."""

    where: str
    time: float
    numbers: list[float]


def is_oxts(folder: Path) -> bool:
    """Return whether a folder has packets, or an `oxts` that has."""
    return any((each / "timestamps.txt").is_file() and (each / "data").is_dir() for each in _places(folder))


def _places(folder: Path) -> tuple[Path, Path]:
    return folder, folder / "oxts"


def read_oxts(folder: Path) -> list[Packet]:
    """The packets of a folder, or of `oxts` in it, in the order of time.

    Raises TrajectoryError naming file and line.
    """
    base = next(each for each in _places(folder) if (each / "data").is_dir())
    times = read_day_times(base / "timestamps.txt", TrajectoryError)
    packets: list[Packet] = []
    for file in sorted((base / "data").glob("*.txt")):
        line = next((line for _, line in numbered_lines(file, TrajectoryError)), "")
        row = parse_floats(line, str(file), TrajectoryError)
        index = int(file.stem) if file.stem.isdecimal() else len(times)
        if len(row) < 6 or index >= len(times) or not abs(row[0]) < 90:
            raise TrajectoryError(
                f"{file}: expected a line of latitude, longitude, altitude, roll, pitch, yaw, ..."
            )
        if packets:
            check_later(times[index], packets[-1].time, str(file), TrajectoryError)
        packets.append(Packet(str(file), times[index], row))
    if not packets:
        raise TrajectoryError(f"{base / 'data'}: no packets")
    return packets


def read_day_times(path: Path, error: type[TorchslamError]) -> list[float]:
    """Lines `2011-09-26 13:02:25.964389445`, as seconds since the beginning of the first one's day."""
    times: list[float] = []
    midnight: datetime.datetime | None = None
    for number, line in numbered_lines(path, error):
        found = TIME.fullmatch(line)
        try:
            moment = datetime.datetime.fromisoformat(found[1]) if found else None
        except ValueError:
            moment = None
        if found is None or moment is None:
            raise error(f"{path}:{number}: expected `2011-09-26 13:02:25.964389445`, got `{line}`")
        midnight = midnight or moment.replace(hour=0, minute=0, second=0)
        times.append((moment - midnight).total_seconds() + float(found[2] or 0))
    return times
