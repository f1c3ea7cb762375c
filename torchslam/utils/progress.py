"""How far something has come: a bar in a terminal, in a log a line every few seconds instead of carriage returns."""

from __future__ import annotations

import sys
from typing import Any, TextIO

INTERVAL = 5.0
"""Seconds from line to line in a log."""


def stream() -> dict[str, Any]:
    """Arguments of tqdm for where it writes, and how often."""
    if sys.stderr.isatty():
        return {"file": sys.stderr, "dynamic_ncols": True, "miniters": 1}
    return {"file": Lines(sys.stderr), "mininterval": INTERVAL, "maxinterval": INTERVAL, "miniters": 1}


class Lines:
    """Takes what tqdm writes over one line of a terminal, and makes lines of it."""

    def __init__(self, file: TextIO) -> None:
        self._file = file

    def write(self, text: str) -> None:
        line = text.strip()
        if line:
            self._file.write(f"{line}\n")

    def flush(self) -> None:
        self._file.flush()
