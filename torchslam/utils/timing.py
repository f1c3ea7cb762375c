"""Timing of the stages of a frame."""

from __future__ import annotations

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
