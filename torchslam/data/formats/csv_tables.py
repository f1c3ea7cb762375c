"""Tables of text with a header: cells, kinds of columns by their headings, numbers in stated units, times."""

from __future__ import annotations

import csv
import datetime
import io
import math
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from torchslam.data.text_file import MAX_LINE, in_seconds, parse_number, read_text
from torchslam.errors import TorchslamError

GPS_EPOCH = 315964800
"""Seconds from 1970 to the beginning of GPS time, 1980-01-06 (IS-GPS-200)."""
LEAP_SECONDS = (
    (1999, 1, 13), (2006, 1, 14), (2009, 1, 15), (2012, 7, 16), (2015, 7, 17), (2017, 1, 18),
)  # fmt: skip
"""From a year and month on, seconds by which GPS time is ahead of UTC (IERS Bulletin C; none since 2017)."""


def utc_from_gps(seconds: float) -> float:
    """Seconds since 1970, UTC, of seconds of GPS time since 1980."""
    unix = seconds + GPS_EPOCH
    starts = ((datetime.datetime(y, m, 1, tzinfo=datetime.UTC).timestamp(), s) for y, m, s in LEAP_SECONDS)
    return unix - max((leap for start, leap in starts if unix - leap >= start), default=0)


def parse_moment(text: str) -> float | None:
    """Seconds since 1970 of a date and time as in ISO 8601, UTC without a zone; None for anything else."""
    try:
        moment = datetime.datetime.fromisoformat(text.strip())
    except ValueError:
        return None
    moment = moment if moment.tzinfo else moment.replace(tzinfo=datetime.UTC)
    return moment.timestamp()


class Column(NamedTuple):
    """A kind of column in files.

    Attributes:
        names: in lower case, letters and digits alone.
        units: factors of the units that its heading may state, as in `time_ms` or `gyro x [deg/s]`; letters and digits.
    """

    names: tuple[str, ...]
    units: Mapping[str, float] = MappingProxyType({})

    def unit(self, heading: str, where: str, error: type[TorchslamError]) -> float | None:
        """Return the factor of the unit in a heading, NaN without a unit; None if it is another kind of column.

        Raises `error` for a unit in brackets that is not known.
        """
        bare, *brackets = re.split(r"[\[(]", heading.lower().replace("²", "2"), maxsplit=1)
        parts = [part for part in re.split(r"[^a-z0-9µ°]+", bare) if part]
        stated = re.sub(r"[^a-z0-9µ°]", "", "".join(brackets))
        for length in range(len(parts), 0, -1):
            unit = stated or "".join(parts[length:])
            if "".join(parts[:length]) not in self.names:
                continue
            if stated and stated not in self.units:
                known = ", ".join(self.units) or "none"
                raise error(
                    f"{where}: column `{heading[:80]}`: the unit `{unit}` is not known; known are {known}"
                )
            if not unit or unit in self.units:
                return self.units[unit] if unit else math.nan
        return None


