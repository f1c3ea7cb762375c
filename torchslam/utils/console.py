"""Terminal output: lines, tables and progress bars, and text from outside as it may be shown. Imports no torch."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Mapping
from typing import Any, TextIO

INTERVAL = float(os.environ.get("TORCHSLAM_LOG_INTERVAL", "5"))
"""Seconds between two progress lines in a log: 5, or those of the environment variable."""
OPENCV = (
    "OpenCV is not installed (module cv2): pip install opencv-python-headless, or opencv-python if another package "
    "needs its windows; install only one of them, since each overwrites the files of the other"
)
# Also with the single slash that a path leaves of `//`. A user name or a password may have any character but a space.
_USER = re.compile(r"\b([A-Za-z][A-Za-z0-9+.-]+:/{1,2})\S*@")
_ADDRESS = re.compile(r"\b[A-Za-z][A-Za-z0-9+.-]+:/{1,2}\S+")
_SECRET = re.compile(
    r"((?:password|passwd|pass|pwd|token|secret|signature|api_?key|auth)=)[^&;/\s'\"`]+", re.IGNORECASE
)


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


def with_install_hint(error: ModuleNotFoundError) -> ModuleNotFoundError:
    """Return an error with the command that installs OpenCV if that is missing, any other error unchanged."""
    return ModuleNotFoundError(OPENCV, name="cv2") if error.name == "cv2" else error


def without_credentials(text: str) -> str:
    """Return the text without the user, password and tokens of addresses such as rtsp://user:password@host."""
    if ":/" not in text:
        return text
    return _ADDRESS.sub(lambda found: _SECRET.sub(r"\1***", found[0]), _USER.sub(r"\1", text))


def printable(text: str) -> str:
    """Return the text with control characters, line ends and lone surrogates escaped."""
    return "".join(each if each.isprintable() else each.encode("unicode_escape").decode() for each in text)


def is_unicode(text: str) -> bool:
    """Return True without lone surrogates, which file names in other encodings have."""
    return not any("\ud800" <= character <= "\udfff" for character in text)
