"""Tables of numbers with a header: which column is what, in which unit, and times in seconds."""

from __future__ import annotations

import csv
import datetime
import io
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from torchslam.data.text_file import MAX_LINE, in_seconds, read_text
from torchslam.errors import TorchslamError

UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Seconds of a unit that a header names, as in `time_ms` or `timestamp [ns]`."""
GPS_EPOCH = 315964800
"""Seconds from 1970 to the beginning of GPS time, 1980-01-06 (IS-GPS-200)."""
LEAP_SECONDS = (
    (1999, 1, 13), (2006, 1, 14), (2009, 1, 15), (2012, 7, 16), (2015, 7, 17), (2017, 1, 18),
)  # fmt: skip
"""From a year and month on, seconds by which GPS time is ahead of UTC (IERS Bulletin C; none since 2017)."""
TIME_NAMES = ("time", "timestamp", "t", "gps_time")
"""Columns of times, with a unit at the end or none; `gps_time` counts from 1980 and has no leap seconds."""


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


@dataclass(frozen=True)
class Row:
    """A line of a table.

    Attributes:
        where: file and line, for messages.
        cells: text of each known column that is not empty.
        error: what is raised for a wrong one.
        time_column: the name of the column of times, as in the header.
    """

    where: str
    cells: Mapping[str, str]
    error: type[TorchslamError]
    time_column: str

    def number(self, column: str) -> float:
        """The number in a column; NaN where it is empty or says so. Raises the error for anything else."""
        text = self.cells.get(column, "nan")
        try:
            number = float(text)
        except ValueError:
            raise self.error(f"{self.where}: `{text}` in the column {column} is not a number") from None
        if math.isinf(number):
            raise self.error(f"{self.where}: `{text}` in the column {column} is not a finite number")
        return number

    def time(self) -> float:
        """The time, seconds. Raises the error for anything else."""
        text = self.cells.get("time", "")
        moment = parse_moment(text) if re.search(r"\d-\d", text) else None
        if moment is not None:
            return moment
        number = self.number("time")
        if math.isnan(number):
            raise self.error(f"{self.where}: the time is missing")
        unit = re.search(r"(?:_|\[|\()(s|ms|us|ns)[\])]?$", self.time_column)
        seconds = in_seconds(number, self.where, self.error) if unit is None else number * UNITS[unit[1]]
        return utc_from_gps(seconds) if self.time_column.startswith("gps_time") else seconds


def read_csv(
    path: str | Path, synonyms: Mapping[str, tuple[str, ...]], error: type[TorchslamError]
) -> Iterator[Row]:
    """Yield the rows of a table whose first line names its columns, separated by commas, semicolons or tabs.

    Args:
        path: the file.
        synonyms: what each column is called in files, in lower case; those of `time` are known.
        error: what is raised.

    Raises `error` for no header, an unknown one, two columns of one kind, or another number of cells.
    """
    text = read_text(path, error)
    first = text.split("\n", 1)[0]
    separator = max(",;\t", key=first.count)
    if len(first) > MAX_LINE:
        raise error(f"{path}:1: {len(first)} characters, more than the {MAX_LINE} of a line")
    names = [name.strip().lower().lstrip("#").strip() for name in first.split(separator)]
    columns = {name: _kind(name, synonyms) for name in names}
    if not any(columns.values()):
        expected = ", ".join(f"`{each[0]}`" for each in synonyms.values())
        raise error(
            f"{path}:1: the first line must name the columns `time`, {expected}; it is `{first[:200]}`"
        )
    kinds = [columns[name] for name in names]
    for kind in filter(None, kinds):
        if kinds.count(kind) > 1:
            raise error(f"{path}:1: two columns of the kind `{kind}`: {', '.join(names)}")
    time_column = next((name for name in names if columns[name] == "time"), "")
    reader = csv.reader(io.StringIO(text), delimiter=separator)
    try:
        for cells in reader:
            if reader.line_num == 1 or not any(cell.strip() for cell in cells):
                continue
            where = f"{path}:{reader.line_num}"
            if len(cells) != len(kinds):
                raise error(f"{where}: {len(cells)} cells, the header has {len(kinds)} columns")
            found = {k: c.strip() for k, c in zip(kinds, cells, strict=True) if k and c.strip()}
            yield Row(where, found, error, time_column)
    except csv.Error as cause:
        raise error(f"{path}:{reader.line_num}: {cause}") from cause


def _kind(name: str, synonyms: Mapping[str, tuple[str, ...]]) -> str:
    """The kind of a column by its name; empty if it is none of the known ones."""
    base = re.sub(r"(?:_|\s*[\[(])(s|ms|us|ns)[\])]?$", "", name)
    if base in TIME_NAMES:
        return "time"
    return next((kind for kind, known in synonyms.items() if name in known), "")
