"""Text files of lists, numbers and tables, read with errors that name file and line; tensors of their numbers."""

from __future__ import annotations

import csv
import datetime
import io
import itertools
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchslam.errors import TorchslamError
from torchslam.utils import files

MAX_BYTES = 1 << 27  # size limit of text files; a million poses are smaller
UNIX_UNITS = {13: 10**3, 16: 10**6, 19: 10**9}
"""Parts of a second that a number with this many digits counts since 1970, from 2001 to 2286."""
MAX_SECONDS = 1e11  # the year 5138
MAX_LINE = 1 << 16  # maximum length of a line of numbers


def float64(values: Any) -> Tensor:
    """Return numbers, or lists of them, as a float64 tensor on the CPU, whatever the default device is."""
    return torch.tensor(values, dtype=torch.float64, device="cpu")


def read_text(path: str | Path, error: type[TorchslamError], limit: int | None = None) -> str:
    """Read a text file. Raises `error` if it is missing, not text or has more bytes than `limit` (MAX_BYTES)."""
    try:
        return files.read_text(path, MAX_BYTES if limit is None else limit, "a text that is read")
    except (OSError, ValueError) as cause:
        raise error(f"{path}: cannot be read: {getattr(cause, 'strerror', None) or cause}") from cause


def read_object(path: str | Path, error: type[TorchslamError]) -> dict[str, Any] | None:
    """Read a JSON object; None if there is no file. Raises `error` for anything else."""
    try:
        found = files.parse_json(files.read_text(path, files.JSON_BYTES, "a JSON file"))
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as cause:
        raise error(f"{path}: cannot be read: {cause.strerror}") from None
    except ValueError as cause:
        raise error(f"{path}: not valid JSON: {cause}") from None
    if not isinstance(found, dict):
        raise error(f"{path}: not a JSON object")
    return found


def numbered_lines(path: str | Path, error: type[TorchslamError]) -> Iterator[tuple[str, str]]:
    """Yield the place, `file:line`, and the content of the non-empty lines; `#` after a space starts a comment.

    Raises `error` where the file does not exist, is not text or is too large.
    """
    for number, line in enumerate(read_text(path, error).splitlines(), start=1):
        content = re.split(r"(?:^|\s)#", line, maxsplit=1)[0].strip()
        if content:
            yield f"{path}:{number}", content


def parse_floats(text: str, where: str, error: type[TorchslamError]) -> list[float]:
    """Parse finite numbers separated by spaces or commas. Raises `error` at `where` otherwise."""
    if len(text) > MAX_LINE:
        raise error(f"{where}: {len(text)} characters, more than the {MAX_LINE} of a line of numbers")
    return [parse_number(word, where, error) for word in text.replace(",", " ").split()]


def parse_number(text: str, where: str, error: type[TorchslamError]) -> float:
    """Parse a finite number, which must be the whole text. Raises `error` at `where` otherwise."""
    try:
        number = float(text)
    except ValueError:
        raise error(f"{where}: `{text[:100]}` is not a number") from None
    if not math.isfinite(number):
        raise error(f"{where}: `{text[:100]}` is not a finite number")
    return number


def are_numbers(words: Iterable[str]) -> bool:
    """Return whether all words are finite numbers."""
    try:
        return all(map(math.isfinite, map(float, words)))
    except ValueError:
        return False


def parse_count(text: str) -> int | None:
    """Parse a non-negative integer of at most 19 digits, as nanoseconds since 1970; None for anything else."""
    return int(text) if text.isascii() and text.isdecimal() and len(text) <= 19 else None


def number_rows(
    path: str | Path, columns: str, error: type[TorchslamError]
) -> Iterator[tuple[str, list[float]]]:
    """Yield the place and the numbers of each line of a file, such as of `columns` "tx ty tz".

    Raises `error` for a line without that many numbers, and for a file without a line.
    """
    where = ""
    for where, line in numbered_lines(path, error):
        row = parse_floats(line, where, error)
        if len(row) != len(columns.split()):
            raise error(f"{where}: expected `{columns}`, got {len(row)} numbers")
        yield where, row
    if not where:
        raise error(f"{path}: is empty; expected lines `{columns}`")


def listed_files(path: str | Path, error: type[TorchslamError]) -> Iterator[tuple[str, float, Path]]:
    """Yield the place, the time in seconds and the file of each line `timestamp file` of a list.

    Raises `error` for anything else, and for a list without a line.
    """
    where = ""
    for where, line in numbered_lines(path, error):
        time, _, file = line.partition(" ")
        if not file.strip():
            raise error(f"{where}: expected `timestamp file`, got `{line}`")
        seconds = in_seconds(parse_number(time, where, error), where, error)
        yield where, seconds, Path(path).parent / file.strip()
    if not where:
        raise error(f"{path}: no files are listed")


