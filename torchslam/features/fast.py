"""FAST-9 corners (Rosten, Drummond: Machine learning for high-speed corner detection, 2006), on a flat atlas."""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

# The circle of radius 3, (dx, dy), clockwise from the top.
CIRCLE = (
    (0, -3), (1, -3), (2, -2), (3, -1), (3, 0), (3, 1), (2, 2), (1, 3),
    (0, 3), (-1, 3), (-2, 2), (-3, 1), (-3, 0), (-3, -1), (-2, -2), (-1, -3),
)  # fmt: skip

PIECE = 1 << 16  # pixels worked on at once: their intermediate results stay in the cache

Extremum = Callable[[Tensor, Tensor], Tensor]


def fast_scores(pixels: Tensor, stride: int) -> Tensor:
    """Score of every pixel: the largest t at which it is brighter or darker by t than nine neighbours in a row.

    pixels: (P,) uint8, a flattened image of row length `stride`. Returns (P,) uint8; 0 where there is no such
    arc and in the first and last rows, which the circle leaves. A pixel is a FAST-9 corner of threshold t where its
    score exceeds t.
    """
    margin = 3 * stride + 3
    count = pixels.shape[0] - 2 * margin
    if count <= 0:
        return torch.zeros_like(pixels)
    piece = (
        count if torch.compiler.is_compiling() else PIECE
    )  # a compiled function has no intermediate results
    pieces = [
        _piece_scores(pixels, stride, start, min(piece, margin + count - start))
        for start in range(margin, margin + count, piece)
    ]
    rim = pixels.new_zeros(margin)
    return torch.cat([rim, *pieces, rim])


def _piece_scores(pixels: Tensor, stride: int, start: int, count: int) -> Tensor:
    """`fast_scores` of `count` pixels from `start` on."""
    ring = [pixels.narrow(0, start + dy * stride + dx, count) for dx, dy in CIRCLE]
    return _scores(ring, pixels.narrow(0, start, count))


def patch_scores(patches: Tensor) -> Tensor:
    """FAST scores wherever the circle fits into a patch, differentiable: (N, S, S) floats -> (N, S - 6, S - 6)."""
    inner = patches.shape[-1] - 6
    ring = [patches[:, 3 + dy :, 3 + dx :][:, :inner, :inner] for dx, dy in CIRCLE]
    return _scores(ring, patches[:, 3:-3, 3:-3])


def _scores(ring: list[Tensor], centre: Tensor) -> Tensor:
    """FAST scores of pixels, given their sixteen neighbours on the circle."""
    # The darkest pixel of the brightest arc, and the brightest pixel of the darkest one.
    bright = _best_arc(ring, torch.minimum, torch.maximum)
    dark = _best_arc(ring, torch.maximum, torch.minimum)
    return torch.maximum(torch.maximum(bright, centre) - centre, centre - torch.minimum(dark, centre))


def _best_arc(ring: list[Tensor], inner: Extremum, outer: Extremum) -> Tensor:
    """`outer` over the sixteen arcs of nine of `inner` within the arc.

    Four arcs in a row share six pixels: min(six, a) and min(six, b) have the maximum min(six, max(a, b)).
    """
    pairs = [inner(ring[k], ring[k + 1 - 16]) for k in range(1, 16, 2)]
    best: Tensor | None = None
    for k in range(0, 16, 4):  # the arcs from k, k + 1, k + 2 and k + 3 on; pair i holds 2 i + 1 and 2 i + 2
        before, first, second, third, after = (pairs[k // 2 + i - 8] for i in range(5))
        earlier = inner(before, outer(ring[k], ring[k + 9 - 16]))
        later = inner(after, outer(ring[k + 2], ring[k + 11 - 16]))
        arcs = inner(inner(first, second), inner(third, outer(earlier, later)))
        best = arcs if best is None else outer(best, arcs)
    assert best is not None
    return best


def find_peaks(scores: Tensor, floor: Tensor, stride: int) -> Tensor:
    """True where a score exceeds its floor and its eight neighbours; of equal neighbours the first wins.

    scores, floor: (P,) uint8, flattened with row length `stride`. Returns (P,) bool, False on the margins.
    """
    margin = stride + 1
    count = scores.shape[0] - 2 * margin
    if count <= 0:
        return torch.zeros_like(scores, dtype=torch.bool)
    left, middle, right = (scores[k : scores.shape[0] - 2 + k] for k in range(3))
    rows = torch.maximum(torch.maximum(left, right), middle)  # rows[i] covers columns i, i+1, i+2
    before = torch.maximum(rows.narrow(0, 0, count), left.narrow(0, stride, count))
    after = torch.maximum(rows.narrow(0, 2 * stride, count), right.narrow(0, stride, count))
    before = torch.maximum(before, floor.narrow(0, margin, count))
    centre = middle.narrow(0, stride, count)
    return F.pad((centre > before) & (centre >= after), (margin, margin))
