"""Matching guided by predicted pixels: ORB-SLAM's search by projection.

A radius search finds the keypoints within a radius of predicted pixels, and the nearest of them by Hamming distance.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped
from numpy.typing import NDArray
from torch import Tensor

from torchslam.features.matching.brute_force import (
    SAME_SCALE,
    best_per_row,
    check_descriptors,
    empty_matches,
    masked_rows,
    one_to_one,
    pair_distances,
    to_matches,
)
from torchslam.features.matching.hamming import hamming_between
from torchslam.geometry.precision import check_positive, without_autocast
from torchslam.types import Features, Matches

Array = NDArray[Any]

_BAND_HEIGHT = 32.0  # pixels, of the bands of keypoints that the torch backend searches
# Pixels from one band to the next, and from one image to the next, where keypoints stand in one row. Far more than
# images have; a wider window takes in keypoints outside of its radius, which are then left out.
_BAND_OFFSET, _IMAGE_OFFSET = 2.0**20, 2.0**36
# Pixels, in the NumPy backend: a window is some runs of cells, one per row.
_CELL_WIDTH, _CELL_HEIGHT = 8.0, 32.0
_MAX_COLUMNS, _MAX_ROWS = 256, 64  # of cells: those of larger images are larger


def pairs_within_radius(
    pixels: Float[Tensor, "B M 2"],
    radius: Float[Tensor, "B M"],
    mask: Bool[Tensor, "B M"],
    keypoints: Float[Tensor, "B N 2"],
    keypoint_mask: Bool[Tensor, "B N"],
) -> tuple[Int[Tensor, " R"], Int[Tensor, " R"]]:
    """Find all pairs of a predicted pixel of the mask, finite, and a keypoint within its radius, pixels.

    Returns flat rows b * M + i, ascending, and flat columns b * N + j; the columns of a row are in no particular order.
    """
    if keypoints.is_cpu:
        inputs = pixels.double(), radius.double(), mask, keypoints.double(), keypoint_mask
        found = _pairs_within_radius_numpy(*(tensor.detach().numpy() for tensor in inputs))
        return torch.from_numpy(found[0]), torch.from_numpy(found[1])
    # Keypoints are sorted by band, then by x: what a window takes of a band is one run in that order.
    x, y = keypoints.double().unbind(-1)
    at_x, at_y = pixels.double().unbind(-1)
    low, high = torch.floor((at_y - radius) / _BAND_HEIGHT), torch.floor((at_y + radius) / _BAND_HEIGHT)
    spans = int((high - low).amax()) + 1
    bands = low[..., None] + torch.arange(spans, device=low.device)
    places, starts = torch.floor(y / _BAND_HEIGHT) * _BAND_OFFSET + x, bands * _BAND_OFFSET
    if len(mask) > 1:
        image = torch.arange(len(mask), device=mask.device)[:, None] * _IMAGE_OFFSET
        places, starts = places + image, starts + image[..., None]
    keys, order = places.masked_fill(~keypoint_mask, torch.inf).flatten().sort(stable=True)
    left = torch.searchsorted(keys, starts + (at_x - radius)[..., None])
    right = torch.searchsorted(keys, starts + (at_x + radius)[..., None], right=True)
    right = torch.where((bands <= high[..., None]) & mask[..., None], right, left)
    run, place = expand_runs(left.flatten(), right.flatten())
    row, column = torch.div(run, spans, rounding_mode="floor"), order.index_select(0, place)
    columns, rows = keypoints.flatten(0, 1).unbind(1), pixels.flatten(0, 1).unbind(1)
    off_x, off_y = (columns[k].index_select(0, column) - rows[k].index_select(0, row) for k in (0, 1))
    squared = off_x.square_().add_(off_y.square_())
    near = torch.nonzero(squared <= radius.flatten().square().index_select(0, row))[:, 0]
    return row.index_select(0, near), column.index_select(0, near)


@without_autocast
def expand_runs(
    starts: Int[Tensor, " N"], ends: Int[Tensor, " N"]
) -> tuple[Int[Tensor, " R"], Int[Tensor, " R"]]:
    """Expand the runs starts[k], ..., ends[k] - 1 into one list: the run of each number, ascending, and the numbers."""
    if starts.is_cpu:
        found = _expand_runs_numpy(starts.numpy(), ends.numpy())
        return torch.from_numpy(found[0]), torch.from_numpy(found[1])
    counts = ends - starts
    run = torch.repeat_interleave(counts)
    shift = starts - (counts.cumsum(0) - counts)
    return run, torch.arange(run.shape[0], device=run.device) + shift.index_select(0, run)


def _pairs_within_radius_numpy(
    pixels: Array, radius: Array, mask: Array, keypoints: Array, keypoint_mask: Array
) -> tuple[Array, Array]:
    """`pairs_within_radius` on the CPU."""
    (x, y), (at_x, at_y) = (np.ascontiguousarray(xy.reshape(-1, 2).T) for xy in (keypoints, pixels))
    reach = radius.reshape(-1)
    across = _CellAxis.of(x, _CELL_WIDTH, _MAX_COLUMNS)
    down = _CellAxis.of(y, _CELL_HEIGHT, _MAX_ROWS)
    columns = across.number
    order, starts = _sorted_into_cells(x, y, keypoint_mask, across, down)

    left, right = (across.cell_of(side) for side in (at_x - reach, at_x + reach))
    top, bottom = (down.cell_of(side) for side in (at_y - reach, at_y + reach))
    first = top * columns + left + _first_cells(mask.shape, down.number * columns)
    bands = np.where(mask.reshape(-1), bottom - top + 1, 0)
    window, band = _expand_runs_numpy(np.zeros_like(bands), bands)
    begin = first.take(window) + band * columns
    end = begin + (right - left + 1).take(window)
    run, place = _expand_runs_numpy(starts.take(begin), starts.take(end))
    row, column = window.take(run), order.take(place)

    squared = x.take(column) - at_x.take(row)
    squared *= squared
    off_y = y.take(column) - at_y.take(row)
    off_y *= off_y
    squared += off_y
    near = np.flatnonzero(squared <= np.square(reach).take(row))
    return row.take(near), column.take(near)


def _expand_runs_numpy(starts: Array, ends: Array) -> tuple[Array, Array]:
    """`expand_runs` on the CPU."""
    counts = ends - starts
    run = np.repeat(np.arange(len(counts), dtype=np.int64), counts)
    return run, np.arange(len(run), dtype=np.int64) + (starts - (np.cumsum(counts) - counts)).take(run)


class _CellAxis(NamedTuple):
    """Columns or rows of cells: their size in pixels, and their number; the outer ones hold all that lies beyond."""

    size: float
    number: int

    @classmethod
    def of(cls, values: Array, min_size: float, max_number: int) -> _CellAxis:
        """Cells for coordinates (n,)."""
        extent = max(float(values.max()), 0.0)
        size = max(min_size, extent / max_number)
        return cls(size, min(int(extent / size) + 1, max_number))

    def cell_of(self, values: Array) -> Array:
        """The column or row of each coordinate."""
        found: Array = np.clip(np.floor(values * (1 / self.size)), 0, self.number - 1).astype(np.int64)
        return found


def _sorted_into_cells(
    x: Array, y: Array, mask: Array, across: _CellAxis, down: _CellAxis
) -> tuple[Array, Array]:
    """Keypoints (B N,) sorted by image and cell, and the first of each cell: (B rows columns + 1,)."""
    of_image = across.number * down.number
    cell = down.cell_of(y) * across.number + across.cell_of(x) + _first_cells(mask.shape, of_image)
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


def nearest_of_pairs(
    row: Array, column: Array, distance: Array, rows: int, scales: Array, ratio: float | None, limit: float
) -> tuple[Array, Array, Array]:
    """Choose one column for each row among candidate pairs by whole distances, each column at most once.

    As `best_per_row` and `one_to_one`, in a fraction of the time on the CPU. Rows are ascending, `limit` is the largest
    distance. Returns the column and the distance of each row, 0 where there is none, and whether there is one.
    """
    best_column, best_distance = np.zeros(rows, np.int64), np.zeros(rows, np.float32)
    mask = np.zeros(rows, bool)
    if len(row) == 0:
        return best_column, best_distance, mask
    is_first = np.empty(len(row), dtype=bool)
    is_first[0], is_first[1:] = True, row[1:] != row[:-1]
    starts = np.flatnonzero(is_first)
    columns = len(scales)
    # One number for distance and column: the least is the nearest; ties go to the lowest column.
    keys = distance * columns + column
    best = np.minimum.reduceat(keys, starts)
    nearest, chosen = np.divmod(best, columns)
    accepted = nearest <= limit
    if ratio is not None:
        counts = np.diff(starts, append=len(row))
        rival = np.abs(scales.take(column) / np.repeat(scales.take(chosen), counts) - 1) < SAME_SCALE
        rival &= keys != np.repeat(best, counts)
        second = np.minimum.reduceat(np.where(rival, distance, np.inf), starts)
        accepted &= nearest < ratio * second
    first, partner, nearest = (values[accepted] for values in (row.take(starts), chosen, nearest))
    # Likewise of the rows that share a column: the last one that is written stays.
    order = np.argsort(nearest * (row[-1] + 1) + first)[::-1]
    winner = np.full(columns, -1)
    winner[partner[order]] = order
    kept = winner.take(partner) == np.arange(len(partner))
    first = first[kept]
    best_column[first], best_distance[first], mask[first] = partner[kept], nearest[kept], True
    return best_column, best_distance, mask


PROJECTION_RATIO = 0.9
"""Largest ratio of the best to the second best distance near a prediction, where few other keypoints compete: as in
ORB-SLAM2's search by projection. Tried at this value only."""
SCALE_TOLERANCE = 1.5
"""Largest factor between the predicted and the found scale of a keypoint."""
_MAX_PIXEL = 1e6  # points projected farther outside of the image do not match


