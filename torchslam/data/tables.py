"""Tables with a header, as CSV: columns by their headings and units, and values that stand for an unknown one."""

from __future__ import annotations

import csv
import itertools
import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from torchslam.data.text_file import (
    MAX_LINE,
    NUMBER,
    in_seconds,
    parse_known,
    parse_moment,
    read_text,
    utc_from_gps,
)
from torchslam.errors import TorchslamError

ROUNDING = 1e-6  # relative difference of a number and its rounded value in another unit


class Unknown(NamedTuple):
    """The numbers that devices write in a field where they do not know the value.

    Attributes:
        numbers: in any unit of the field.
        near: a number of the list is a measurement all the same if another value, of its sign and not on the list, is
            at most this far from it; in the unit of the values.
    """

    numbers: Sequence[float] = ()
    near: float = 0.0


class Column(NamedTuple):
    """A kind of column of tables, and of the same field in other files.

    Attributes:
        names: in lower case, letters and digits alone.
        units: factors of the units that its heading may state, as in `time_ms` or `gyro x [deg/s]`; letters and digits.
            NaN: a word that is no unit.
        unknown: what stands for an unknown value.
    """

    names: tuple[str, ...]
    units: Mapping[str, float] = MappingProxyType({})
    unknown: Unknown = Unknown()

    def unit(self, heading: str, where: str, error: type[TorchslamError]) -> float | None:
        """Return the factor of the unit in a heading, NaN without a unit; None if it is another kind of column.

        The last brackets are the unit, others part of the name. Raises `error` for an unknown unit in brackets.
        """
        words = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", heading).lower().replace("²", "2")
        found = re.fullmatch(r"(.*?)[\[(]([^\[\]()]*)[\])]?\W*", words)
        parts, stated = (
            [part for part in re.split(r"[^a-z0-9µ°]+", text) if part]
            for text in (found.groups() if found else (words, ""))
        )
        for length in range(len(parts), len(parts) - 1 if stated else 0, -1):
            unit = stated or parts[length:]
            if "".join(parts[:length]) not in self.names:
                continue
            # `km/h` is one unit, `m AMSL` one with a word that is none.
            each = [self.units.get(word) for word in unit]
            factors = [factor for factor in each if factor is None or not math.isnan(factor)]
            factor = self.units.get("".join(unit), (factors or [math.nan])[0] if len(factors) < 2 else None)
            if stated and factor is None:
                known = ", ".join(self.units) or "none"
                raise error(
                    f"{where}: column `{heading[:80]}`: the unit `{''.join(unit)}` is not known; known are {known}"
                )
            if factor is not None:
                return factor
        return None

    def known(self, values: Sequence[float] | np.ndarray) -> tuple[np.ndarray, str]:
        """Values of a whole file with NaN in place of those that stand for an unknown one, and which they were.

        The text is such as "-1 (3 times)"; it is empty if there are none.
        """
        values = np.asarray(values, float)
        single, rows = np.unique(values, return_inverse=True)
        listed = np.abs(single) > 1e30  # the largest floats, of 32 and of 64 bits
        for factor in {1.0, *self.units.values()} - {math.nan}:
            for number in self.unknown.numbers:
                listed |= np.abs(single / factor - number) <= ROUNDING * abs(number)
        others = np.concatenate(([-np.inf], single[~listed & np.isfinite(single)], [np.inf]))
        place = np.searchsorted(others, single)
        for beside in (others[place - 1], others[place.clip(max=len(others) - 1)]):
            is_measured = (beside < 0) == (single < 0)
            listed &= ~(is_measured & (np.abs(beside - single) <= self.unknown.near))
        listed = listed[rows]
        words = Counter(f"{value:.6g}" for value in values[listed].tolist())
        text = ", ".join(f"{word} ({count} times)" for word, count in words.most_common(3))
        return np.where(listed, np.nan, values), text


