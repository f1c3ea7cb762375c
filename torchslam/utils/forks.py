"""Handles of decoders and files belong to the process that opened them.

A fork inherits them, but not the threads of a decoder: to release it waits for these forever. The place in an open
file it shares with its parent: each would move that of the other.
"""

from __future__ import annotations

import ctypes
import os
import weakref
from typing import Any, Protocol


class Holder(Protocol):
    def forget_handle(self) -> None:
        """Called in a fork: open another one before the next use; `never_release` this one."""

    def close_decoder(self) -> None:
        """Close the handle, if it has threads and can be opened again at the next use."""


_HOLDERS: weakref.WeakSet[Any] = weakref.WeakSet()


def forget_in_forks(holder: Holder) -> None:
    """Have `forget_handle` called in every fork of this process from now on."""
    _HOLDERS.add(holder)


def close_decoders() -> None:
    """Close decoders, whose threads would prevent a fork of this process; they are opened again for the next frame."""
    for holder in list(_HOLDERS):
        holder.close_decoder()


def never_release(handle: object) -> None:
    """Keep a handle as long as the process lives."""
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(handle))


def _in_fork() -> None:
    for holder in list(_HOLDERS):
        holder.forget_handle()


if hasattr(os, "register_at_fork"):  # not on Windows, which has no forks
    os.register_at_fork(after_in_child=_in_fork)
