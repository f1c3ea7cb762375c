"""The list of a batch: sequences with their individual settings."""

from __future__ import annotations

import difflib
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

from torchslam.config import Config
from torchslam.config.schema import check_override_in_file
from torchslam.data.synthetic import is_synthetic
from torchslam.data.tables import read_cells
from torchslam.data.text_file import MAX_LINE, numbered_lines, parse_count, parse_number
from torchslam.errors import ConfigError, SequenceError
from torchslam.utils.console import without_credentials

MAX_BYTES = 1 << 26  # of a list: about half a million rows of a hundred characters
MAX_NAME = 100  # characters of a name; folders are named by it
NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.+=-]*")


@dataclass(frozen=True)
class Row:
    """One run; camera, start, stop, stride, fps, limit, resize and mask are arguments of `torchslam.open_sequence`.

    Attributes:
        name: Of its folder of results, unique in a batch.
        sequence: Path or name, as written in the list.
        config: File of settings.
        overrides: `section.key=value`, applied after `config`.
        groundtruth: A trajectory in TUM format instead of the one of the sequence.
        folder: Base of relative paths.
    """

    name: str
    sequence: str
    camera: str | None = None
    config: str | None = None
    overrides: tuple[str, ...] = ()
    groundtruth: str | None = None
    start: str | None = None
    stop: str | None = None
    stride: int | None = None
    fps: float | None = None
    limit: int | None = None
    resize: str | None = None
    mask: str | None = None
    folder: str = ""

    def resolve(self, name: str) -> str:
        """Resolve a file or folder that the row names."""
        return name if is_synthetic(name) else str(Path(self.folder, name))

    def with_defaults(self, defaults: Mapping[str, Any]) -> Row:
        """Fill in defaults for what the row does not set; overrides of the defaults come before its own."""
        own = {key: value for key, value in asdict(self).items() if value not in (None, ())}
        both = (*defaults.get("overrides", ()), *self.overrides)
        return replace(self, **{**defaults, **own, "overrides": both})


COLUMNS = tuple(field.name for field in fields(Row) if field.name != "folder")


def read_list(path: str | Path) -> list[Row]:
    """Read a list: a CSV file with a header of `COLUMNS`, or a text file with a path per line and `#` for comments.

    Paths are relative to the folder of the list. A row without a name is named by the last part of its path, with a
    number if that is taken. Raises SequenceError if the list is not valid; the message has file and line.
    """
    path = Path(path)
    if path.suffix.lower() == ".csv":
        table = _cells(path)
    else:
        table = ((where, {"sequence": line}) for where, line in numbered_lines(path, SequenceError))
    seen: dict[Row, str] = {}
    for where, cells in table:
        row = _row(cells, where, str(path.parent.absolute()))
        if row in seen:
            raise SequenceError(f"{where}: the same as {seen[row]}; give each its own name")
        seen[row] = where
    if not seen:
        raise SequenceError(f"{path}: no sequences in the list")
    return assign_names(seen, str(path))


def assign_names(rows: Iterable[Row], where: str = "rows") -> list[Row]:
    """Give each row without a name a unique one.

    Raises SequenceError if two rows have the same name; `where` is in the message.
    """
    rows = list(rows)
    # Folders that differ only in case are the same on some systems.
    given = Counter(row.name.casefold() for row in rows if row.name)
    twice = [name for name, count in given.items() if count > 1]
    if twice:
        raise SequenceError(f"{where}: {given[twice[0]]} rows are named {twice[0]}")
    taken, found = set(given), []
    for row in rows:
        name, number, short = row.name, 1, short_name(row.sequence)
        while not name or (not row.name and name.casefold() in taken):
            name = short if number == 1 else f"{short}-{number}"
            number += 1
        taken.add(name.casefold())
        found.append(replace(row, name=name))
    return found


def short_name(sequence: str) -> str:
    """Derive a name from the path of a sequence: letters, digits, and `-` for anything else."""
    text = sequence if is_synthetic(sequence) else Path(without_credentials(sequence)).stem
    text = re.sub(r"[^A-Za-z0-9_.+=]+", "-", text).strip("-.")
    return text[:MAX_NAME] or "sequence"


def _cells(path: Path) -> Iterator[tuple[str, dict[str, str]]]:
    """The place of each row, and its cells by column."""
    rows = read_cells(path, SequenceError, MAX_BYTES, ",")
    header = [name.strip() for name in next(rows, ("", []))[1]]
    for name in header:
        if name not in COLUMNS:
            near = difflib.get_close_matches(name, COLUMNS, n=1)
            hint = f"did you mean {near[0]}?" if near else f"the columns are {', '.join(COLUMNS)}"
            raise SequenceError(f"{path}:1: unknown column `{name[:100]}`; {hint}")
    if len(set(header)) < len(header) or "sequence" not in header:
        raise SequenceError(f"{path}:1: the header must have `sequence`, and no column twice")
    for where, cells in rows:
        yield where, {name: cell.strip() for name, cell in zip(header, cells, strict=True) if cell.strip()}


def _row(cells: Mapping[str, str], where: str, folder: str) -> Row:
    values: dict[str, Any] = dict(cells)
    if not values.get("sequence"):
        raise SequenceError(f"{where}: no sequence")
    for name, cell in cells.items():
        if len(cell) > MAX_LINE or "\0" in cell:
            raise SequenceError(f"{where}: {name}: a NUL, or more than {MAX_LINE} characters")
    name = values.setdefault("name", "")
    if name and (len(name) > MAX_NAME or NAME.fullmatch(name) is None):
        raise SequenceError(
            f"{where}: name `{name[:MAX_NAME]}`: it names a folder; only letters, digits and _ . + = -, "
            f"at most {MAX_NAME}"
        )
    for key in ("stride", "limit"):
        values[key] = parse_count(cells[key]) if key in cells else None
        if key in cells and not values[key]:
            raise SequenceError(f"{where}: {key} must be a positive integer, not `{cells[key]}`")
    if "fps" in values:
        values["fps"] = parse_number(values["fps"], f"{where}: fps", SequenceError)
        if values["fps"] <= 0:
            raise SequenceError(f"{where}: fps must be a positive number, not `{cells['fps']}`")
    settings = (setting.strip() for setting in values.get("overrides", "").split(";"))
    values["overrides"] = tuple(setting for setting in settings if setting)
    try:
        for setting in values["overrides"]:
            check_override_in_file(Config, setting, f"{where}: overrides")
    except ConfigError as error:
        raise SequenceError(str(error)) from None
    return Row(**values, folder=folder)
