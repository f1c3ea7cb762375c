"""What `windows` does, on the CPU, by numpy: keypoints are counted into cells, so that nothing is searched for.

A call of numpy costs less than one of torch, and a look into a table less than a binary search: a third to two thirds
of the time, for every frame that is tracked and every keyframe that is merged.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

_WIDTH, _HEIGHT = 8.0, 32.0  # pixels, of a cell: a window is some runs of cells, one below the other
_COLUMNS, _ROWS = 256, 64  # at most: cells of larger images are larger


def window_pairs_on_host(
    pixels: Array, radius: Array, mask: Array, keypoints: Array, keypoint_mask: Array
) -> tuple[Array, Array]:
    """All pairs of a place and a keypoint within its radius: flat rows b * M + i, ascending, and columns b * N + j.

    pixels: (B, M, 2) finite, at least one; radius, mask: (B, M); keypoints, keypoint_mask: (B, N, 2), (B, N)
    """
    (x, y), (at_x, at_y) = (np.ascontiguousarray(xy.reshape(-1, 2).T) for xy in (keypoints, pixels))
    reach = radius.reshape(-1)
    across, down = _Axis.of(x, _WIDTH, _COLUMNS), _Axis.of(y, _HEIGHT, _ROWS)
    columns = across.number
    order, starts = _sorted_into_cells(x, y, keypoint_mask, across, down)

    left, right = (across(side) for side in (at_x - reach, at_x + reach))
    top, bottom = (down(side) for side in (at_y - reach, at_y + reach))
    first = top * columns + left + _first_cells(mask.shape, down.number * columns)
    bands = np.where(mask.reshape(-1), bottom - top + 1, 0)
    window, band = expand_runs_on_host(np.zeros_like(bands), bands)
    begin = first.take(window) + band * columns
    end = begin + (right - left + 1).take(window)
    run, place = expand_runs_on_host(starts.take(begin), starts.take(end))
    row, column = window.take(run), order.take(place)

    squared = x.take(column) - at_x.take(row)
    squared *= squared
    off_y = y.take(column) - at_y.take(row)
    off_y *= off_y
    squared += off_y
    near = np.flatnonzero(squared <= np.square(reach).take(row))
    return row.take(near), column.take(near)


def expand_runs_on_host(starts: Array, ends: Array) -> tuple[Array, Array]:
    """The numbers of runs starts (n,) ... ends (n,) - 1: of which run each is, and the number."""
    counts = ends - starts
    run = np.repeat(np.arange(len(counts), dtype=np.int64), counts)
    return run, np.arange(len(run), dtype=np.int64) + (starts - (np.cumsum(counts) - counts)).take(run)


class _Axis(NamedTuple):
    """Columns or rows of cells: how many pixels each has, and how many there are; the outer ones take in the rest."""

    size: float
    number: int

    @classmethod
    def of(cls, values: Array, least: float, most: int) -> _Axis:
        """For coordinates (n,): cells of at least so many pixels, and at most so many of them."""
        extent = max(float(values.max()), 0.0)
        size = max(least, extent / most)
        return cls(size, min(int(extent / size) + 1, most))

    def __call__(self, values: Array) -> Array:
        """In which of them coordinates lie."""
        found: Array = np.clip(np.floor(values * (1 / self.size)), 0, self.number - 1).astype(np.int64)
        return found


def _sorted_into_cells(x: Array, y: Array, mask: Array, across: _Axis, down: _Axis) -> tuple[Array, Array]:
    """The keypoints (B N,) cell by cell, image by image, and where each cell begins: (B rows columns + 1,)."""
    of_image = across.number * down.number
    cell = down(y) * across.number + across(x) + _first_cells(mask.shape, of_image)
    count = len(mask) * of_image
    cell[~mask.reshape(-1)] = count  # behind all others
    starts = np.zeros(count + 1, np.int64)
    np.cumsum(np.bincount(cell, minlength=count)[:count], out=starts[1:])
    # Numbers of sixteen bits are sorted digit by digit.
    return np.argsort(cell.astype(np.uint16) if count < 1 << 16 else cell, kind="stable"), starts


def _first_cells(shape: tuple[int, ...], cells: int) -> Array | int:
    """The first cell of the image of each of (B N,) rows; shape: (B, N)."""
    batch, rows = shape
    return 0 if batch == 1 else np.repeat(np.arange(batch, dtype=np.int64) * cells, rows)


def nearest_bits_on_host(
    row: Array,
    column: Array,
    distance: Array,
    scales: Array,
    ratio: float | None,
    limit: int | float,
    same_scale: float,
) -> tuple[Array, Array, Array]:
    """As `windows.nearest_bits`; row ascends; same_scale: share by which two scales of one level may differ."""
    if len(row) == 0:
        return row, column, distance
    is_first = np.empty(len(row), dtype=bool)
    is_first[0], is_first[1:] = True, row[1:] != row[:-1]
    starts = np.flatnonzero(is_first)
    columns = len(scales)
    # One number for distance and column: the least is the nearest, of equals that of the lowest column.
    keys = distance * columns + column
    best = np.minimum.reduceat(keys, starts)
    nearest, chosen = np.divmod(best, columns)
    accepted = nearest <= limit
    if ratio is not None:
        counts = np.diff(starts, append=len(row))
        rival = np.abs(scales.take(column) / np.repeat(scales.take(chosen), counts) - 1) < same_scale
        rival &= keys != np.repeat(best, counts)
        second = np.minimum.reduceat(np.where(rival, distance, np.inf), starts)
        accepted &= nearest < ratio * second
    first, partner, nearest = (values[accepted] for values in (row.take(starts), chosen, nearest))
    # Likewise of the rows that share a column: the last one that is written stays.
    order = np.argsort(nearest * (row[-1] + 1) + first)[::-1]
    winner = np.full(columns, -1)
    winner[partner[order]] = order
    kept = winner.take(partner) == np.arange(len(partner))
    return first[kept], partner[kept], nearest[kept]