TIME_UNITS = {"s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9}
"""Factors to seconds."""
TIMES = {
    "time": Column(("time", "timestamp", "t"), TIME_UNITS),
    "gps_time": Column(("gpstime",), TIME_UNITS),
}
"""Columns of times; GPS time counts from 1980 and has no leap seconds."""


@dataclass(frozen=True)
class Row:
    """A line of a table.

    Attributes:
        where: file and line, for messages.
        cells: text of each known column that is not empty.
        units: of each known column in the header, the factor of its unit; NaN without a unit.
        error: what is raised for a wrong cell.
    """

    where: str
    cells: Mapping[str, str]
    units: Mapping[str, float]
    error: type[TorchslamError]

    def number(self, column: str) -> float:
        """The number in a column, times its unit; NaN where that is empty or `nan`. Raises the error otherwise."""
        text = self.cells.get(column, "nan")
        if text.lower() == "nan":
            return math.nan
        number, unit = parse_number(text, f"{self.where}: column {column}", self.error), self.units[column]
        return number if math.isnan(unit) else number * unit

    @property
    def has_time(self) -> bool:
        """Whether the table has a column of times."""
        return any(column in self.units for column in TIMES)

    def time(self) -> float:
        """The time, seconds. Raises the error for anything else."""
        column = next(column for column in TIMES if column in self.units)
        text = self.cells.get(column, "")
        moment = parse_moment(text) if re.search(r"\d-\d", text) else None
        if moment is not None:
            return moment
        seconds = self.number(column)
        if math.isnan(seconds):
            raise self.error(f"{self.where}: the time is missing")
        if math.isnan(self.units[column]):
            seconds = in_seconds(seconds, self.where, self.error)
        return utc_from_gps(seconds) if column == "gps_time" else seconds


def read_table(
    path: str | Path,
    columns: Mapping[str, Column],
    error: type[TorchslamError],
    needed: Iterable[str] = (),
    are_unique: bool = True,
) -> Iterator[Row]:
    """Yield the rows of a table whose first line names its columns; other columns than the known ones are left out.

    Args:
        path: the file.
        columns: kinds of columns.
        error: what is raised.
        needed: columns that must be there.
        are_unique: whether two columns of one kind are an error; otherwise the first one counts.

    Raises `error` for no header, an unknown one, two columns of one kind, or another number of cells.
    """
    lines = read_cells(path, error)
    where, headings = next(lines, (f"{path}:1", []))
    headings = [heading.lstrip("#").strip(" \"'") for heading in headings]
    places: dict[str, int] = {}
    units: dict[str, float] = {}
    for place, heading in enumerate(headings):
        for kind, column in columns.items():
            unit = column.unit(heading, where, error)
            if unit is None or (kind in places and not are_unique):
                continue
            if kind in places:
                raise error(f"{where}: two columns of the kind `{kind}`: {', '.join(headings)}")
            places[kind], units[kind] = place, unit
    found = ", ".join(headings)[:200]
    if not places:
        expected = ", ".join(f"`{kind}`" for kind in columns)
        raise error(f"{where}: the first line must name the columns {expected}; it is `{found}`")
    missing = [kind for kind in needed if kind not in places]
    if missing:
        raise error(
            f"{where}: no column {missing[0]} in the header `{found}`; needed are {', '.join(needed)}"
        )
    for where, cells in lines:
        known = {kind: text for kind, place in places.items() if (text := cells[place].strip())}
        yield Row(where, known, units, error)


def read_cells(
    path: str | Path, error: type[TorchslamError], limit: int | None = None, delimiter: str = ""
) -> Iterator[tuple[str, list[str]]]:
    """Yield the place and the cells of each line of a table, those of its header first.

    Empty lines and comments, which begin with `#`, are left out.

    Args:
        path: the file.
        error: what is raised.
        limit: maximum number of bytes; None: that of `read_text`.
        delimiter: between cells; empty: the comma, semicolon or tab of the first line, or white space.

    Raises `error` for anything but a text, a quote that does not end, or another number of cells than in the header.
    """
    text = read_text(path, error, limit)
    first = text.lstrip().split("\n", 1)[0]
    if len(first) > MAX_LINE:
        raise error(f"{path}:1: {len(first)} characters, more than the {MAX_LINE} of a line")
    if not delimiter:
        delimiter = max(",;\t", key=first.count)
        delimiter = delimiter if delimiter in first else " "
    lines = (
        (" ".join(line.split()) for line in text.split("\n"))
        if delimiter == " "
        else io.StringIO(text, newline="")
    )
    reader = csv.reader(lines, delimiter=delimiter, strict=True)
    count = 0
    try:
        for cells in reader:
            if not any(cell.strip() for cell in cells) or (count and cells[0].lstrip().startswith("#")):
                continue
            count = count or len(cells)
            while len(cells) > count and not cells[-1].strip():
                cells.pop()
            if len(cells) != count:
                raise error(f"{path}:{reader.line_num}: {len(cells)} cells, the header has {count} columns")
            yield f"{path}:{reader.line_num}", cells
    except csv.Error as cause:
        raise error(f"{path}:{reader.line_num}: not CSV: {cause}") from cause
