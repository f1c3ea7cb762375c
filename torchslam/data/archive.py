"""A zip archive of whatever can be read from a folder: unpacked for as long as the sequence lives."""

from __future__ import annotations

import shutil
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path

from torchslam.data.download import unpack
from torchslam.data.frame_names import MAX_FILES
from torchslam.data.sequence import Sequence
from torchslam.errors import DownloadError, SequenceError

LOOKS_FOR = "a .zip of any of these"
MARGIN = 1 << 30
"""Bytes that unpacking leaves free on the disk."""

OpenFolder = Callable[[str], Sequence]


def matches(path: str) -> bool:
    """Whether the file has the suffix of a zip archive."""
    return Path(path).suffix.lower() == ".zip" and Path(path).is_file()


def open(path: str, open_folder: OpenFolder) -> Sequence:
    """The sequence in an archive, opened by `open_folder`.

    Raises SequenceError for an archive that is damaged, unsafe or too large for the disk.
    """
    archive = Path(path)
    holder = tempfile.TemporaryDirectory(prefix="torchslam-")
    _check_size(archive, Path(holder.name))
    folder = Path(holder.name) / archive.stem
    try:
        unpack(archive, folder)
        sequence = open_folder(str(folder))
    except DownloadError as error:
        raise SequenceError(str(error)) from error
    except SequenceError as error:
        raise type(error)(str(error).replace(str(folder), path)) from error
    sequence.holder = holder  # the files go when nothing reads from them any more
    return sequence


def _check_size(archive: Path, target: Path) -> None:
    """Raises SequenceError unless what the archive holds has room on the disk."""
    try:
        with zipfile.ZipFile(archive) as contents:
            entries = contents.infolist()
    except (zipfile.BadZipFile, OSError, NotImplementedError) as cause:
        raise SequenceError(f"{archive}: not a zip archive, or a damaged one: {cause}") from cause
    needed, free = sum(entry.file_size for entry in entries), shutil.disk_usage(target).free
    if len(entries) > MAX_FILES or needed > free - MARGIN:
        raise SequenceError(
            f"{archive}: {len(entries)} files of {needed >> 20} MiB do not fit into {target.parent} "
            f"({free >> 20} MiB free); unpack it elsewhere, or set TMPDIR"
        )
