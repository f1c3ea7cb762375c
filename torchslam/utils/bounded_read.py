"""Reading what strangers wrote: regular files only, and never more of one than there may be of its kind.

A pipe or a device has no end, and a name in a list may be that of one.
"""

from __future__ import annotations

import errno
import json
import os
import stat
from pathlib import Path
from typing import Any

CHUNK = 1 << 20
JSON_BYTES = 1 << 25
"""A JSON file above this size is not read: as objects of Python it takes twenty times as much."""


def check_regular(path: str | Path, limit: int, what: str) -> None:
    """For readers that open a file by its name themselves. Raises OSError as `read_bytes` does."""
    try:
        _check(os.stat(path), path, limit, what)
    except ValueError:
        raise _nul(path) from None


def read_bytes(path: str | Path, limit: int, what: str) -> bytes:
    """The content of a regular file.

    Raises OSError, whose `strerror` says why: anything but a regular file, more bytes than `limit`, a name that no
    file has; `what` a file of this kind is called, as in "more than the 100 bytes of a text".
    """
    try:
        # Without O_NONBLOCK, opening a pipe waits for somebody who writes.
        number = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    except ValueError:
        raise _nul(path) from None
    chunks, size = [], 0
    try:
        _check(os.fstat(number), path, limit, what)
        while chunk := os.read(number, CHUNK):
            chunks.append(chunk)
            size += len(chunk)
            if size > limit:  # grows, or is one of those of the system that do not know their size
                raise _too_large(path, size, limit, what)
    finally:
        os.close(number)
    return b"".join(chunks)


def read_text(path: str | Path, limit: int, what: str) -> str:
    """The text of a regular file in UTF-8, lines ending in `\\n`. Raises OSError as `read_bytes` does, ValueError for
    what is no UTF-8."""
    text = read_bytes(path, limit, what).decode("utf-8-sig")
    return text.replace("\r\n", "\n").replace("\r", "\n") if "\r" in text else text


def parse_json(text: str) -> Any:
    """Raises ValueError for what is no JSON, and for what is nested deeper than any that we write."""
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("nested too deep") from None


def _check(status: os.stat_result, path: str | Path, limit: int, what: str) -> None:
    if not stat.S_ISREG(status.st_mode):
        code = errno.EISDIR if stat.S_ISDIR(status.st_mode) else errno.EINVAL
        raise OSError(code, "Is a directory" if code == errno.EISDIR else "not a regular file", str(path))
    if status.st_size > limit:
        raise _too_large(path, status.st_size, limit, what)


def _too_large(path: str | Path, size: int, limit: int, what: str) -> OSError:
    return OSError(errno.EFBIG, f"has {size} bytes, more than the {limit} of {what}", str(path))


def _nul(path: str | Path) -> OSError:
    return OSError(errno.EINVAL, "a name with a NUL in it", str(path))
