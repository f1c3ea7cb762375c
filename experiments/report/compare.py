"""Compare a report with an earlier one: what got worse."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from experiments.report.record import Report

ERROR, USAGE = 1.05, 1.1
"""Ratios to the earlier figure beyond which errors, and CPU time or memory, count as worse."""
UNCERTAIN = 0.01
"""Share of the frames by which more uncertain ones, or more wrong ones that are not called so, count as worse."""
NOTHING = 1e-9
"""An error below this is rounding."""
COUNTS = {"uncertain": "uncertain frames", "certain_wrong": "wrong frames that are not called uncertain"}
USAGES = {"cpu_s": "CPU time (s)", "peak_mb": "memory (MB)"}

Row = dict[str, Any]


def compare(report: Report, earlier: Report) -> list[str]:
    """A line for each figure that got worse; CPU time and memory are compared on the same machine only."""
    is_same = report["machine"] == earlier["machine"]
    found = []
    for name, new in report["rows"].items():
        if (old := earlier["rows"].get(name)) is None:
            continue
        lines = [*_results(new, old), *(_usage(new, old) if is_same else ())]
        found += [f"{name}: {line}" for line in lines]
    return found


def _results(new: Row, old: Row) -> Iterator[str]:
    if new["exit_status"] != old["exit_status"]:
        yield f"exit status {new['exit_status']}, was {old['exit_status']}"
    if "frames" not in new or "frames" not in old:
        return
    if new["posed"] < old["posed"]:
        yield f"posed {new['posed']} of {new['frames']} frames, was {old['posed']}"
    if old["posed"] == 0 < new["posed"]:
        yield f"posed {new['posed']} frames of a recording without a map"
    for label, before, after in _errors(new, old):
        if before is None:
            continue
        if after is None:
            yield f"{label} is undefined, was {before:.4g}"
        elif after > ERROR * before + NOTHING:
            yield f"{label} {after:.4g}, was {before:.4g} ({after / max(before, NOTHING):.2f} times)"
    for count, label in COUNTS.items():
        if new.get(count, 0) - old.get(count, new.get(count, 0)) > UNCERTAIN * new["frames"]:
            yield f"{new[count]} {label}, was {old[count]}"


def _errors(new: Row, old: Row) -> Iterator[tuple[str, float | None, float | None]]:
    """Label, earlier and new value of each error."""
    yield "online ATE", old.get("online_ate"), new.get("online_ate")
    yield "ATE", old.get("ate"), new.get("ate")
    if "peer" in new and "peer" in old:
        yield "median difference to pycolmap", old["peer"].get("median"), new["peer"].get("median")


def _usage(new: Row, old: Row) -> Iterator[str]:
    for usage, label in USAGES.items():
        if new[usage] > USAGE * old[usage]:
            yield f"{label} {new[usage]:g}, was {old[usage]:g} ({new[usage] / old[usage]:.2f} times)"
