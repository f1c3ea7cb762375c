"""Which corners to keep: an even spread over the image at a budget per pyramid level."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import torch
from torch import Tensor

from torchslam.features.pyramid import Atlas


@dataclass(frozen=True)
class Grid:
    """Cells over every level of a pyramid, less a border where no keypoint may lie.

    table:   (rows * stride,) int32, the cell of each atlas pixel, -1 on the border and between levels
    floor:   (rows * stride,) uint8, the FAST score that a corner must exceed there; 255 where none may lie
    levels:  (cells,) int64, the level of each cell
    budgets: (levels,) int64, how many keypoints each level may give
    """

    table: Tensor
    floor: Tensor
    levels: Tensor
    budgets: Tensor


@lru_cache(maxsize=8)
def plan_grid(
    atlas: Atlas, num_keypoints: int, per_cell: int, border: int, threshold: int, device: torch.device
) -> Grid:
    """Budgets per level and square cells whose share of the budget is about `per_cell` keypoints.

    threshold: the FAST score that a corner must exceed.
    """
    table = torch.full((atlas.rows, atlas.stride), -1, dtype=torch.int32)
    budgets = _level_budgets(num_keypoints, atlas, border)
    levels: list[int] = []
    for level, ((h, w), (top, left)) in enumerate(zip(atlas.sizes, atlas.corners, strict=True)):
        inner_h, inner_w = h - 2 * border, w - 2 * border
        if budgets[level] == 0:
            continue
        cell = math.sqrt(inner_h * inner_w * per_cell / budgets[level])
        down, across = max(1, round(inner_h / cell)), max(1, round(inner_w / cell))
        row = torch.arange(inner_h) * down // inner_h
        column = torch.arange(inner_w) * across // inner_w
        cells = row[:, None] * across + column + len(levels)
        table[top + border : top + h - border, left + border : left + w - border] = cells.to(torch.int32)
        levels += [level] * (down * across)
    as_tensor = torch.tensor
    return Grid(
        table.flatten().to(device),
        torch.where(table.flatten() >= 0, threshold, 255).to(device=device, dtype=torch.uint8),
        as_tensor(levels, dtype=torch.int64, device=device),
        as_tensor(budgets, dtype=torch.int64, device=device),
    )


def _level_budgets(num_keypoints: int, atlas: Atlas, border: int) -> list[int]:
    """Keypoints per level in proportion to its width; levels with no room inside the border get none."""
    shares = [
        1 / x if min(size) > 2 * border else 0.0
        for (x, _), size in zip(atlas.scales, atlas.sizes, strict=True)
    ]
    total = sum(shares)
    if total == 0:
        return [0] * len(shares)
    edges = [round(num_keypoints * sum(shares[:k]) / total) for k in range(len(shares) + 1)]
    return [after - before for before, after in pairwise(edges)]


def true_indices(mask: Tensor) -> Tensor:
    """Positions where a flat boolean mask is true, ascending: eight entries are looked at together, as few are true."""
    whole = mask.shape[0] // 8 * 8
    words = mask[:whole].view(torch.int64).nonzero().squeeze(1)
    hits = mask[:whole].view(-1, 8).index_select(0, words).nonzero()
    tail = mask[whole:].nonzero().squeeze(1) + whole
    return torch.cat([words[hits[:, 0]] * 8 + hits[:, 1], tail])


def order_by(*keys: Tensor) -> Tensor:
    """Indices that sort rows by the first key, ties by the second, and so on; ascending and stable."""
    order = torch.argsort(keys[-1], stable=True)
    for key in reversed(keys[:-1]):
        order = order[torch.argsort(key[order], stable=True)]
    return order


def ranks_within(groups: Tensor, order: Tensor, num_groups: int) -> Tensor:
    """Place of each row among the rows of its group, from 0, when taken in `order`, which must be sorted by group."""
    sizes = torch.bincount(groups, minlength=num_groups)
    starts = sizes.cumsum(0) - sizes
    ranks = torch.empty_like(order)
    ranks[order] = torch.arange(order.shape[0], device=order.device) - starts[groups[order]]
    return ranks


def best_per_cell(cells: Tensor, scores: Tensor, count: int, num_cells: int) -> Tensor:
    """Rows that are among the `count` best of their cell: (N,) int64, (N,) uint8 -> (K,) int64, ascending."""
    order = torch.argsort(cells * 256 + (255 - scores.to(torch.int64)), stable=True)
    return (ranks_within(cells, order, num_cells) < count).nonzero().squeeze(1)


def spread(
    scores: Tensor,
    strong: Tensor,
    cells: Tensor,
    images: Tensor,
    grid: Grid,
    per_cell: int,
    num_images: int,
    count: int,
) -> tuple[Tensor, Tensor]:
    """Choose up to `count` corners per image: the best `per_cell` of every cell first, then the strongest elsewhere.

    scores: (N,) higher is better; strong: (N,) bool, whether a corner may be chosen beyond its cell's first ones;
    cells: (N,) cell within its image; images: (N,) its image. Every level first takes its budget; what levels leave
    unused goes to the best remaining corners of any level.
    Returns the chosen rows (K,) and the place (K,) of each in its image's list, 0 ... count - 1, by falling score.
    """
    num_cells, num_levels = grid.levels.shape[0], grid.budgets.shape[0]
    image_cells = images * num_cells + cells
    order = order_by(image_cells, -scores)
    extra = ranks_within(image_cells, order, num_images * num_cells) >= per_cell
    rows = (strong | ~extra).nonzero().squeeze(1)
    scores, extra, images, levels = scores[rows], extra[rows], images[rows], grid.levels[cells[rows]]

    groups = images * num_levels + levels
    order = order_by(groups * 2 + extra, -scores)
    over_budget = ranks_within(groups, order, num_images * num_levels) >= grid.budgets[levels]
    order = order_by(images * 2 + over_budget, -scores)
    chosen = ranks_within(images, order, num_images) < count
    rows, images, scores = rows[chosen], images[chosen], scores[chosen]
    return rows, ranks_within(images, order_by(images, -scores), num_images)
