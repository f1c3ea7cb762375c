"""Files of speeds: times and meters per second along the path."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.data.formats.csv_tables import read_csv
from torchslam.data.text_file import check_later, in_seconds, numbered_lines, parse_floats
from torchslam.errors import MeasurementError

MAX_SPEED = 1000.0
"""Meters per second that a speed may be at most: airplanes fly at 250."""
COLUMNS = {
    "speed": ("speed", "speed_m_s", "speed_mps", "velocity"),
    "km_h": ("speed_km_h", "speed_kmh", "speed_kph"),
}
"""Kinds of columns and what they are called."""
KM_H = 1 / 3.6
"""Meters per second of a kilometer per hour."""


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


def _rows(path: Path) -> list[tuple[str, float, float]]:
    """Place, time in seconds and speed of each line."""
    lines = list(numbered_lines(path, MeasurementError))
    if lines and not any(character.isalpha() for character in lines[0][1].lower().replace("e", "")):
        found = []
        for number, line in lines:
            where = f"{path}:{number}"
            numbers = parse_floats(line, where, MeasurementError)
            if len(numbers) != 2:
                raise MeasurementError(f"{where}: expected a time and a speed, got {len(numbers)} numbers")
            found.append((where, in_seconds(numbers[0], where, MeasurementError), numbers[1]))
        return found
    found = []
    for row in read_csv(path, COLUMNS, MeasurementError):
        if not row.time_column or not ("speed" in row.cells or "km_h" in row.cells):
            raise MeasurementError(
                f"{row.where}: no `time` or no `speed`, in meters per second (or `speed_km_h`)"
            )
        speed = row.number("speed") if "speed" in row.cells else KM_H * row.number("km_h")
        found.append((row.where, row.time(), speed))
    return found
