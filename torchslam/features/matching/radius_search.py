"""Keypoints within a radius of where they are expected, and who of them is the nearest by its bits."""

from __future__ import annotations

import torch
from torch import Tensor

from torchslam.features.matching.radius_search_numpy import (
    expand_runs_on_host,
    nearest_bits_on_host,
    window_pairs_on_host,
)

SAME_SCALE = 0.05
"""Share by which two scales of one level may differ."""
_BAND = 32.0  # pixels: height of the bands of keypoints that a window search looks through
# Pixels from one band to the next, and from one image to the next, where keypoints stand in one row. Far more than
# images have; where a window is wider, it takes in what is out of its radius, which is then left out.
_WIDTH, _IMAGE = 2.0**20, 2.0**36


def window_pairs(
    pixels: Tensor, radius: Tensor, mask: Tensor, keypoints: Tensor, keypoint_mask: Tensor
) -> tuple[Tensor, Tensor]:
    """All pairs of a place and a keypoint within its radius: flat rows b * M + i, ascending, and columns b * N + j.

    pixels: (B, M, 2) finite, at least one; radius, mask: (B, M); keypoints, keypoint_mask: (B, N, 2), (B, N)

    Keypoints are sorted by band of _BAND rows, then by x: what a window takes of a band is one run in that order. The
    CPU has a quicker way (`host_windows`). The columns of a row come in any order.
    """
    if keypoints.is_cpu:
        inputs = pixels.double(), radius.double(), mask, keypoints.double(), keypoint_mask
        found = window_pairs_on_host(*(tensor.detach().numpy() for tensor in inputs))
        return torch.from_numpy(found[0]), torch.from_numpy(found[1])
    x, y = keypoints.double().unbind(-1)
    at_x, at_y = pixels.double().unbind(-1)
    low, high = torch.floor((at_y - radius) / _BAND), torch.floor((at_y + radius) / _BAND)
    spans = int((high - low).amax()) + 1
    bands = low[..., None] + torch.arange(spans, device=low.device)
    places, starts = torch.floor(y / _BAND) * _WIDTH + x, bands * _WIDTH
    if len(mask) > 1:
        image = torch.arange(len(mask), device=mask.device)[:, None] * _IMAGE
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


def expand_runs(starts: Tensor, ends: Tensor) -> tuple[Tensor, Tensor]:
    """The numbers of runs starts (n,) ... ends (n,) - 1: of which run each is, and the number."""
    if starts.is_cpu:
        found = expand_runs_on_host(starts.numpy(), ends.numpy())
        return torch.from_numpy(found[0]), torch.from_numpy(found[1])
    counts = ends - starts
    run = torch.repeat_interleave(counts)
    shift = starts - (counts.cumsum(0) - counts)
    return run, torch.arange(run.shape[0], device=run.device) + shift.index_select(0, run)


def nearest_bits(
    row: Tensor,
    column: Tensor,
    distance: Tensor,
    rows: int,
    scales: Tensor,
    ratio: float | None,
    limit: int | float,
) -> tuple[Tensor, Tensor, Tensor]:
    """Rows (m,), ascending, each with its nearest column (m,), and their distances (m,): no column twice.

    row, column, distance: (P,) pairs of `rows` rows, ascending, and of columns that have scales (N,), and their int64
              distances
    ratio:    to the nearest other column of the scale of the nearest, which must be farther by so much; None: no test
    limit:    largest distance, finite

    Of equal distances the lower column wins, and of rows that share a column the nearest, then the lowest.
    """
    if row.is_cpu:
        pairs = row.numpy(), column.numpy(), distance.numpy()
        found = nearest_bits_on_host(*pairs, scales.detach().numpy(), ratio, limit, SAME_SCALE)
        return torch.from_numpy(found[0]), torch.from_numpy(found[1]), torch.from_numpy(found[2]).float()
    columns = len(scales)
    # One number for distance and column: the least is the nearest, of equals that of the lowest column.
    keys = distance * columns + column
    unset = (int(limit) + 1) * columns
    best = row.new_full((rows,), unset).scatter_reduce_(0, row, keys, "amin")
    nearest, chosen = torch.div(best, columns, rounding_mode="floor"), best % columns
    accepted = nearest <= limit
    if ratio is not None:
        of_nearest = scales.index_select(0, chosen).index_select(0, row)
        rival = (scales.index_select(0, column) / of_nearest - 1).abs_() < SAME_SCALE
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
