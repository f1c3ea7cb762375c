"""Positions of a receiver: which of them are known, whatever the format of their file."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from torch import Tensor

from torchslam.data.fields import POSITION_COLUMNS
from torchslam.data.text_file import float64, with_set_clock
from torchslam.errors import MeasurementError

NUMBERS = ("latitude", "longitude", "altitude", "std_horizontal", "std_vertical")
"""The columns of a position, in the order of `Fix`."""
MAX_FIXES = 1_000_000  # maximum number of positions of a file: more than a day at 10 Hz


class Fix(NamedTuple):
    """One position as a file has it, at a file and line, of a time in seconds or of the name of an image.

    Attributes:
        latitude, longitude: degrees; NaN where the receiver had no position.
        altitude: meters, above the sea or the ellipsoid or the start; NaN if unknown.
        std: standard deviations, horizontal along one axis and vertical, meters; NaN if unknown.
    """

    where: str
    latitude: float
    longitude: float
    altitude: float = math.nan
    time: float | None = None
    name: str = ""
    std: tuple[float, float] = (math.nan, math.nan)


@dataclass(frozen=True)
class Fixes:
    """N positions, each at a time, seconds, increasing, on the clock of the file, or of an image of some name.

    Attributes:
        geodetic: latitude, longitude and altitude, as in `Fix`.
        std: as in `Fix`.
        notes: remarks for the user, one line each.
    """

    path: Path
    geodetic: Float[Tensor, "N 3"]
    std: Float[Tensor, "N 2"]
    timestamps: Float[Tensor, " N"] | None = None
    names: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.geodetic)


def checked_fixes(path: str | Path, rows: Iterable[Fix], notes: Sequence[str] = ()) -> Fixes:
    """The positions of a file in the order of time, without those that the receiver did not have.

    Rows without a position or a time, or with what devices write for an unknown one, and second ones of one time are
    left out, with a note. Raises MeasurementError for coordinates that cannot be, times out of order, and where nothing
    is left.
    """
    listed = list(itertools.islice(rows, MAX_FIXES + 1))
    if len(listed) > MAX_FIXES:
        raise MeasurementError(f"{path}: more than the {MAX_FIXES} positions that are read")
    table = np.array([(*row[1:4], *row.std) for row in listed], float).reshape(-1, 5)
    invalid = table[:, 3:] < 0  # iOS states by a negative accuracy that the value is invalid
    table[:, :3][np.repeat(invalid, (2, 1), axis=1)] = math.nan
    known = [POSITION_COLUMNS[name].known(column) for name, column in zip(NUMBERS, table.T, strict=True)]
    table, words = np.stack([values for values, _ in known], axis=1), [text for _, text in known]
    table[:, 3:][table[:, 3:] <= 0] = math.nan
    empty = np.isnan(table[:, :2]).any(1)
    is_timed = any(row.time is not None for row in listed)
    times = with_set_clock(np.array([math.nan if row.time is None else row.time for row in listed], float))
    unset = np.isnan(times) & is_timed & ~empty
    kept = np.flatnonzero(~empty & ~unset)
    steps = np.diff(times[kept], prepend=-math.inf)
    places = "".join(f": {name} {text}" for name, text in zip(NUMBERS, words[:2], strict=False) if text)
    said = [
        *notes,
        *([f"{path}: left out {empty.sum()} rows without a position{places}"] if empty.any() else []),
        *([f"{path}: left out {unset.sum()} positions without a time"] if unset.any() else []),
        *([f"{path}: left out {(steps == 0).sum()} positions with a duplicate time"] if 0 in steps else []),
    ]
    if words[2] or invalid[:, 1].any():
        said.append(
            f"{path}: {np.isnan(table[kept, 2]).sum()} altitudes are unknown{words[2] and ': ' + words[2]}"
        )
    if unset.any() and not len(kept):
        raise MeasurementError(f"{listed[int(unset.argmax())].where}: the time is missing, as in all rows")
    if not len(kept):
        what = f"; {len(listed)} rows are empty" if listed else ""
        raise MeasurementError("; ".join([f"{path}: no position in it{what}", *notes]))
    for row in kept[steps < 0][:1]:
        raise MeasurementError(
            f"{listed[row].where}: the time {float(times[row])!r} is earlier than the one before: "
            "sort the file by its times"
        )
    kept = kept[steps != 0]
    limits = 90.0, 360.0, 1e5  # balloons and rockets of amateurs stay below
    for row in kept[(np.abs(table[kept, :3]) > limits).any(1)][:1]:
        raise MeasurementError(f"{listed[row].where}: {_impossible(*table[row, :3])}")
    return Fixes(
        Path(path),
        float64(table[kept, :3]),
        float64(table[kept, 3:]),
        float64(times[kept]) if is_timed else None,
        () if is_timed else tuple(listed[row].name for row in kept),
        tuple(said),
    )


def _impossible(latitude: float, longitude: float, altitude: float) -> str:
    """Say what of a position is none of the Earth's."""
    if abs(latitude) > 90:
        hint = ": are latitude and longitude swapped?" if abs(longitude) <= 90 else ""
        return f"a latitude of {latitude:g} degrees is beyond the poles{hint}"
    if abs(longitude) > 360:
        return f"a longitude of {longitude:g} degrees is beyond 180"
    return f"an altitude of {altitude:g} is no altitude in meters above the ground of the Earth"


def signed_degrees(degrees: float, hemisphere: str, letters: str) -> float:
    """Degrees with the sign of a hemisphere, of the two `letters` "NS" or "EW"; NaN where none is stated."""
    letter = hemisphere.strip("\0 .").upper()[:1]
    if not letter or letter not in letters or (degrees < 0 and letter == letters[0]):
        return math.nan
    return abs(degrees) if letter == letters[0] else -abs(degrees)
