"""The table of a batch as CSV, and as Parquet if pyarrow is installed."""

from __future__ import annotations

import csv
import importlib
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from uuid import uuid4

from torchslam.batch.result_store import DONE, ERROR, NO_MAP, RUNS, Columns, read_stored
from torchslam.batch.task import TIMES, Task, configuration
from torchslam.data.text_file import read_object
from torchslam.errors import ResultsError, TorchslamError
from torchslam.utils.console import without_credentials
from torchslam.utils.files import write_whole

CSV = "table.csv"
TIMES_CSV = "times.csv"

# Columns and their types, the same for every batch.
COLUMNS: dict[str, type] = {
    "name": str,
    "sequence": str,
    "status": str,
    "error": str,
    **dict.fromkeys(("frames", "posed", "lost", "uncertain", "skipped", "initialized_at"), int),
    **dict.fromkeys(("keyframes", "points", "submaps"), int),
    **dict.fromkeys(("posed_ratio_after_initialization", "reprojection_px", "track_length"), float),
    **dict.fromkeys(("ate_m", "ate_se3_m", "online_ate_m", "rpe_translation_m", "rpe_rotation_deg"), float),
    "compared": int,
    **dict.fromkeys(("scale", "path_length_m"), float),
    "camera": str,
    "configuration": str,
}
LARGEST = 1 << 62  # of a value: larger ones are invalid
TIME_COLUMNS: dict[str, type] = {"name": str, **dict.fromkeys(("cpu_s", "fps", "ms_median", "ms_p95"), float)}


def write_table(tasks: Sequence[Task], output: Path) -> list[Columns]:
    """Write the table of all rows of the list, those of other shards included; return the rows.

    Unfinished rows have the status `open`. Each process reads all results again after writing, so the table is complete
    in the end whichever process writes last. Raises ResultsError for damaged times of a run.
    """
    configurations = []
    for task in tasks:
        try:
            configurations.append(configuration(task))
        except TorchslamError:
            configurations.append("")  # the row reports the error
    rows: list[Columns] | None = None
    while (found := collect_rows(tasks, configurations, output)) != rows:
        rows = found
        _put(output / CSV, _csv(rows, COLUMNS).encode())
        times = [{"name": row["name"]} | read_times(output / RUNS / row["name"]) for row in rows]
        _put(output / TIMES_CSV, _csv(times, TIME_COLUMNS).encode())
        if (content := _parquet(rows)) is not None:
            _put(output / "table.parquet", content)
    return found


def describe_statuses(rows: Sequence[Mapping[str, Any]]) -> str:
    """Describe the number of rows per status."""
    statuses = [row["status"] for row in rows]
    labels = {DONE: "done", NO_MAP: "without a map", ERROR: "with an error", "open": "not yet run"}
    return ", ".join(f"{statuses.count(key)} {label}" for key, label in labels.items() if key in statuses)


def collect_rows(tasks: Sequence[Task], configurations: Sequence[str], output: Path) -> list[Columns]:
    """Read the rows of the table from the records in the folder of a batch; an invalid record is an error row.

    The configuration of each task is that by `task.configuration`, empty if that failed.
    """
    rows = []
    for task, settings in zip(tasks, configurations, strict=True):
        name = task.row.name
        try:
            record = read_stored(output, name, settings)
        except ResultsError as error:
            record = {"status": ERROR, "error": str(error)}
        record |= {"name": name, "sequence": without_credentials(task.row.sequence)}
        rows.append({column: _typed(record.get(column), kind) for column, kind in COLUMNS.items()})
    return rows


def _typed(value: object, kind: type) -> Any:
    """A value of a record; None if it has another type or is out of range."""
    if kind is float and isinstance(value, int | float) and not isinstance(value, bool):
        return float(value) if abs(value) < LARGEST else None
    if type(value) is not kind or (isinstance(value, int) and not 0 <= value < LARGEST):
        return None
    return value.encode(errors="backslashreplace").decode() if isinstance(value, str) else value


def read_times(folder: Path) -> Columns:
    """Read times.json; empty if there is none. Raises ResultsError if it is not readable."""
    return read_object(folder / TIMES, ResultsError) or {}


def _csv(rows: Sequence[Columns], columns: Mapping[str, type]) -> str:
    """The table as text: floats with all digits, empty cells for None."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows([row.get(name) for name in columns] for row in rows)
    return text.getvalue()


def _parquet(rows: Sequence[Columns]) -> bytes | None:
    """The table as Parquet; None without pyarrow."""
    try:
        arrow = importlib.import_module("pyarrow")
        parquet = importlib.import_module("pyarrow.parquet")
    except ImportError:
        return None
    types = {str: arrow.string(), int: arrow.int64(), float: arrow.float64()}
    schema = arrow.schema([(name, types[kind]) for name, kind in COLUMNS.items()])
    buffer = io.BytesIO()
    parquet.write_table(arrow.Table.from_pylist(list(rows), schema=schema), buffer)
    return buffer.getvalue()


def _put(path: Path, content: bytes) -> None:
    """Write a file atomically, also if other processes write it at the same time."""
    path.parent.mkdir(parents=True, exist_ok=True)
    own = path.with_name(f".{path.name}.{uuid4().hex}")
    write_whole(own, content)
    own.replace(path)