TIME_UNITS = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), 1.0),
    **dict.fromkeys(("ms", "msec", "millis", "millisecond", "milliseconds"), 1e-3),
    **dict.fromkeys(("us", "µs", "usec", "microsecond", "microseconds"), 1e-6),
    **dict.fromkeys(("ns", "nsec", "nanos", "nanosecond", "nanoseconds"), 1e-9),
}
"""Factors to seconds."""
TIMES = {
    "time": Column(
        ("time", "timestamp", "t"), TIME_UNITS | dict.fromkeys(("utc", "gmt", "iso", "unix"), math.nan)
    ),
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

    def number(self, column: str, text: str | None = None) -> float:
        """The number in a column, or of the `text` in it, times its unit; NaN for a word of UNKNOWN_WORDS.

        Raises the error otherwise.
        """
        text = self.cells.get(column, "") if text is None else text
        number = parse_known(text, f"{self.where}: column {column}", self.error)
        unit = self.units.get(column, math.nan)
        return number if math.isnan(unit) else number * unit

    def time(self) -> float | None:
        """The time, seconds, NaN if unknown; None in a table without a column of times. Raises the error otherwise."""
        column = next((column for column in TIMES if column in self.units), None)
        if column is None:
            return None
        text = self.cells.get(column, "")
        moment = parse_moment(text) if re.search(r"\d-\d", text) else None
        if moment is not None:
            return moment
        seconds = self.number(column)
        if math.isnan(self.units[column]) and not math.isnan(seconds):
            seconds = in_seconds(seconds, self.where, self.error)
        return utc_from_gps(seconds) if column == "gps_time" else seconds


def read_table(
    path: str | Path,
    columns: Mapping[str, Column],
    error: type[TorchslamError],
    needed: Iterable[str] = (),
    are_unique: bool = True,
    unnamed: Sequence[str] = (),
) -> Iterator[Row]:
    """Yield the rows of a table whose first line names its columns; other columns than the known ones are left out.

    A table whose first line has numbers alone has the columns `unnamed`. Raises `error` for no header, an unknown one,
    one without the `needed` columns, another number of cells, and two columns of one kind, unless not `are_unique`:
    then the first one counts.
    """
    lines = read_cells(path, error)
    where, headings = next(lines, (f"{path}:1", []))
    if unnamed and headings and all(NUMBER.fullmatch(text.strip()) for text in headings):
        lines = itertools.chain([(where, headings)], lines)
        if len(headings) != len(unnamed):
            raise error(f"{where}: expected `{' '.join(unnamed)}`, got {len(headings)} numbers")
        headings = list(unnamed)
    headings = [heading.strip(" \"'#") for heading in headings]
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
    lines, delimiter = _with_plain_header(
        read_text(path, error, limit).removesuffix("\n").split("\n"), delimiter
    )
    longest = max(map(len, lines[:2]))
    if longest > MAX_LINE:
        raise error(f"{path}:1: {longest} characters, more than the {MAX_LINE} of a line")
    if delimiter == " ":
        lines = [" ".join(line.split()) for line in lines]
    reader = csv.reader((line + "\n" for line in lines), delimiter=delimiter, strict=True)
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


def _with_plain_header(lines: list[str], delimiter: str) -> tuple[list[str], str]:
    """The lines of a table with the header first, one cell for each column, and the delimiter if none is given.

    Comments and Excel's `sep=;` above the header become empty; the last comment is the header if numbers are below it.
    Quotes around whole lines are removed, and R's names of rows get a column.
    """
    bare = [line.strip() for line in lines]
    is_above = re.compile(r"(?i)#|sep=.?$|$").match
    start = next((row for row, line in enumerate(bare) if not is_above(line)), len(bare))
    comments = [row for row in range(start) if bare[row].startswith("#")]
    first = bare[start] if start < len(bare) else ""
    above = bare[comments[-1]].lstrip("# ") if comments else ""
    text = first or above
    if not delimiter:
        delimiter = max(",;\t", key=text.count)
        delimiter = delimiter if delimiter in text else " "

    def cells(line: str) -> list[str]:
        return next(csv.reader([line], delimiter=delimiter), [])

    numbers = [cell for cell in cells(first) if NUMBER.fullmatch(cell.strip())]
    is_header = above and (not first or (numbers and len(cells(above)) == len(cells(first))))
    lines = ["" if row < start else line for row, line in enumerate(lines)]
    if is_header:
        lines[comments[-1]] = above
    below = bare[start + 1 : start + 2]
    if len(cells(first)) == 1 and delimiter in cells(first)[0]:
        lines = [line.strip().strip('"').replace('""', '"') for line in lines]
    elif first[:1] == '"' and below and below[0][:1] == '"' and len(cells(below[0])) == len(cells(first)) + 1:
        lines[start] = f'""{delimiter}{lines[start]}'
    return lines, delimiter
