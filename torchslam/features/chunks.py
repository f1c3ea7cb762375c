"""A flattened image in pieces: few calls, and what is found of a piece on the way stays in the cache.

On the CPU the pieces are numpy's: for bytes, a call of numpy takes half the time of one of torch, and gives the same.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor

PIECE = 260_000
"""Pixels worked on at once, at most: a dozen intermediate results of bytes stay in the third cache of a processor. With
half as many they fill the second, and more calls take 3 % longer."""


def on_host(pixels: Tensor) -> Any:
    """The pixels as numpy sees them on the CPU, in the same memory; as they are on a GPU and where code is compiled.

    What both can do is written once: slices, operators, and the functions of `library_of`.
    """
    return pixels.numpy() if pixels.is_cpu and not torch.compiler.is_compiling() else pixels


def library_of(pixels: Any) -> ModuleType:
    """numpy or torch, whichever has the pixels: both have minimum, maximum, add and subtract, with `out`."""
    return np if isinstance(pixels, np.ndarray) else torch


def as_tensor(pixels: Any) -> Tensor:
    """Pixels of `on_host`, or what was found of them, as torch has them."""
    return torch.from_numpy(pixels) if isinstance(pixels, np.ndarray) else pixels


def pieces(pixels: Any, start: int, stop: int) -> list[tuple[int, int]]:
    """(start, count) of pieces of nearly one size that make up the pixels of `on_host` from `start` to before `stop`.

    A single one on a GPU, and where a function is compiled, which has no intermediate results; none of nothing.
    """
    count = max(0, stop - start)
    number = max(1, -(-count // PIECE)) if isinstance(pixels, np.ndarray) else 1
    size = -(-count // number)
    return [(first, min(size, stop - first)) for first in range(start, start + count, max(1, size))]
