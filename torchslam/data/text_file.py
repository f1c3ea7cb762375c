"""Small text files of lists and numbers, read with errors that name file and line."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from torchslam.errors import TorchslamError
from torchslam.utils import files

MAX_BYTES = 1 << 27
"""Size limit of text files; a million poses are smaller."""
MAX_DIGITS = 19
"""Maximum number of digits of an integer; nanoseconds since 1970 have 19."""
UNIX_UNITS = {13: 10**3, 16: 10**6, 19: 10**9}
"""Parts of a second that a number with this many digits counts since 1970, from 2001 to 2286."""
MAX_SECONDS = 1e11
"""The year 5138."""
MAX_LINE = 1 << 16
"""Maximum length of a line of numbers."""


def read_text(path: str | Path, error: type[TorchslamError], limit: int | None = None) -> str:
    """Read a text file. Raises `error` if it is missing, not text or too large.

    Args:
        limit: bytes; None: MAX_BYTES
    """
    try:
        return files.read_text(path, MAX_BYTES if limit is None else limit, "a text that is read")
    except OSError as cause:
        raise error(f"{path}: cannot be read: {cause.strerror}") from cause
    except ValueError as cause:
        raise error(f"{path}: cannot be read: {cause}") from cause


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


def numbered_lines(path: str | Path, error: type[TorchslamError]) -> Iterator[tuple[int, str]]:
    """Yield the non-empty lines of a file with their numbers from 1; `#` after a space starts a comment.

    Raises `error` where the file does not exist, is not text or is too large.
    """
    for number, line in enumerate(read_text(path, error).splitlines(), start=1):
        content = re.split(r"(?:^|\s)#", line, maxsplit=1)[0].strip()
        if content:
            yield number, content


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


def number_rows(
    path: str | Path, columns: str, error: type[TorchslamError]
) -> Iterator[tuple[str, list[float]]]:
    """Yield the place and the numbers of each line of a file, such as of `columns` "tx ty tz".

    Raises `error` for a line without that many numbers, and for a file without a line.
    """
    count, row = len(columns.split()), None
    for number, line in numbered_lines(path, error):
        where = f"{path}:{number}"
        row = parse_floats(line, where, error)
        if len(row) != count:
            raise error(f"{where}: expected `{columns}`, got {len(row)} numbers")
        yield where, row
    if row is None:
        raise error(f"{path}: is empty; expected lines `{columns}`")


def listed_files(path: str | Path, error: type[TorchslamError]) -> Iterator[tuple[str, float, Path]]:
    """Yield the place, the time in seconds and the file of each line `timestamp file` of a list.

    Raises `error` for anything else, and for a list without a line.
    """
    where = ""
    for number, line in numbered_lines(path, error):
        where = f"{path}:{number}"
        time, _, file = line.partition(" ")
        if not file.strip():
            raise error(f"{where}: expected `timestamp file`, got `{line}`")
        yield (
            where,
            in_seconds(parse_number(time, where, error), where, error),
            Path(path).parent / file.strip(),
        )
    if not where:
        raise error(f"{path}: no files are listed")


def parse_count(text: str) -> int | None:
    """Parse a non-negative integer of at most 19 digits; None for anything else."""
    return int(text) if text.isascii() and text.isdecimal() and len(text) <= MAX_DIGITS else None


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


def check_later(timestamp: float, before: float, where: str, error: type[TorchslamError]) -> None:
    """Raise `error` at `where` unless a timestamp is later than the previous one."""
    if timestamp <= before:
        relation = "repeats" if timestamp == before else "is earlier than"
        raise error(f"{where}: timestamp {timestamp!r} {relation} the one before")
