"""What a run costs: time of the stages of a frame, CPU time and memory of this process and its ended workers."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager


class Stopwatch:
    """Milliseconds per stage. Stages must not nest, except inside `rest`."""

    def __init__(self) -> None:
        self.ms: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        try:
            yield
        finally:
            self.ms[stage] = self.ms.get(stage, 0.0) + (time.perf_counter() - start) * 1e3

    @contextmanager
    def rest(self, stage: str) -> Iterator[None]:
        """Time the rest of a block, without the stages inside it, as a stage."""
        start, before = time.perf_counter(), sum(self.ms.values())
        try:
            yield
        finally:
            inside = sum(self.ms.values()) - before
            spent = (time.perf_counter() - start) * 1e3
            self.ms[stage] = self.ms.get(stage, 0.0) + spent - inside

    def take(self) -> dict[str, float]:
        """The stages since the last call, and their total."""
        taken, self.ms = self.ms, {}
        return taken | {"total": sum(taken.values())}


def cpu_seconds() -> float | None:
    """User and system time of this process and of its children that have ended; None where the system has no count."""
    if sys.platform == "win32":
        return None
    import resource

    used = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(each.ru_utime + each.ru_stime for each in used)


def peak_memory_mb() -> float | None:
    """The largest resident set of this process or of any one child that has ended; None where it is not counted."""
    if sys.platform == "win32":
        return None
    import resource

    peaks = (resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return max(peaks) * (1 if sys.platform == "darwin" else 1024) / 1e6  # Linux counts in KiB, macOS in bytes
