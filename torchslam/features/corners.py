"""FAST corners, Harris responses, and sub-pixel positions of corners.

Images are flattened and worked on in chunks: few calls, and intermediate results stay in the cache. On the CPU the
chunks are NumPy's: for bytes, a call of NumPy takes half the time of one of torch, and gives the same.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from types import ModuleType
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int, Shaped, UInt8
from torch import Tensor

from torchslam.utils.indexing import true_indices

CHUNK_PIXELS = 260_000
"""Pixels worked on at once, at most: a dozen intermediate results of bytes stay in the third-level cache. With half as
many they fill the second level, and more calls take 3 % longer."""


def to_numpy(pixels: Tensor) -> Any:
    """View pixels on the CPU as NumPy, in the same memory; those on a GPU are returned as they are.

    What both can do is written once: slices, operators, and the functions of `array_module`.
    """
    return pixels.numpy() if pixels.is_cpu else pixels


def array_module(pixels: Any) -> ModuleType:
    """numpy or torch, whichever has the pixels: both have minimum, maximum, add and subtract, with `out`."""
    return np if isinstance(pixels, np.ndarray) else torch


def chunks(pixels: Any, start: int, stop: int) -> list[tuple[int, int]]:
    """(start, count) of chunks of nearly equal size of the pixels of `to_numpy` in a range; one chunk on a GPU."""
    count = max(0, stop - start)
    number = max(1, -(-count // CHUNK_PIXELS)) if isinstance(pixels, np.ndarray) else 1
    size = -(-count // number)
    return [(first, min(size, stop - first)) for first in range(start, start + count, max(1, size))]


# The circle of radius 3, (dx, dy), clockwise from the top.
FAST_CIRCLE = (
    (0, -3), (1, -3), (2, -2), (3, -1), (3, 0), (3, 1), (2, 2), (1, 3),
    (0, 3), (-1, 3), (-2, 2), (-3, 1), (-3, 0), (-3, -1), (-2, -2), (-1, -3),
)  # fmt: skip

Bands = tuple[tuple[int, int], ...]
"""(start, stop) of runs of pixels in a flattened image, ascending."""

Extremum = Callable[..., Any]
Opposites = Callable[[Extremum, int, int], tuple[Any, Any]]
"""(extremum, i, j) -> the extremum of neighbors i and j on the circle, and that of those opposite, i + 8 and j + 8."""


def fast_scores(pixels: UInt8[Tensor, " A"], stride: int, bands: Bands | None = None) -> UInt8[Tensor, " A"]:
    """Score each pixel of a flattened image by the largest t by which nine neighbors in a row are darker or brighter.

    Scores are 0 where there is no such arc and in the first and last rows, which the circle leaves, and undefined
    outside of the bands. A pixel is a FAST-9 corner of threshold t where its score exceeds t.
    """
    margin, values = 3 * stride + 3, to_numpy(pixels)
    parts = _chunks_of(bands, values, margin)
    scores, end = [], 0
    for start, count in parts:
        scores += [torch.zeros_like(pixels[end:start])] * (start > end)
        found = _chunk_scores(values, stride, start, count)
        scores.append(torch.as_tensor(found, dtype=torch.uint8, device=pixels.device))
        end = start + count
    return torch.cat([*scores, torch.zeros_like(pixels[end:])])


def _chunks_of(bands: Bands | None, pixels: Any, margin: int) -> list[tuple[int, int]]:
    """(start, count) of chunks that hold all bands, ascending, except for margins at both ends of the pixels."""
    last = len(pixels) - margin
    if bands is None:
        bands = ((margin, last),)
    # Off the CPU a single chunk costs less than to leave out what lies between the bands.
    if bands and not isinstance(pixels, np.ndarray):
        bands = ((bands[0][0], bands[-1][1]),)
    return [chunk for start, stop in bands for chunk in chunks(pixels, max(start, margin), min(stop, last))]


def _chunk_scores(pixels: Any, stride: int, start: int, count: int) -> Any:
    """`fast_scores` of `count` pixels of `to_numpy` from `start` on."""

    def opposites(extremum: Extremum, i: int, j: int) -> tuple[Any, Any]:
        # The opposite pair has the same shape: it is this one elsewhere in the image.
        first, second = (dy * stride + dx for dx, dy in (FAST_CIRCLE[i], FAST_CIRCLE[j]))
        low, high = min(first, -second), max(first, -second)
        here, there = (
            pixels[k : k + count + high - low] for k in (start + low, start + low + second - first)
        )
        found = extremum(here, there)
        return found[first - low :][:count], found[-second - low :][:count]

    return _scores(opposites, pixels[start : start + count], array_module(pixels))


def patch_scores(patches: Float[Tensor, "N S S"]) -> Float[Tensor, "N S-6 S-6"]:
    """Compute FAST scores wherever the circle fits into a patch, differentiable."""
    inner = patches.shape[-1] - 6
    ring = [patches[:, 3 + dy :, 3 + dx :][:, :inner, :inner] for dx, dy in FAST_CIRCLE]

    def opposites(extremum: Extremum, i: int, j: int) -> tuple[Tensor, Tensor]:
        return extremum(ring[i], ring[j]), extremum(ring[i - 8], ring[j - 8])

    return _scores(opposites, patches[:, 3:-3, 3:-3], torch)


def _scores(opposites: Opposites, center: Any, library: ModuleType) -> Any:
    """FAST scores of pixels (`center`), given their neighbors on the circle."""
    minimum, maximum, subtract = library.minimum, library.maximum, library.subtract
    # The darkest pixel of the brightest arc, and the brightest pixel of the darkest one.
    bright = _in_place(_best_arc(opposites, minimum, maximum), maximum, center)
    dark = _in_place(_best_arc(opposites, maximum, minimum), minimum, center)
    return _in_place(center - dark, maximum, _in_place(bright, subtract, center))


def _best_arc(opposites: Opposites, inner: Extremum, outer: Extremum) -> Any:
    """`outer` over the sixteen arcs of nine of `inner` within the arc.

    Pair k holds the neighbors 2 k + 1 and 2 k + 2. The arcs from 2 k and 2 k + 1 on hold the pairs k to k + 3 and an
    end, 2 k or 2 k + 9: min(pairs, a) and min(pairs, b) have the maximum min(pairs, max(a, b)).
    """
    pairs = [*zip(*(opposites(inner, 2 * k + 1, 2 * k + 2) for k in range(4)), strict=True)]
    ends = [*zip(*(opposites(outer, 2 * k, 2 * k + 9) for k in range(4)), strict=True)]
    halves = []
    for half in (0, 1):  # eight arcs that have pair 3 of the half in common
        p, e = (*pairs[half], *pairs[1 - half]), ends[half]
        early = _in_place(inner(p[0], e[0]), outer, inner(p[4], e[1]))
        early = _in_place(_in_place(early, inner, p[1]), inner, p[2])
        late = _in_place(inner(p[2], e[2]), outer, inner(p[6], e[3]))
        late = _in_place(_in_place(late, inner, p[4]), inner, p[5])
        halves.append(_in_place(_in_place(early, outer, late), inner, p[3]))
    return _in_place(halves[0], outer, halves[1])


def _in_place(values: Any, function: Callable[..., Any], others: Any) -> Any:
    """function(values, others), for bytes in the memory of the values: new memory costs more than the function."""
    return function(values, others, out=values if values.itemsize == 1 else None)


def find_peaks(
    scores: UInt8[Tensor, " A"], floor: UInt8[Tensor, " A"], stride: int, bands: Bands | None = None
) -> Int[Tensor, " R"]:
    """Find scores that exceed their floor and their eight neighbors; of equal neighbors the first wins.

    No score outside of the bands exceeds its floor. Positions of the peaks are ascending.
    """
    values, floors = to_numpy(scores), to_numpy(floor)
    parts = _chunks_of(bands, values, stride + 1)
    found = []
    for start, count in parts:
        is_peak = _chunk_peaks(values, floors, stride, start, count)
        found.append(true_indices(torch.as_tensor(is_peak, dtype=torch.bool, device=scores.device)) + start)
    return torch.cat(found) if found else torch.zeros(0, dtype=torch.int64, device=scores.device)


def _chunk_peaks(scores: Any, floor: Any, stride: int, start: int, count: int) -> Any:
    """(count,) bool: peaks among the pixels of `to_numpy` from `start` on."""
    maximum = array_module(scores).maximum
    first, length = start - stride, count + 2 * stride
    left, middle, right = (scores[first + k : first + k + length] for k in (-1, 0, 1))
    rows = _in_place(maximum(left, right), maximum, middle)  # rows[i] covers columns i-1, i, i+1
    before = _in_place(maximum(rows[:count], left[stride:][:count]), maximum, floor[start : start + count])
    after = maximum(rows[2 * stride :], right[stride:][:count])
    center = middle[stride:][:count]
    return (center > before) & (center >= after)


HARRIS_WINDOW = 7
"""Side of the window, pixels; as in the ORB of OpenCV."""
HARRIS_K = 0.04
"""Weight of the squared trace in the response; as in the ORB of OpenCV."""


def gather_patches(
    pixels: Shaped[Tensor, " A"], positions: Int[Tensor, " N"], stride: int, radius: int
) -> Shaped[Tensor, "N S S"]:
    """Gather square neighborhoods out of a flattened image, of side 2 radius + 1.

    Whole rows are copied at once, which is ten times faster than an index per pixel.
    """
    side = 2 * radius + 1
    starts = positions - radius * (stride + 1)
    rows = starts[:, None] + torch.arange(side, device=pixels.device) * stride
    return pixels.unfold(0, side, 1).index_select(0, rows.flatten()).view(-1, side, side)


@lru_cache(maxsize=16)
def _harris_matrices(side: int, device: torch.device, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """The Sobel derivatives along x and y at all inner pixels of a flattened patch, and the sums over all windows.

    As matrices, which are eight times as fast as convolutions of small patches.
    """
    sobel = torch.tensor(
        [[-1.0, 0.0, 1.0], [-2.0, 0.0, 2.0], [-1.0, 0.0, 1.0]], dtype=torch.float32, device="cpu"
    )
    kernels = torch.stack([sobel, sobel.T])[:, None], sobel.new_ones(1, 1, HARRIS_WINDOW, HARRIS_WINDOW)
    derivatives, sums = (
        F.conv2d(torch.eye(size * size, dtype=torch.float32, device="cpu").view(-1, 1, size, size), kernel)
        for size, kernel in zip((side, side - 2), kernels, strict=True)
    )
    return derivatives.flatten(1).to(device, dtype), sums.flatten(1).to(device, dtype)


def harris_responses(patches: Float[Tensor, "N S S"]) -> Float[Tensor, "N S-8 S-8"]:
    """Compute Harris responses wherever the 7x7 window of Sobel derivatives fits (Harris, Stephens, 1988).

    For whole-number pixels below 256 the sums are whole numbers too, so they do not depend on the order of summation.
    """
    side = patches.shape[-1]
    derivatives, windows = _harris_matrices(side, patches.device, patches.dtype)
    dx, dy = (patches.flatten(1) @ derivatives).chunk(2, dim=-1)
    xx, yy, xy = (dx * dx) @ windows, (dy * dy) @ windows, (dx * dy) @ windows
    trace = xx + yy
    responses = (xx * yy - xy * xy) - HARRIS_K * trace * trace
    return responses.unflatten(-1, (side - 8, side - 8))


@lru_cache(maxsize=8)
def _paraboloid_fit(device: torch.device, dtype: torch.dtype) -> Float[Tensor, "9 5"]:
    """3x3 values to the least-squares paraboloid's gx, gy, gxx, gyy, gxy at the center."""
    ones, slope, curve = torch.tensor(
        [[1.0, 1.0, 1.0], [-1.0, 0.0, 1.0], [1.0, -2.0, 1.0]], dtype=torch.float32, device="cpu"
    )
    pairs = ((ones, slope, 6), (slope, ones, 6), (ones, curve, 3), (curve, ones, 3), (slope, slope, 4))
    fits = [torch.outer(down, right) / size for down, right, size in pairs]
    return torch.stack(fits, dim=-1).view(9, 5).to(device=device, dtype=dtype)


