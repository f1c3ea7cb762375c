"""Positions on the Earth at times, or of images, as receivers and drones record them: the record and its checks."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.errors import MeasurementError

MAX_FIXES = 1_000_000
"""Maximum number of positions of a file: more than a day at 10 Hz."""
MAX_ALTITUDE = 1e5
"""Meters: the farthest from the ground that a position may be; balloons and rockets of amateurs stay below."""


class Fix(NamedTuple):
    """One position as a file has it.

    Attributes:
        where: file and line, for messages.
        latitude: degrees; NaN where the receiver had no position.
        longitude: degrees.
        altitude: meters, above the sea or the ellipsoid or the start; NaN if unknown.
        time: seconds; None where `name` says whose position it is.
        name: of an image.
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
    """N positions, each at a time or of an image.

    Attributes:
        path: where they come from.
        geodetic: latitude and longitude, degrees, and altitude, meters; the altitude is NaN if it is unknown.
        std: standard deviations, horizontal along one axis and vertical, meters; NaN if unknown.
        timestamps: seconds, increasing, on the clock of the file; None where they are known by names.
        names: N names of image files, or empty.
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

    Rows without a position (empty, NaN or the zeros that receivers write) and second ones of one time are left out,
    with a note. Raises MeasurementError for coordinates or errors that cannot be, times out of order, and where nothing
    is left.
    """
    kept: list[Fix] = []
    empty = doubled = 0
    for count, row in enumerate(rows):
        if count >= MAX_FIXES:
            raise MeasurementError(f"{path}: more than the {MAX_FIXES} positions that are read")
        if math.isnan(row.latitude) or math.isnan(row.longitude) or row.latitude == row.longitude == 0:
            empty += 1
            continue
        _check(row)
        if row.time is not None and kept and kept[-1].time is not None and row.time <= kept[-1].time:
            if row.time < kept[-1].time:
                raise MeasurementError(
                    f"{row.where}: the time {row.time!r} is earlier than the one before, {kept[-1].time!r}: "
                    "sort the file by its times"
                )
            doubled += 1
            continue
        kept.append(row)
    if not kept:
        raise MeasurementError(f"{path}: no position in it" + (f"; {empty} rows are empty" if empty else ""))
    said = [*notes]
    if empty:
        said.append(f"{path}: left out {empty} rows without a position")
    if doubled:
        said.append(f"{path}: left out {doubled} positions of a time that another one has")
    times = [row.time for row in kept if row.time is not None]
    return Fixes(
        Path(path),
        torch.tensor([row[1:4] for row in kept], dtype=torch.float64, device="cpu"),
        torch.tensor([row.std for row in kept], dtype=torch.float64, device="cpu"),
        torch.tensor(times, dtype=torch.float64, device="cpu") if times else None,
        () if times else tuple(row.name for row in kept),
        tuple(said),
    )


def _check(row: Fix) -> None:
    """Raise MeasurementError for a position that is none of the Earth's, or an error that is none."""
    if not abs(row.latitude) <= 90:
        hint = ": are latitude and longitude swapped?" if abs(row.longitude) <= 90 else ""
        raise MeasurementError(
            f"{row.where}: a latitude of {row.latitude:g} degrees is beyond the poles{hint}"
        )
    if not abs(row.longitude) <= 360:
        raise MeasurementError(f"{row.where}: a longitude of {row.longitude:g} degrees is beyond 180")
    if not (math.isnan(row.altitude) or abs(row.altitude) <= MAX_ALTITUDE):
        raise MeasurementError(
            f"{row.where}: an altitude of {row.altitude:g} is no altitude in meters above the ground of the Earth"
        )
    for std in row.std:
        if not (math.isnan(std) or 0 < std < math.inf):
            raise MeasurementError(f"{row.where}: a standard deviation of {std:g} m is not above zero")
