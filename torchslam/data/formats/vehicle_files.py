"""Files of vehicles: packets of the GPS/INS of KITTI, and speeds along the path, as of a wheel encoder.

Source of the packets: dataformat.txt of the development kit of https://www.cvlibs.net/datasets/kitti/raw_data.php.
"""

from __future__ import annotations

import datetime
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

from torchslam.data.text_file import (
    TIMES,
    Column,
    check_rising,
    float64,
    in_seconds,
    number_rows,
    numbered_lines,
    parse_floats,
    read_table,
)
from torchslam.errors import MeasurementError, TorchslamError, TrajectoryError

SPEED = Column(("speed", "velocity"), {"ms": 1.0, "mps": 1.0, "kmh": 1 / 3.6, "kph": 1 / 3.6})  # m/s


class Packet(NamedTuple):
    """One packet: latitude, longitude, altitude, roll, pitch, yaw and more; seconds since its recording's day began."""

    where: str
    time: float
    numbers: list[float]


def oxts_folder(folder: Path) -> Path | None:
    """Return a folder with `timestamps.txt` and packets in `data`, or an `oxts` in it that has them."""
    places = (folder, folder / "oxts")
    return next(
        (each for each in places if (each / "timestamps.txt").is_file() and (each / "data").is_dir()), None
    )


def read_oxts(folder: Path) -> list[Packet]:
    """The packets of an `oxts_folder` in the order of time. Raises TrajectoryError naming file and line."""
    times = read_day_times(folder / "timestamps.txt", TrajectoryError)
    packets: list[Packet] = []
    for file in sorted((folder / "data").glob("*.txt")):
        line = next((line for _, line in numbered_lines(file, TrajectoryError)), "")
        row = parse_floats(line, str(file), TrajectoryError)
        index = int(file.stem) if file.stem.isdecimal() else len(times)
        if len(row) < 6 or index >= len(times) or not abs(row[0]) < 90:
            raise TrajectoryError(
                f"{file}: expected a line of latitude, longitude, altitude, roll, pitch, yaw, ..."
            )
        packets.append(Packet(str(file), times[index], row))
    if not packets:
        raise TrajectoryError(f"{folder / 'data'}: no packets")
    check_rising([each.time for each in packets], [each.where for each in packets], TrajectoryError)
    return packets


def read_day_times(path: Path, error: type[TorchslamError]) -> list[float]:
    """Lines `2011-09-26 13:02:25.964389445`, as seconds since the beginning of the first one's day."""
    times: list[float] = []
    midnight: datetime.datetime | None = None
    for where, line in numbered_lines(path, error):
        found = re.fullmatch(r"(\d{4}-\d\d-\d\d \d\d:\d\d:\d\d)(\.\d{1,9})?", line)
        try:
            moment = datetime.datetime.fromisoformat(found[1]) if found else None
        except ValueError:
            moment = None
        if found is None or moment is None:
            raise error(f"{where}: expected `2011-09-26 13:02:25.964389445`, got `{line}`")
        midnight = midnight or moment.replace(hour=0, minute=0, second=0)
        times.append((moment - midnight).total_seconds() + float(found[2] or 0))
    return times


@dataclass(frozen=True)
class Speeds:
    """N speeds of a vehicle, meters per second along the path, without the sign of one that backs up.

    Times are seconds, increasing, on the clock of the file.
    """

    path: Path
    timestamps: Float[Tensor, " N"]
    speeds: Float[Tensor, " N"]


def read_speeds(path: str | Path) -> Speeds:
    """A table with the columns `time` and `speed`, or two numbers a line without a header.

    Raises MeasurementError naming file and line.
    """
    path = Path(path)
    rows = list(_speed_rows(path))
    if len(rows) < 2:
        raise MeasurementError(f"{path}: {len(rows)} speeds, two are needed")
    places, times, speeds = zip(*rows, strict=True)
    for where, speed in zip(places, speeds, strict=True):
        if not abs(speed) <= 1000:  # airplanes fly at 250
            raise MeasurementError(f"{where}: {speed:g} is no speed in meters per second")
    check_rising(times, places, MeasurementError)
    return Speeds(path, float64(times), float64(speeds).abs())


def _speed_rows(path: Path) -> Iterator[tuple[str, float, float]]:
    """Place, time in seconds and speed of each line."""
    _, line = next(numbered_lines(path, MeasurementError), ("", ""))
    if not any(character.isalpha() for character in line.lower().replace("e", "")):
        for where, (time, speed) in number_rows(path, "time speed", MeasurementError):
            yield where, in_seconds(time, where, MeasurementError), speed
        return
    for row in read_table(path, TIMES | {"speed": SPEED}, MeasurementError):
        moment = row.time()
        if moment is None or "speed" not in row.cells:
            raise MeasurementError(
                f"{row.where}: no `time` or no `speed`, in meters per second (or `speed_km_h`)"
            )
        yield row.where, moment, row.number("speed")
