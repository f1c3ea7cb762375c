"""FAST-9 corners (Rosten, Drummond: Machine learning for high-speed corner detection, 2006), on a flat atlas."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchslam.features.chunks import as_tensor, library_of, on_host, pieces
from torchslam.utils.indexing import true_indices

# The circle of radius 3, (dx, dy), clockwise from the top.
CIRCLE = (
    (0, -3), (1, -3), (2, -2), (3, -1), (3, 0), (3, 1), (2, 2), (1, 3),
    (0, 3), (-1, 3), (-2, 2), (-3, 1), (-3, 0), (-3, -1), (-2, -2), (-1, -3),
)  # fmt: skip

Bands = tuple[tuple[int, int], ...]
"""(start, stop) of runs of pixels in a flattened image, ascending."""

Extremum = Callable[..., Any]
Opposites = Callable[[Extremum, int, int], tuple[Any, Any]]
"""(extremum, i, j) -> the extremum of neighbours i and j on the circle, and that of those opposite, i + 8 and j + 8."""


def fast_scores(pixels: Tensor, stride: int, bands: Bands | None = None) -> Tensor:
    """Score of every pixel: the largest t at which it is brighter or darker by t than nine neighbours in a row.

    pixels: (P,) uint8, a flattened image of row length `stride`; bands: of the pixels that are asked for, what others
    score means nothing; None: all. Returns (P,) uint8; 0 where there is no such arc and in the first and last rows,
    which the circle leaves. A pixel is a FAST-9 corner of threshold t where its score exceeds t.
    """
    margin, values = 3 * stride + 3, on_host(pixels)
    parts = _pieces_of(bands, values, margin)
    # Put together, not written into what is there: compiled, that would do without vector instructions.
    scores, end = [], 0
    for start, count in parts:
        scores += [torch.zeros_like(pixels[end:start])] * (start > end)
        scores.append(as_tensor(_piece_scores(values, stride, start, count)))
        end = start + count
    return torch.cat([*scores, torch.zeros_like(pixels[end:])])


def _pieces_of(bands: Bands | None, pixels: Any, margin: int) -> list[tuple[int, int]]:
    """(start, count) of pieces that hold all bands, ascending, but for margins at both ends of the pixels."""
    last = len(pixels) - margin
    if bands is None:
        bands = ((margin, last),)
    # Where nothing is done in pieces, a single one costs less than to leave out the rest.
    if bands and not isinstance(pixels, np.ndarray):
        bands = ((bands[0][0], bands[-1][1]),)
    return [piece for start, stop in bands for piece in pieces(pixels, max(start, margin), min(stop, last))]


def _piece_scores(pixels: Any, stride: int, start: int, count: int) -> Any:
    """`fast_scores` of `count` pixels of `on_host` from `start` on."""

    def opposites(extremum: Extremum, i: int, j: int) -> tuple[Any, Any]:
        # The opposite pair has the same shape: it is this one elsewhere in the image.
        first, second = (dy * stride + dx for dx, dy in (CIRCLE[i], CIRCLE[j]))
        low, high = min(first, -second), max(first, -second)
        here, there = (
            pixels[k : k + count + high - low] for k in (start + low, start + low + second - first)
        )
        found = extremum(here, there)
        return found[first - low :][:count], found[-second - low :][:count]

    return _scores(opposites, pixels[start : start + count], library_of(pixels))


def patch_scores(patches: Tensor) -> Tensor:
    """FAST scores wherever the circle fits into a patch, differentiable: (N, S, S) floats -> (N, S - 6, S - 6)."""
    inner = patches.shape[-1] - 6
    ring = [patches[:, 3 + dy :, 3 + dx :][:, :inner, :inner] for dx, dy in CIRCLE]

    def opposites(extremum: Extremum, i: int, j: int) -> tuple[Tensor, Tensor]:
        return extremum(ring[i], ring[j]), extremum(ring[i - 8], ring[j - 8])

    return _scores(opposites, patches[:, 3:-3, 3:-3], torch)


def _scores(opposites: Opposites, centre: Any, library: ModuleType) -> Any:
    """FAST scores of pixels, given what their neighbours on the circle are."""
    minimum, maximum, subtract = library.minimum, library.maximum, library.subtract
    # The darkest pixel of the brightest arc, and the brightest pixel of the darkest one.
    bright = _onto(_best_arc(opposites, minimum, maximum), maximum, centre)
    dark = _onto(_best_arc(opposites, maximum, minimum), minimum, centre)
    return _onto(centre - dark, maximum, _onto(bright, subtract, centre))


def _best_arc(opposites: Opposites, inner: Extremum, outer: Extremum) -> Any:
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


def _onto(values: Any, function: Callable[..., Any], others: Any) -> Any:
    """function(values, others), for bytes in the memory of the values: new memory costs more than the function."""
    return function(values, others, out=values if values.itemsize == 1 else None)


def find_peaks(scores: Tensor, floor: Tensor, stride: int, bands: Bands | None = None) -> Tensor:
    """Positions (K,) int64, ascending, of scores that exceed their floor and their eight neighbours; of equal ones the
    first wins.

    scores, floor: (P,) uint8, flattened with row length `stride`; bands: of the pixels that are asked, beyond which no
    score exceeds its floor; None: all but a margin.
    """
    values, floors = on_host(scores), on_host(floor)
    parts = _pieces_of(bands, values, stride + 1)
    found = [
        true_indices(as_tensor(_piece_peaks(values, floors, stride, start, count))) + start
        for start, count in parts
    ]
    return torch.cat(found) if found else torch.zeros(0, dtype=torch.int64, device=scores.device)


def _piece_peaks(scores: Any, floor: Any, stride: int, start: int, count: int) -> Any:
    """Which are peaks of `count` pixels of `on_host` from `start` on."""
    maximum = library_of(scores).maximum
    first, length = start - stride, count + 2 * stride
    left, middle, right = (scores[first + k : first + k + length] for k in (-1, 0, 1))
    rows = _onto(maximum(left, right), maximum, middle)  # rows[i] covers columns i-1, i, i+1
    before = _onto(maximum(rows[:count], left[stride:][:count]), maximum, floor[start : start + count])
    after = maximum(rows[2 * stride :], right[stride:][:count])
    centre = middle[stride:][:count]
    return (centre > before) & (centre >= after)
