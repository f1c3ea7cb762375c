"""Compare a report with earlier ones: metrics that got worse by more than a tenth."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from experiments.report.record import Record, is_quiet

WORSE = 1.1
TIMES = ("cpu_s", "ms_median", "ms")  # the 95th percentile is of too few frames to compare
ERRORS = ("ate", "error")
NOTHING = 1e-9
"""An error below this is rounding and is not compared."""


def compare(record: Record, history: Sequence[Record]) -> list[str]:
    """A line for every metric that is worse by a tenth than the last one that was not itself worse.

    Errors and posed frames are compared across machines, times only on the same machine when it was idle both times.
    A regression is reported again until it is accepted.
    """
    found = []
    for kind in ("sequences", "benchmarks"):
        for name, figures in record[kind].items():
            for earlier in _before(record, history, kind, name):
                old = earlier[kind][name]
                found += [f"{name}: {words}, {_where(earlier)}" for words in _accuracy(figures, old)]
                break
            for earlier in _before(record, history, kind, name, is_timed=True):
                old = earlier[kind][name]
                found += [f"{name}: {words}, {_where(earlier)}" for words in _times(figures, old)]
                break
    return found


def missing(record: Record, history: Sequence[Record]) -> list[str]:
    """Sequences of the last complete report that this one lacks."""
    known = {name for earlier in history[-1:] for name in earlier["sequences"]}
    return sorted(known - record["sequences"].keys())


def same_bytes(record: Record, history: Sequence[Record]) -> dict[str, bool]:
    """For every sequence in the history, whether the trajectory has the same bytes as last time."""
    found = {}
    for name, figures in record["sequences"].items():
        for earlier in _before(record, history, "sequences", name):
            found[name] = earlier["sequences"][name]["trajectory"] == figures["trajectory"]
            break
    return found


def _before(
    record: Record, history: Sequence[Record], kind: str, name: str, is_timed: bool = False
) -> Iterator[Record]:
    """The records that a metric is compared with, newest first."""
    for earlier in reversed(history):
        is_bad = any(words.startswith(f"{name}: ") for words in earlier.get("worse", ()))
        if name not in earlier[kind] or (is_bad and not earlier.get("accepted")):
            continue
        if is_timed and not (
            earlier["machine"] == record["machine"] and is_quiet(earlier) and is_quiet(record)
        ):
            continue
        yield earlier


def _accuracy(new: Record, old: Record) -> Iterator[str]:
    if "posed" in old:
        if new["posed"] * WORSE < old["posed"] * new["frames"] / old["frames"]:
            yield f"posed {new['posed']} of {new['frames']}, was {old['posed']} of {old['frames']}"
        if old["posed"] == 0 < new["posed"]:
            yield f"posed {new['posed']} frames of a sequence without a map, was 0"
    for figure in ERRORS:
        if figure not in old:
            continue
        if figure not in new:
            yield f"{figure} is undefined, was {old[figure]:.6g}"
        elif new[figure] > WORSE * old[figure] + NOTHING:
            yield f"{figure} {new[figure]:.6g}, was {old[figure]:.6g} ({_times_as_much(new[figure], old[figure])})"


def _times(new: Record, old: Record) -> Iterator[str]:
    for figure in TIMES:
        if figure in new and figure in old and new[figure] > WORSE * old[figure]:
            yield f"{figure} {new[figure]:g}, was {old[figure]:g} ({_times_as_much(new[figure], old[figure])})"


def _times_as_much(new: float, old: float) -> str:
    return f"{new / max(old, NOTHING):.2f} times"


def _where(earlier: Record) -> str:
    return f"at {earlier['commit'][:10]} of {earlier['time'][:10]} on {earlier['machine']}"
