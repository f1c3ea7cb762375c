"""Safe file access: bounded reads of untrusted files, and writes that appear complete or not at all.

Only regular files are read, up to a size limit for each kind: a file name in a list may be that of a pipe or a device,
which have no end. What is written survives even if the program is killed.
"""

from __future__ import annotations

import codecs
import errno
import hashlib
import json
import os
import shutil
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

CHUNK = 1 << 20
"""Bytes that are read at once."""
JSON_BYTES = 1 << 25
"""Size limit of JSON files; the Python objects take about twenty times as much."""
PART = ".part"  # suffix of a file that is being written; leftovers of a killed program are overwritten


def check_regular(path: str | Path, limit: int, what: str) -> None:
    """Check a file that a library opens by name. Raises OSError as `read_bytes`."""
    try:
        _check(os.stat(path), path, limit, what)
    except ValueError:
        raise _nul(path) from None


def read_bytes(path: str | Path, limit: int, what: str) -> bytes:
    """Read the content of a regular file of at most `limit` bytes.

    what: name of this kind of file, for the message "more than the 100 bytes of a text"

    Raises:
        OSError: for a missing file, anything but a regular file, or more bytes.
    """
    try:
        # Without O_NONBLOCK, opening a pipe waits for a writer.
        number = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    except ValueError:
        raise _nul(path) from None
    chunks, size = [], 0
    try:
        _check(os.fstat(number), path, limit, what)
        while chunk := os.read(number, CHUNK):
            chunks.append(chunk)
            size += len(chunk)
            if size > limit:  # the file grows, or is a system file of unknown size
                raise _too_large(path, size, limit, what)
    finally:
        os.close(number)
    return b"".join(chunks)


def read_text(path: str | Path, limit: int, what: str) -> str:
    """Read a regular file in UTF-8, or in UTF-16 with a mark of the order of its bytes, with line ends `\\n`.

    Raises OSError as `read_bytes`, ValueError for another encoding.
    """
    content = read_bytes(path, limit, what)
    is_utf_16 = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    try:
        text = content.decode("utf-16" if is_utf_16 else "utf-8-sig")
    except UnicodeDecodeError as cause:
        place = f"byte {cause.start} is {content[cause.start]:#04x}"
        raise ValueError(f"not a text in UTF-8 ({place}); save it in that encoding") from None
    return text.replace("\r\n", "\n").replace("\r", "\n") if "\r" in text else text


def parse_json(text: str) -> Any:
    """Parse JSON. Raises ValueError for invalid or too deeply nested text."""
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("nested too deep") from None


def fingerprint(parts: Iterable[Any], digits: int = 64) -> str:
    """Hash JSON values and bytes in their order to hexadecimal digits.

    With 16 digits, two of a billion hashes are equal by chance with probability 3 %.
    """
    found = hashlib.sha256()
    for part in parts:
        found.update(part if isinstance(part, bytes) else json.dumps(part, sort_keys=True).encode())
        found.update(b"\0")
    return found.hexdigest()[:digits]


def _check(status: os.stat_result, path: str | Path, limit: int, what: str) -> None:
    if not stat.S_ISREG(status.st_mode):
        code = errno.EISDIR if stat.S_ISDIR(status.st_mode) else errno.EINVAL
        raise OSError(code, "Is a directory" if code == errno.EISDIR else "not a regular file", str(path))
    if status.st_size > limit:
        raise _too_large(path, status.st_size, limit, what)


def _too_large(path: str | Path, size: int, limit: int, what: str) -> OSError:
    return OSError(errno.EFBIG, f"has {size} bytes, more than the {limit} of {what}", str(path))


def _nul(path: str | Path) -> OSError:
    return OSError(errno.EINVAL, "file name contains a NUL character", str(path))


def write_whole(path: str | Path, content: bytes | Iterable[bytes | memoryview]) -> None:
    """Write a file, or its pieces, under a temporary name, sync it to disk, and rename it to `path`.

    An existing file stays unchanged until then. Raises OSError.
    """
    path = Path(path)
    part = path.with_name(path.name + PART)
    try:
        with part.open("wb") as file:
            for piece in [content] if isinstance(content, bytes) else content:
                file.write(piece)
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
        for path_of_file in filter(Path.is_file, part.rglob("*")):
            with path_of_file.open("rb+") as file:
                os.fsync(file.fileno())
        if path.exists():
            path.rename(old)
        part.rename(path)
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise
    _sync_folder(path.parent)
    shutil.rmtree(old, ignore_errors=True)


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
