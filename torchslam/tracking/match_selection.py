"""Selection and weighting of matches for pose estimation: mature points first, spread evenly over the image.

A textured moving object may have most of the matches, but it covers few image cells and its points are short-lived.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchslam.map.map import Map
from torchslam.tracking.correspondences import Projected
from torchslam.types import FrameFeatures
from torchslam.utils.indexing import is_among

GRID = (8, 6)  # columns and rows of the image cells
MAX_MATCHES_PER_CELL = 5  # that RANSAC samples from
MAX_CELL_WEIGHT = 8  # sum of the weights of the matches in a cell, at most
MIN_COVERAGE_CELLS = 5  # cells with mature points for which a coverage ratio is computed
MATURE_OBSERVATIONS = 10  # frames with certain poses that found a point, from which on it is mature


def image_cells(
    pixels: Tensor,
    size: tuple[float, float],
    grid: tuple[int, int] = GRID,
    shape: tuple[int, int] | None = None,
) -> tuple[Tensor, Tensor]:
    """Columns and rows of the image cells that contain pixels.

    Args:
        pixels: (n, 2)
        size: width and height that are divided into `grid` columns and rows of cells
        shape: columns and rows to which the result is clamped; those of `grid` if None

    Returns:
        Two int64 tensors (n,).
    """
    column, row = (
        (at / extent * count).clamp_(0, limit - 1).long()
        for at, extent, count, limit in zip(pixels.unbind(-1), size, grid, shape or grid, strict=True)
    )
    return column, row


def cell_numbers(pixels: Tensor, size: tuple[int, int]) -> Tensor:
    """(n,) int64 numbers of the cells of `GRID` that contain pixels (n, 2)."""
    column, row = image_cells(pixels, size)
    return row * GRID[0] + column


def select_mature(times_found: Tensor, least: int) -> Tensor:
    """(m,) rows of the matches (n,) with mature points; all rows if these are fewer than `least`."""
    old = torch.nonzero(times_found >= MATURE_OBSERVATIONS)[:, 0]
    return old if len(old) >= least else torch.arange(len(times_found), device=times_found.device)


def subsample_per_cell(pixels: Tensor, size: tuple[int, int]) -> Tensor:
    """(m,) ascending rows of pixels (n, 2), at most `MAX_MATCHES_PER_CELL` of each image cell."""
    cell = cell_numbers(pixels, size)
    order = torch.argsort(cell, stable=True)
    ordered = cell[order]
    counts = torch.bincount(ordered, minlength=GRID[0] * GRID[1])
    rank = torch.arange(len(ordered), device=cell.device) - (counts.cumsum(0) - counts)[ordered]
    return torch.sort(order[rank < MAX_MATCHES_PER_CELL]).values


def grid_weights(pixels: Tensor, size: tuple[int, int]) -> Tensor:
    """(n,) weights of matches at pixels (n, 2) that limit the total weight of a crowded image cell."""
    cell = cell_numbers(pixels, size)
    crowd = torch.bincount(cell, minlength=GRID[0] * GRID[1])[cell]
    return (MAX_CELL_WEIGHT / crowd).clamp(max=1.0)


def explained_ratio(view: FrameFeatures, keypoints: Tensor, size: tuple[int, int]) -> float:
    """Ratio of the image cells with several keypoints that contain at least one of `keypoints` (m,), the inliers."""
    count = GRID[0] * GRID[1]
    occupied = torch.bincount(cell_numbers(view.keypoints[view.mask], size), minlength=count) >= 2
    used = torch.bincount(cell_numbers(view.keypoints[keypoints], size), minlength=count) > 0
    return float(used[occupied].double().mean()) if bool(occupied.any()) else 1.0


def coverage_ratio(slam_map: Map, expected: Projected, seen: Tensor, size: tuple[int, int]) -> float:
    """Ratio of the image cells with several expected mature points in which at least a fifth of them are inliers.

    Args:
        expected: points predicted to be in the image
        seen: (m,) ids of the inliers

    Returns:
        The ratio; 1 if there are fewer than `MIN_COVERAGE_CELLS` such cells.
    """
    old = slam_map.points["times_found"][expected.ids] >= MATURE_OBSERVATIONS
    cell = cell_numbers(expected.pixels[old], size)
    count = GRID[0] * GRID[1]
    predicted = torch.bincount(cell, minlength=count)
    found = torch.bincount(cell[is_among(expected.ids[old], seen)], minlength=count)
    counted = predicted >= 2
    if int(counted.sum()) < MIN_COVERAGE_CELLS:
        return 1.0
    return float((5 * found >= predicted)[counted].double().mean())
