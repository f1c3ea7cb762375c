"""Text files of lists, numbers and tables, read with errors that name file and line; tensors of their numbers."""

from __future__ import annotations

import datetime
import itertools
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
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
    words = text.split()
    commas = [word for word in words if "." not in word and re.fullmatch(r"[-+]?\d+,\d+(e.*)?", word, re.I)]
    if len(words) > 1 and commas:
        raise error(
            f"{where}: `{commas[0][:100]}`: a decimal comma, or two numbers? Write points, or spaces alone"
        )
    return [parse_number(word, where, error) for word in text.replace(",", " ").split()]


NUMBER = re.compile(r"[-+]?(\d+,\d+|\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", re.ASCII)
THOUSANDS = re.compile(r"[-+]?[1-9]\d{0,2},\d{3}")
"""A number that has a decimal comma in one country, and a thousand of something in another."""
UNKNOWN_WORDS = {
    *("", "-", "--", "?", "na", "n/a", "#n/a", "nil", "none", "null", "\\n", "unknown", "undefined"),
    *("nan", "-nan", "nan(ind)", "-nan(ind)", "1.#qnan", "-1.#ind"),
}
"""What programs write for a number that they do not have, in lower case: R, Excel, SQL, C on several systems."""


def parse_number(text: str, where: str, error: type[TorchslamError]) -> float:
    """Parse a finite number with a decimal point or comma, which must be the whole text. Raises `error` at `where`."""
    text = text.strip()
    is_unclear = THOUSANDS.fullmatch(text) is not None
    is_number = NUMBER.fullmatch(text) is not None and not is_unclear
    number = float(text.replace(",", ".")) if is_number else math.nan
    if not math.isfinite(number):
        is_other = is_number or text.strip("+-").lower() in ("nan", "inf", "infinity")
        hint = "; is its comma a decimal one? Write a point" if is_unclear else ""
        raise error(f"{where}: `{text[:100]}` is not a {'finite ' if is_other else ''}number{hint}")
    return number


def parse_known(text: str, where: str, error: type[TorchslamError]) -> float:
    """Parse a number; NaN for a word that stands for an unknown one. Raises `error` at `where` otherwise."""
    return math.nan if text.strip().lower() in UNKNOWN_WORDS else parse_number(text, where, error)


def are_numbers(words: Iterable[str]) -> bool:
    """Return whether all words are finite numbers with a decimal point."""
    return all(NUMBER.fullmatch(word) and "," not in word and math.isfinite(float(word)) for word in words)


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


CLOCK_SET = 946771200.0
"""2000-01-02, seconds since 1970: a receiver begins at 1970, 1980 or 2000 and gets the date with its first fix."""


def with_set_clock(times: np.ndarray) -> np.ndarray:
    """Times with NaN for those of a clock that was not set: before CLOCK_SET where others are after it."""
    return np.where((times < CLOCK_SET) & (times >= CLOCK_SET).any(), np.nan, times)


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
        moment = datetime.datetime.fromisoformat(text.strip().removesuffix(" UTC"))
    except ValueError:
        return None
    return (moment if moment.tzinfo else moment.replace(tzinfo=datetime.UTC)).timestamp()
