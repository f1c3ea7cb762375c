"""Who has a voice in a pose: points of age, and all parts of the image alike.

A thing with much texture that moves before a scene with little has most of the matches. It has not most of the image,
and its points do not grow old.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchslam.map.map import Map
from torchslam.tracking.correspondences import Projected
from torchslam.types import FrameFeatures
from torchslam.utils.indexing import is_among

CELLS = (8, 6)  # the image as a grid, for what should be spread over it
MAX_MATCHES_PER_CELL = 5  # matches of a cell that RANSAC hears
MAX_CELL_WEIGHT = 8  # matches of a cell that count in full
MIN_COVERAGE_CELLS = 5  # cells that old points are expected in, before it says anything that they are missing
MATURE_OBSERVATIONS = 10  # certain frames that found a point, before RANSAC hears it and its like alone


def cells(pixels: Tensor, size: tuple[int, int]) -> Tensor:
    """(n,) int64 number of the cell of the image that pixels (n, 2) lie in."""
    column, row = (
        (at / extent * count).clamp_(0, count - 1).long()
        for at, extent, count in zip(pixels.unbind(-1), size, CELLS, strict=True)
    )
    return row * CELLS[0] + column


def select_mature(times_found: Tensor, least: int) -> Tensor:
    """(m,) rows of matches (n,) with points that many frames have found; all where they are fewer than `least`.

    What moves by itself agrees with the scene for a while at most: its points do not grow old.
    """
    old = torch.nonzero(times_found >= MATURE_OBSERVATIONS)[:, 0]
    return old if len(old) >= least else torch.arange(len(times_found), device=times_found.device)


def subsample_per_cell(pixels: Tensor, size: tuple[int, int]) -> Tensor:
    """(m,) rows of pixels (n, 2), a few of each cell of the image: each cell has a voice.

    Where one thing with much texture moves before a scene with little, most matches are its.
    """
    order, rank = _ranks(pixels, size)
    return torch.sort(order[rank < MAX_MATCHES_PER_CELL]).values


def evenly(pixels: Tensor, size: tuple[int, int], count: int) -> Tensor:
    """(m,) `count` rows of pixels (n, 2), all if there are fewer: as many of each cell of the image, if it can."""
    order, rank = _ranks(pixels, size)
    return torch.sort(order[torch.sort(rank, stable=True).indices[:count]]).values


def _ranks(pixels: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """(n,) rows of pixels (n, 2), cell of the image by cell, and (n,) the how many-th of its cell each is."""
    cell = cells(pixels, size)
    order = torch.argsort(cell, stable=True)
    ordered = cell[order]
    counts = torch.bincount(ordered, minlength=CELLS[0] * CELLS[1])
    return order, torch.arange(len(ordered), device=cell.device) - (counts.cumsum(0) - counts)[ordered]


def grid_weights(pixels: Tensor, size: tuple[int, int]) -> Tensor:
    """(n,) what each of the pixels (n, 2) counts, so that a crowded cell of the image does not outvote the others."""
    cell = cells(pixels, size)
    crowd = torch.bincount(cell, minlength=CELLS[0] * CELLS[1])[cell]
    return (MAX_CELL_WEIGHT / crowd).clamp(max=1.0)


def explained_ratio(view: FrameFeatures, keypoints: Tensor, size: tuple[int, int]) -> float:
    """The share of the image's cells with several keypoints in which at least one of keypoints (m,) lies."""
    count = CELLS[0] * CELLS[1]
    there = torch.bincount(cells(view.keypoints[view.mask], size), minlength=count) >= 2
    used = torch.bincount(cells(view.keypoints[keypoints], size), minlength=count) > 0
    return float(used[there].double().mean()) if bool(there.any()) else 1.0


def coverage_ratio(slam_map: Map, expected: Projected, seen: Tensor, size: tuple[int, int]) -> float:
    """The share of the image's cells in which several old points were expected that has at least a fifth of them.

    1 where these cells are too few to tell anything.

    expected: points that should be in the image; seen: (m,) those of them that are where they should be
    """
    old = slam_map.points["times_found"][expected.ids] >= MATURE_OBSERVATIONS
    cell = cells(expected.pixels[old], size)
    count = CELLS[0] * CELLS[1]
    wanted = torch.bincount(cell, minlength=count)
    found = torch.bincount(cell[is_among(expected.ids[old], seen)], minlength=count)
    asked = wanted >= 2
    if int(asked.sum()) < MIN_COVERAGE_CELLS:
        return 1.0
    return float((5 * found >= wanted)[asked].double().mean())
