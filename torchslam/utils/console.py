"""Terminal output: tables, lines, progress bars, and the message for a missing OpenCV. Imports no torch."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Any, TextIO


def table(rows: Mapping[str, str]) -> str:
    """Format rows as two columns: label and value."""
    width = max(map(len, rows), default=0)
    return "\n".join(f"  {label:<{width}}   {value}" for label, value in rows.items())


def say(words: object) -> None:
    """Print a line to stderr."""
    print(f"torchslam: {words}", file=sys.stderr, flush=True)


def warn(words: object) -> None:
    """Print a warning to stderr."""
    say(f"warning: {words}")


INTERVAL = 5.0
"""Seconds between two progress lines in a log."""


def tqdm_options() -> dict[str, Any]:
    """Return the tqdm arguments for a terminal, or for a log with a line every few seconds."""
    if sys.stderr.isatty():
        return {"file": sys.stderr, "dynamic_ncols": True, "miniters": 1}
    return {"file": Lines(sys.stderr), "mininterval": INTERVAL, "maxinterval": INTERVAL, "miniters": 1}


class Lines:
    """File wrapper that turns the carriage returns of tqdm into lines."""

    def __init__(self, file: TextIO) -> None:
        self._file = file

    def write(self, text: str) -> None:
        """Write a text as a line of its own; nothing if it is blank."""
        line = text.strip()
        if line:
            self._file.write(f"{line}\n")

    def flush(self) -> None:
        """Flush the file."""
        self._file.flush()


OPENCV = (
    "OpenCV is not installed (module cv2): pip install opencv-python-headless, or opencv-python if another package "
    "needs its windows; install only one of them, since each overwrites the files of the other"
)


def with_install_hint(error: ModuleNotFoundError) -> ModuleNotFoundError:
    """Return an error with the command that installs OpenCV if that is missing, any other error unchanged."""
    return ModuleNotFoundError(OPENCV, name="cv2") if error.name == "cv2" else error
