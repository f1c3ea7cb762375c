"""Files that are there whole or not at all, whatever ends the program while they are written."""

from __future__ import annotations

import os
from pathlib import Path

PART = ".part"  # of the name of a file that is being written; what a killed program left is written over


def write_whole(path: str | Path, content: bytes) -> None:
    """Put the content under a name beside `path`, make sure that it is on the disk, and rename it.

    Until then, a file that was there before stays as it was. Raises OSError.
    """
    path = Path(path)
    part = path.with_name(path.name + PART)
    try:
        with part.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise
    _sync_folder(path.parent)


def _sync_folder(folder: Path) -> None:
    """Let the new name survive a loss of power; where folders cannot be opened, the system does it when it likes."""
    try:
        number = os.open(folder, os.O_RDONLY)
    except OSError:
        return
    try:
        os.fsync(number)
    finally:
        os.close(number)
