"""Files of vehicles: packets of the GPS/INS of KITTI, and speeds along the path, as of a wheel encoder.

Source of the packets: dataformat.txt of the development kit of https://www.cvlibs.net/datasets/kitti/raw_data.php.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from torch import Tensor

from torchslam.data.fields import SPEED
from torchslam.data.tables import TIMES, read_table
from torchslam.data.text_file import (
    check_rising,
    float64,
    numbered_lines,
    parse_floats,
    parse_moment,
    with_set_clock,
)
from torchslam.errors import MeasurementError, TorchslamError, TrajectoryError


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
    times, midnight = list[float](), 0.0
    for where, line in numbered_lines(path, error):
        found = re.fullmatch(r"(\d{4}-\d\d-\d\d \d\d:\d\d:\d\d)(\.\d{1,9})?", line)
        if found is None or (moment := parse_moment(found[1])) is None:
            raise error(f"{where}: expected `2011-09-26 13:02:25.964389445`, got `{line}`")
        midnight = midnight if times else moment - moment % 86400
        times.append(moment - midnight + float(found[2] or 0))
    return times


@dataclass(frozen=True)
class Speeds:
    """N speeds of a vehicle, meters per second along the path, without the sign of one that backs up.

    Times are seconds, increasing, on the clock of the file; `notes` are for the user, one line each.
    """

    path: Path
    timestamps: Float[Tensor, " N"]
    speeds: Float[Tensor, " N"]
    notes: tuple[str, ...] = ()


def read_speeds(path: str | Path) -> Speeds:
    """A table with the columns `time` and `speed`, or two numbers a line without a header; without unknown speeds.

    Raises MeasurementError naming file and line.
    """
    path = Path(path)
    places, rows = list[str](), list[tuple[float, float]]()
    for row in read_table(path, TIMES | {"speed": SPEED}, MeasurementError, unnamed=("time", "speed")):
        moment = row.time()
        if moment is None or "speed" not in row.units:
            raise MeasurementError(
                f"{row.where}: no `time` or no `speed`, in meters per second (or `speed_km_h`)"
            )
        places.append(row.where)
        rows.append((moment, row.number("speed")))
    times, speeds = np.array(rows, float).reshape(-1, 2).T
    speeds, words = SPEED.known(speeds)
    times = with_set_clock(times)
    kept = np.flatnonzero(~np.isnan(times + speeds))
    lost = len(rows) - len(kept)
    notes = (
        [f"{path}: left out {lost} rows without a speed or a time{words and ': ' + words}"] if lost else []
    )
    if len(kept) < 2:
        raise MeasurementError("; ".join([f"{path}: {len(kept)} speeds, two are needed", *notes]))
    for row in kept[np.abs(speeds[kept]) > 1000][:1]:  # airplanes fly at 250
        raise MeasurementError(f"{places[row]}: {speeds[row]:g} is no speed in meters per second")
    check_rising(times[kept].tolist(), [places[row] for row in kept], MeasurementError)
    return Speeds(path, float64(times[kept]), float64(np.abs(speeds[kept])), tuple(notes))
