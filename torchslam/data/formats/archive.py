"""A zip archive of whatever can be read from a folder: unpacked for as long as the sequence lives."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

from torchslam.data.download import unpack
from torchslam.data.sequence import Sequence
from torchslam.errors import DownloadError, SequenceError, TorchslamError

LOOKS_FOR = "a .zip of any of these"

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
    folder = Path(holder.name) / archive.stem
    try:
        unpack(archive, folder)
        sequence = open_folder(str(folder))
    except BaseException as error:
        holder.cleanup()
        if isinstance(error, DownloadError):
            raise SequenceError(str(error)) from error
        if isinstance(error, TorchslamError):
            raise type(error)(str(error).replace(str(folder), path)) from error
        raise
    sequence.holder = holder  # the files go when nothing reads from them any more
    return sequence
