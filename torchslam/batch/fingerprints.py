"""What a result is the result of, as hashes: of settings and program, of the files that were read, of weights."""

from __future__ import annotations

import glob
import hashlib
import json
import os
import stat
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import torchslam
from torchslam.data.synthetic import sequence as synthetic
from torchslam.errors import SequenceError

MAX_FILES = 1_000_000
"""Below the path of a sequence: a folder with more is none."""
DIGITS = 16
"""Hexadecimal ones of a hash that are kept: two of a billion are the same by chance with 3 %."""


def digest(values: Mapping[str, Any]) -> str:
    """A hash of what JSON can say."""
    text = json.dumps(values, sort_keys=True, ensure_ascii=True)
    return hashlib.sha256(text.encode()).hexdigest()[:DIGITS]


@cache
def program() -> str:
    """Version and files of this package: another program may find something else."""
    root = Path(torchslam.__file__).parent
    found = hashlib.sha256(torchslam.__version__.encode())
    for path in sorted(root.rglob("*")):
        if path.suffix in (".py", ".safetensors", ".js", ".css", ".html"):
            found.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    return f"{torchslam.__version__}+{found.hexdigest()[:DIGITS]}"


def of_files(paths: list[str]) -> str:
    """A hash of names, sizes and times of last change: of files, of folders with all below them, of patterns.

    What is missing counts as such. The content is not read: that would take as long as reading the images of all
    sequences at each start. Raises SequenceError for too many files, OSError for what may not be listed.
    """
    found = hashlib.sha256()
    for path in paths:
        if synthetic.matches(path):
            found.update(path.encode() + b"\0")
            continue
        for name, status in _files(path):
            found.update(f"{name}\0{status.st_size} {status.st_mtime_ns}\0".encode(errors="surrogateescape"))
        found.update(b"\1")
    return found.hexdigest()[:DIGITS]


def of_content(path: str) -> str:
    """A hash of what is in a file, such as one of weights: another one may be given the size and time of the last.

    What is no file counts as in `of_files`. Raises OSError for one that cannot be read.
    """
    if not os.path.isfile(path):
        return of_files([path])
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:DIGITS]


def _files(path: str) -> Iterator[tuple[str, os.stat_result]]:
    """Files by their names below a path, sorted."""
    if not os.path.isdir(path):
        for name in [path] if os.path.exists(path) else sorted(glob.glob(path)):
            yield os.path.basename(name), os.stat(name)
        return
    count, waiting = 0, [""]
    while waiting:
        folder = waiting.pop()
        with os.scandir(os.path.join(path, folder)) as entries:
            for entry in sorted(entries, key=lambda entry: entry.name):
                name = os.path.join(folder, entry.name)
                count += 1
                if count > MAX_FILES:
                    raise SequenceError(f"{path}: more than {MAX_FILES} files: no sequence")
                if entry.is_dir(follow_symlinks=False):
                    waiting.append(name)
                elif os.path.exists(entry.path):  # a link may lead nowhere
                    status = entry.stat()
                    if stat.S_ISREG(status.st_mode):
                        yield name, status