@without_autocast
def match_by_projection(
    descriptors: Shaped[Tensor, "B M D"],
    pixels: Float[Tensor, "B M 2"],
    radius: Float[Tensor, "B M"] | float,
    features: Features,
    mask: Bool[Tensor, "B M"] | None = None,
    scales: Float[Tensor, "B M"] | None = None,
    angles: Float[Tensor, "B M"] | None = None,
    ratio: float | None = PROJECTION_RATIO,
    max_distance: float | None = 64,
    scale_tolerance: float = SCALE_TOLERANCE,
    angle_tolerance: float = math.pi / 6,
) -> Matches:
    """Match points of known descriptors to the keypoints near their predicted pixels.

    Every keypoint is used at most once, by the point of lowest distance, then of lowest index.

    Args:
        descriptors: of the points, 32 uint8 or unit-length floats.
        pixels: predicted pixels.
        radius: of the search around the predicted pixels, pixels.
        features: keypoints to match.
        mask: points that may match; None: all.
        scales: predicted `Features.scales`; a keypoint's may differ by the factor `scale_tolerance`.
        angles: predicted angles in radians; a keypoint's may differ by `angle_tolerance`.
        ratio: the nearest must be closer than `ratio` times the nearest other keypoint of its scale in the window
            (keypoints of other levels mostly see the same corner); None: no ratio test.
        max_distance: Hamming bits, or 1 - cosine for floats; None: no limit.
        scale_tolerance: largest factor between a predicted and a found scale.
        angle_tolerance: largest difference of a predicted and a found angle, radians.

    Returns:
        Matches with M rows: row i is point i, `indices_2` its keypoint.

    Raises:
        ValueError: The descriptors differ in type or length, or are not of unit length.
    """
    check_positive(ratio=ratio, scale_tolerance=scale_tolerance, angle_tolerance=angle_tolerance)
    check_descriptors(descriptors, features.descriptors)
    batch, rows, columns = len(pixels), pixels.shape[1], features.keypoints.shape[1]
    if rows == 0 or columns == 0:
        return empty_matches(batch, rows, pixels.device)
    radius = torch.as_tensor(radius, dtype=pixels.dtype, device=pixels.device).expand(batch, rows)
    is_near = pixels.detach().abs().amax(-1) < _MAX_PIXEL  # false for NaN as well
    mask = is_near if mask is None else mask & is_near
    at = torch.where(mask[..., None], pixels.detach(), 0)
    around = torch.where(mask, radius.detach(), 0)
    row, column = pairs_within_radius(at, around, mask, features.keypoints.detach(), features.mask)

    keypoint_scales = features.scales.detach().flatten()
    if scales is not None:
        factor = keypoint_scales.index_select(0, column) / scales.detach().flatten().index_select(0, row)
        row, column = masked_rows((factor <= scale_tolerance) & (factor * scale_tolerance >= 1), row, column)
    if angles is not None:
        turn = features.angles.detach().flatten().index_select(
            0, column
        ) - angles.detach().flatten().index_select(0, row)
        row, column = masked_rows(torch.cos(turn) >= math.cos(angle_tolerance), row, column)

    pairs = descriptors.flatten(0, 1), row, features.descriptors.flatten(0, 1), column
    limit = math.inf if max_distance is None else max_distance
    if descriptors.dtype == torch.uint8 and row.is_cpu:
        candidates = row.numpy(), column.numpy(), hamming_between(*pairs).numpy()
        found = nearest_of_pairs(*candidates, batch * rows, keypoint_scales.numpy(), ratio, limit)
        best, distance, accepted = (torch.from_numpy(values).view(batch, rows) for values in found)
        return to_matches(best % columns, distance, accepted)
    distances = pair_distances(*pairs)
    best, accepted, distance = best_per_row(row, column, distances, keypoint_scales, batch * rows, ratio)
    accepted = accepted & (distance <= limit)
    best, distance, accepted = (values.view(batch, rows) for values in (best % columns, distance, accepted))
    return to_matches(best, distance, one_to_one(best, distance.detach(), accepted, columns))
