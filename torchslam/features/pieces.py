"""A flattened image in pieces: few calls, and what is found of a piece on the way stays in the cache."""

from __future__ import annotations

import torch
from torch import Tensor

PIECE = 160_000
"""Pixels worked on at once, at most: a dozen intermediate results of bytes fill the second cache of a processor."""


def pieces(pixels: Tensor, start: int, stop: int) -> list[tuple[int, int]]:
    """(start, count) of pieces of nearly one size that make up the pixels from `start` to before `stop`.

    A single one on a GPU, and where a function is compiled, which has no intermediate results.
    """
    count = stop - start
    is_whole = torch.compiler.is_compiling() or not pixels.is_cpu
    number = 1 if is_whole else max(1, -(-count // PIECE))
    size = -(-count // number)
    return [(first, min(size, stop - first)) for first in range(start, stop, max(1, size))]
