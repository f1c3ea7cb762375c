"""FAST-9 corners (Rosten, Drummond: Machine learning for high-speed corner detection, 2006), on a flat atlas."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchslam.features.pieces import pieces

# The circle of radius 3, (dx, dy), clockwise from the top.
CIRCLE = (
    (0, -3), (1, -3), (2, -2), (3, -1), (3, 0), (3, 1), (2, 2), (1, 3),
    (0, 3), (-1, 3), (-2, 2), (-3, 1), (-3, 0), (-3, -1), (-2, -2), (-1, -3),
)  # fmt: skip

Extremum = Callable[..., Tensor]
Opposites = Callable[[Extremum, int, int], tuple[Tensor, Tensor]]
"""(extremum, i, j) -> the extremum of neighbours i and j on the circle, and that of those opposite, i + 8 and j + 8."""


def fast_scores(pixels: Tensor, stride: int) -> Tensor:
    """Score of every pixel: the largest t at which it is brighter or darker by t than nine neighbours in a row.

    pixels: (P,) uint8, a flattened image of row length `stride`. Returns (P,) uint8; 0 where there is no such
    arc and in the first and last rows, which the circle leaves. A pixel is a FAST-9 corner of threshold t where its
    score exceeds t.
    """
    margin = 3 * stride + 3
    if pixels.shape[0] <= 2 * margin:
        return torch.zeros_like(pixels)
    rim = torch.zeros_like(pixels[:margin])
    parts = pieces(pixels, margin, pixels.shape[0] - margin)
    # Put together, not written into what is there: compiled, that would do without vector instructions.
    return torch.cat([rim, *(_piece_scores(pixels, stride, start, count) for start, count in parts), rim])


def _piece_scores(pixels: Tensor, stride: int, start: int, count: int) -> Tensor:
    """`fast_scores` of `count` pixels from `start` on."""

    def opposites(extremum: Extremum, i: int, j: int) -> tuple[Tensor, Tensor]:
        # The opposite pair has the same shape: it is this one elsewhere in the image.
        first, second = (dy * stride + dx for dx, dy in (CIRCLE[i], CIRCLE[j]))
        low, length = min(first, -second), count + abs(first + second)
        here, there = (pixels.narrow(0, start + low + k, length) for k in (0, second - first))
        found = extremum(here, there)
        return found.narrow(0, first - low, count), found.narrow(0, -second - low, count)

    return _scores(opposites, pixels.narrow(0, start, count))


def patch_scores(patches: Tensor) -> Tensor:
    """FAST scores wherever the circle fits into a patch, differentiable: (N, S, S) floats -> (N, S - 6, S - 6)."""
    inner = patches.shape[-1] - 6
    ring = [patches[:, 3 + dy :, 3 + dx :][:, :inner, :inner] for dx, dy in CIRCLE]

    def opposites(extremum: Extremum, i: int, j: int) -> tuple[Tensor, Tensor]:
        return extremum(ring[i], ring[j]), extremum(ring[i - 8], ring[j - 8])

    return _scores(opposites, patches[:, 3:-3, 3:-3])


def _scores(opposites: Opposites, centre: Tensor) -> Tensor:
    """FAST scores of pixels, given what their neighbours on the circle are."""
    # The darkest pixel of the brightest arc, and the brightest pixel of the darkest one.
    bright = _onto(_best_arc(opposites, torch.minimum, torch.maximum), torch.maximum, centre)
    dark = _onto(_best_arc(opposites, torch.maximum, torch.minimum), torch.minimum, centre)
    return torch.maximum(_onto(bright, torch.sub, centre), centre - dark)


def _best_arc(opposites: Opposites, inner: Extremum, outer: Extremum) -> Tensor:
    """`outer` over the sixteen arcs of nine of `inner` within the arc.

    Pair k holds the neighbours 2 k + 1 and 2 k + 2. The arcs from 2 k and 2 k + 1 on hold the pairs k to k + 3 and an
    end, 2 k or 2 k + 9: min(pairs, a) and min(pairs, b) have the maximum min(pairs, max(a, b)).
    """
    pairs = [*zip(*(opposites(inner, 2 * k + 1, 2 * k + 2) for k in range(4)), strict=True)]
    ends = [*zip(*(opposites(outer, 2 * k, 2 * k + 9) for k in range(4)), strict=True)]
    halves = []
    for half in (0, 1):  # eight arcs that have pair 3 of the half in common
        p, e = (*pairs[half], *pairs[1 - half]), ends[half]
        early = _onto(inner(p[0], e[0]), outer, inner(p[4], e[1]))
        early = _onto(_onto(early, inner, p[1]), inner, p[2])
        late = _onto(inner(p[2], e[2]), outer, inner(p[6], e[3]))
        late = _onto(_onto(late, inner, p[4]), inner, p[5])
        halves.append(_onto(_onto(early, outer, late), inner, p[3]))
    return _onto(halves[0], outer, halves[1])


def _onto(values: Tensor, function: Callable[..., Tensor], others: Tensor) -> Tensor:
    """function(values, others), for bytes in the memory of the values: new memory costs more than the function."""
    return function(values, others, out=None if values.is_floating_point() else values)


def _with_rim(values: Tensor, margin: int) -> Tensor:
    """Memory for as many bytes as there are values; zero at both ends."""
    empty = torch.empty_like(values, dtype=torch.uint8)
    empty[:margin] = empty[-margin:] = 0
    return empty


def find_peaks(scores: Tensor, floor: Tensor, stride: int) -> Tensor:
    """True where a score exceeds its floor and its eight neighbours; of equal neighbours the first wins.

    scores, floor: (P,) uint8, flattened with row length `stride`. Returns (P,) bool, False on the margins.
    """
    margin = stride + 1
    if scores.shape[0] <= 2 * margin:
        return torch.zeros_like(scores, dtype=torch.bool)
    peaks = _with_rim(scores, margin)
    for start, count in pieces(scores, margin, scores.shape[0] - margin):
        peaks.narrow(0, start, count).copy_(_piece_peaks(scores, floor, stride, start, count))
    return peaks.view(torch.bool)


def _piece_peaks(scores: Tensor, floor: Tensor, stride: int, start: int, count: int) -> Tensor:
    """`find_peaks` of `count` pixels from `start` on."""
    left, middle, right = (scores.narrow(0, start - stride + k, count + 2 * stride) for k in (-1, 0, 1))
    rows = _onto(torch.maximum(left, right), torch.maximum, middle)  # rows[i] covers columns i-1, i, i+1
    before = torch.maximum(rows.narrow(0, 0, count), left.narrow(0, stride, count))
    after = torch.maximum(rows.narrow(0, 2 * stride, count), right.narrow(0, stride, count))
    before = _onto(before, torch.maximum, floor.narrow(0, start, count))
    centre = middle.narrow(0, stride, count)
    return (centre > before).logical_and_(centre >= after)
