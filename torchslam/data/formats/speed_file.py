"""Files of speeds: times and meters per second along the path."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.data.formats.csv_tables import TIMES, Column, read_table
from torchslam.data.text_file import check_later, in_seconds, number_rows, numbered_lines
from torchslam.errors import MeasurementError

MAX_SPEED = 1000.0
"""Meters per second that a speed may be at most: airplanes fly at 250."""
KM_H = 1 / 3.6
"""Meters per second of a kilometer per hour."""
COLUMNS = {
    **TIMES,
    "speed": Column(("speed", "velocity"), {"ms": 1.0, "mps": 1.0, "kmh": KM_H, "kph": KM_H}),
}
"""Kinds of columns."""


@dataclass(frozen=True)
class Speeds:
    """N speeds of a vehicle.

    Attributes:
        path: where they come from.
        timestamps: seconds, increasing, on the clock of the file.
        speeds: meters per second along the path, without the sign of a vehicle that backs up.
    """

    path: Path
    timestamps: Float[Tensor, " N"]
    speeds: Float[Tensor, " N"]


def read_speeds(path: str | Path) -> Speeds:
    """A table with the columns `time` and `speed`, or two numbers a line without a header.

    Raises MeasurementError naming file and line.
    """
    times: list[float] = []
    speeds: list[float] = []
    for where, time, speed in _rows(Path(path)):
        if not abs(speed) <= MAX_SPEED:
            raise MeasurementError(f"{where}: {speed:g} is no speed in meters per second")
        if times:
            check_later(time, times[-1], where, MeasurementError)
        times.append(time)
        speeds.append(abs(speed))
    if len(times) < 2:
        raise MeasurementError(f"{path}: {len(times)} speeds, two are needed")
    table = torch.tensor([times, speeds], dtype=torch.float64, device="cpu")
    return Speeds(Path(path), table[0], table[1])


def _rows(path: Path) -> Iterator[tuple[str, float, float]]:
    """Place, time in seconds and speed of each line."""
    line = next(numbered_lines(path, MeasurementError), (0, ""))[1]
    if not any(character.isalpha() for character in line.lower().replace("e", "")):
        for where, (time, speed) in number_rows(path, "time speed", MeasurementError):
            yield where, in_seconds(time, where, MeasurementError), speed
        return
    for row in read_table(path, COLUMNS, MeasurementError):
        if not row.has_time or "speed" not in row.cells:
            raise MeasurementError(
                f"{row.where}: no `time` or no `speed`, in meters per second (or `speed_km_h`)"
            )
        yield row.where, row.time(), row.number("speed")
