"""State of every frame as a CSV file: state, submap, matches, inliers, reason and milliseconds per stage."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path

from torchslam.errors import ResultsError
from torchslam.types import State, StepResult
from torchslam.utils.bounded_read import read_text

COLUMNS = ("index", "timestamp", "state", "submap", "keyframe", "matches", "inliers", "reason")
STAGE_SUFFIX = "_ms"
MAX_BYTES = 1 << 28
"""Of two million frames."""


def write_frames(path: str | Path, results: Sequence[StepResult]) -> None:
    """Write one row per frame; a missing submap or stage is an empty cell. The poses are in online.txt."""
    stages = list(dict.fromkeys(name for result in results for name in result.stage_ms))
    with Path(path).open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([*COLUMNS, *(stage + STAGE_SUFFIX for stage in stages)])
        for result in results:
            times = [f"{result.stage_ms[stage]:.3f}" if stage in result.stage_ms else "" for stage in stages]
            submap = "" if result.submap is None else result.submap
            row = [result.index, repr(result.timestamp), result.state.value, submap]
            writer.writerow(
                [*row, int(result.is_keyframe), result.matches, result.inliers, result.reason, *times]
            )


def read_frames(path: str | Path) -> list[StepResult]:
    """The rows of a file written by `write_frames`, without poses. Raises ResultsError that names file and line."""
    try:
        reader = csv.DictReader(io.StringIO(read_text(path, MAX_BYTES, "a list of frames"), newline=""))
        return [_result(row, f"{path}:{reader.line_num}") for row in reader]
    except OSError as error:
        raise ResultsError(f"{path}: cannot be read: {error.strerror}") from None
    except (csv.Error, UnicodeDecodeError) as error:
        raise ResultsError(f"{path}: not a list of frames: {error}") from None


def _result(row: dict[str, str], where: str) -> StepResult:
    try:
        _check_counts(row)
        return StepResult(
            index=int(row["index"]),
            timestamp=_finite(row["timestamp"]),
            state=State(row["state"]),
            T_cw=None,
            submap=int(row["submap"]) if row["submap"] else None,
            is_keyframe=bool(int(row["keyframe"])),
            matches=int(row["matches"]),
            inliers=int(row["inliers"]),
            reason=row["reason"],
            stage_ms={
                name.removesuffix(STAGE_SUFFIX): _finite(value)
                for name, value in row.items()
                if name.endswith(STAGE_SUFFIX) and value
            },
        )
    except (KeyError, ValueError, TypeError, AttributeError) as error:
        raise ResultsError(f"{where}: not a row of frames.csv: {error}") from None


def _check_counts(row: dict[str, str]) -> None:
    """Raises ValueError for a count that no run has, and where columns are missing."""
    for name in ("index", "submap", "keyframe", "matches", "inliers"):
        if row[name] and not 0 <= int(row[name]) < 1 << 31:
            raise ValueError(f"{name} is {int(row[name])}")
    if row["reason"] is None:
        raise ValueError("it is too short")


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"`{text}` is not a finite number")
    return number
