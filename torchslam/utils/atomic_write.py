"""Atomic writes: a file or folder appears complete or not at all, even if the program is killed."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

PART = ".part"  # suffix of a file that is being written; leftovers of a killed program are overwritten


def write_whole(path: str | Path, content: bytes) -> None:
    """Write a file under a temporary name, sync it to disk, and rename it to `path`.

    An existing file stays unchanged until then. Raises OSError.
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


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """Context manager that yields a temporary folder, renamed to `path` on success and deleted on an exception.

    Leftovers of a killed program are deleted first; an existing folder is replaced last. Only one process may write the
    folder at a time. Raises OSError.
    """
    part, old = path.with_name(f".{path.name}{PART}"), path.with_name(f".{path.name}.old")
    path.parent.mkdir(parents=True, exist_ok=True)
    for left in (part, old):
        shutil.rmtree(left, ignore_errors=True)
    part.mkdir()
    try:
        yield part
        for file in part.rglob("*"):
            if file.is_file():
                _sync_file(file)
        if path.exists():
            path.rename(old)
        part.rename(path)
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise
    _sync_folder(path.parent)
    shutil.rmtree(old, ignore_errors=True)


def _sync_file(path: Path) -> None:
    with path.open("rb+") as file:
        os.fsync(file.fileno())


def _sync_folder(folder: Path) -> None:
    """Sync the directory entry, so that a rename survives a power loss; not possible on every system."""
    try:
        number = os.open(folder, os.O_RDONLY)
    except OSError:
        return
    try:
        os.fsync(number)
    finally:
        os.close(number)