def quadratic_peak(responses: Float[Tensor, "N 3 3"], limit: float = 0.5) -> Float[Tensor, "N 2"]:
    """Locate the maximum of the paraboloid fitted to 3x3 responses.

    Returns:
        Offset (x, y) from the center in pixels, within +-limit; zero where the fit has no maximum.
    """
    fit = responses.flatten(1) @ _paraboloid_fit(responses.device, responses.dtype)
    gx, gy, gxx, gyy, gxy = fit.unbind(-1)
    determinant, trace = gxx * gyy - gxy * gxy, gxx + gyy
    peaked = (trace < 0) & (determinant > 1e-6 * trace * trace)
    determinant = torch.where(peaked, determinant, torch.ones_like(determinant))
    offset = torch.stack([gxy * gy - gyy * gx, gxy * gx - gxx * gy], dim=-1) / determinant[:, None]
    return torch.where(peaked[:, None], offset, torch.zeros_like(offset)).clamp(-limit, limit)


def soft_peak(responses: Float[Tensor, "N S S"], temperature: float = 0.2) -> Float[Tensor, "N 2"]:
    """Locate the maximum of a neighborhood by a soft arg-max, differentiable.

    Args:
        responses: neighborhoods of odd side; each is divided by its largest magnitude.
        temperature: of the softmax, without unit.

    Returns:
        Offset (x, y) from the center in pixels.
    """
    side = responses.shape[-1]
    scale = responses.abs().amax(dim=(1, 2), keepdim=True).clamp_min(torch.finfo(responses.dtype).tiny)
    weights = torch.softmax((responses / scale / temperature).flatten(1), dim=-1)
    axis = torch.arange(side, device=responses.device, dtype=responses.dtype) - side // 2
    grid = torch.stack([axis.expand(side, side), axis[:, None].expand(side, side)], dim=-1).view(-1, 2)
    return weights @ grid
