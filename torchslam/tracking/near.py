"""Binary descriptors matched near predictions, for every frame of a run: `features.match_projected` in half of the
calls, with the same answers."""

from __future__ import annotations

import torch
from torch import Tensor

from torchslam.features.bits import hamming_pairs
from torchslam.features.matching import expand_runs
from torchslam.values import View

_BAND = 32.0  # pixels: height of the bands of keypoints that a window search looks through
_WIDTH = 2.0**20  # pixels between two bands where keypoints stand in one row: no image is wider
_SCALE_TOLERANCE = 1.5  # as of `match_projected`
_SAME_SCALE = 0.05


def match_within(
    expected: View, view: View, radius: Tensor, ratio: float | None, max_distance: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Rows (m,), ascending, of expected keypoints and of a view's that match, nearest descriptors within a radius, and
    their distances (m,), bits.

    expected: keypoints, scales and descriptors (M, 32) uint8 as they should appear in the view; radius: (M,) pixels
    ratio, max_distance: as of `match_projected`
    """
    rows, columns, bits = len(expected.mask), len(view.mask), 8 * view.descriptors.shape[-1]
    if rows == 0 or columns == 0:
        return (nobody := torch.zeros(0, dtype=torch.int64, device=radius.device)), nobody, nobody.float()
    row, column = _in_windows(expected, view, radius)
    factor = view.scales.index_select(0, column) / expected.scales.index_select(0, row)
    alike = torch.nonzero((factor <= _SCALE_TOLERANCE) & (factor * _SCALE_TOLERANCE >= 1))[:, 0]
    row, column = row.index_select(0, alike), column.index_select(0, alike)
    distance = hamming_pairs(
        expected.descriptors.index_select(0, row), view.descriptors.index_select(0, column)
    )
    # One number for distance and column: the least is the nearest, of equals that of the lowest column.
    keys = distance * len(view.mask) + column
    unset = (bits + 1) * columns
    best = row.new_full((rows,), unset).scatter_reduce_(0, row, keys, "amin")
    nearest, chosen = torch.div(best, columns, rounding_mode="floor"), best % columns
    accepted = nearest <= min(max_distance, bits)
    if ratio is not None:
        best_scale = view.scales.index_select(0, chosen).index_select(0, row)
        rival = (view.scales.index_select(0, column) / best_scale - 1).abs_() < _SAME_SCALE
        rival &= keys != best.index_select(0, row)
        others = torch.where(rival, distance.float(), torch.inf)
        second = others.new_full((rows,), torch.inf).scatter_reduce_(0, row, others, "amin")
        accepted &= nearest < ratio * second
    first = torch.nonzero(accepted)[:, 0]
    partner = chosen.index_select(0, first)
    # Likewise of the rows that share a column.
    keys = nearest.index_select(0, first) * rows + first
    least = keys.new_full((columns,), unset * rows).scatter_reduce_(0, partner, keys, "amin")
    kept = torch.nonzero(least.index_select(0, partner) == keys)[:, 0]
    first = first.index_select(0, kept)
    return first, partner.index_select(0, kept), nearest.index_select(0, first).float()


def _in_windows(expected: View, view: View, radius: Tensor) -> tuple[Tensor, Tensor]:
    """Rows, ascending, and columns of all pairs of an expected keypoint and one of a view within its radius.

    The view's keypoints are sorted by band, then by x: what a window takes of a band is one run in that order.
    """
    x, y = view.keypoints.unbind(1)
    order = (torch.floor(y / _BAND) * _WIDTH + x).masked_fill_(~view.mask, torch.inf)
    keys, order = order.sort(stable=True)
    at_x, at_y = expected.keypoints.unbind(1)
    low, high = torch.floor((at_y - radius) / _BAND), torch.floor((at_y + radius) / _BAND)
    spans = int((high - low).amax()) + 1
    bands = low[:, None] + torch.arange(spans, device=low.device)
    starts = bands * _WIDTH
    left = torch.searchsorted(keys, starts + (at_x - radius)[:, None])
    right = torch.searchsorted(keys, starts + (at_x + radius)[:, None], right=True)
    right = torch.where((bands <= high[:, None]) & expected.mask[:, None], right, left)
    run, place = expand_runs(left.flatten(), right.flatten())
    row, column = torch.div(run, spans, rounding_mode="floor"), order.index_select(0, place)
    off = view.keypoints.index_select(0, column).sub_(expected.keypoints.index_select(0, row))
    near = torch.nonzero(off.square_().sum(1) <= radius.square().index_select(0, row))[:, 0]
    return row.index_select(0, near), column.index_select(0, near)