def in_seconds(number: float, where: str, error: type[TorchslamError]) -> float:
    """Return a time in seconds; milli-, micro- and nanoseconds since 1970 are converted.

    Raises `error` at `where` for a time that is none of them.
    """
    unit = UNIX_UNITS.get(len(str(int(number))))
    if unit is not None and number > 0:
        return number / unit
    if abs(number) >= MAX_SECONDS:
        raise error(
            f"{where}: timestamp {number:g}: times are seconds, or milli-, micro- or nanoseconds since 1970"
        )
    return number


def check_rising(times: Sequence[float], places: Sequence[str], error: type[TorchslamError]) -> None:
    """Raise `error` at the place of a time that is not later than the one before."""
    for (before, time), where in zip(itertools.pairwise(times), places[1:], strict=True):
        if time <= before:
            relation = "repeats" if time == before else "is earlier than"
            raise error(f"{where}: timestamp {time!r} {relation} the one before")


def utc_from_gps(seconds: float) -> float:
    """Seconds since 1970, UTC, of seconds of GPS time since 1980."""
    unix = seconds + 315964800  # the beginning of GPS time, 1980-01-06 (IS-GPS-200)
    # From a year and month on, seconds by which GPS time is ahead (IERS Bulletin C; none since 2017).
    leaps = ((1999, 1, 13), (2006, 1, 14), (2009, 1, 15), (2012, 7, 16), (2015, 7, 17), (2017, 1, 18))
    starts = ((datetime.datetime(y, m, 1, tzinfo=datetime.UTC).timestamp(), s) for y, m, s in leaps)
    return unix - max((leap for start, leap in starts if unix - leap >= start), default=0)


def parse_moment(text: str) -> float | None:
    """Seconds since 1970 of a date and time as in ISO 8601, UTC without a zone; None for anything else."""
    try:
        moment = datetime.datetime.fromisoformat(text.strip())
    except ValueError:
        return None
    return (moment if moment.tzinfo else moment.replace(tzinfo=datetime.UTC)).timestamp()


class Column(NamedTuple):
    """A kind of column of tables.

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


TIME_UNITS = {"s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9}  # factors to seconds
TIMES = {
    "time": Column(("time", "timestamp", "t"), TIME_UNITS),
    "gps_time": Column(("gpstime",), TIME_UNITS),
}
"""Columns of times; GPS time counts from 1980 and has no leap seconds."""


@dataclass(frozen=True)
class Row:
    """A line of a table at a file and line; the error is raised for a wrong cell.

    Attributes:
        cells: text of each known column that is not empty.
        units: of each known column in the header, the factor of its unit; NaN without a unit.
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

    def time(self) -> float | None:
        """The time, seconds; None in a table without a column of times. Raises the error for anything else."""
        column = next((column for column in TIMES if column in self.units), None)
        if column is None:
            return None
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

    Raises `error` for no header, an unknown one, one without the `needed` columns, another number of cells, and two
    columns of one kind, unless not `are_unique`: then the first one counts.
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
    missing = next((kind for kind in needed if kind not in places), None)
    if missing is not None:
        raise error(f"{where}: no column {missing} in the header `{found}`; needed are {', '.join(needed)}")
    for where, cells in lines:
        known = {kind: text for kind, place in places.items() if (text := cells[place].strip())}
        yield Row(where, known, units, error)


def read_cells(
    path: str | Path, error: type[TorchslamError], limit: int | None = None, delimiter: str = ""
) -> Iterator[tuple[str, list[str]]]:
    """Yield the place and the cells of each line of a table, those of its header first.

    Empty lines and comments, which begin with `#`, are left out. Without `delimiter` it is the comma, semicolon or tab
    of the first line, or white space. Raises `error` for anything but a text of at most `limit` bytes, a quote that
    does not end, or another number of cells than in the header.
    """
    text = read_text(path, error, limit)
    first = text.lstrip().split("\n", 1)[0]
    if len(first) > MAX_LINE:
        raise error(f"{path}:1: {len(first)} characters, more than the {MAX_LINE} of a line")
    if not delimiter:
        delimiter = max(",;\t", key=first.count)
        delimiter = delimiter if delimiter in first else " "
    lines: Iterable[str] = io.StringIO(text, newline="")
    if delimiter == " ":
        lines = (" ".join(line.split()) for line in text.split("\n"))
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
