"""Selection of corners: an even spread over the image at a budget per pyramid level."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, Shaped, UInt8
from torch import Tensor

from torchslam.features.pyramid import PackedPyramid


@dataclass(frozen=True)
class Grid:
    """Cells over every level of a pyramid, less a border where no keypoint may lie."""

    table: Int[
        Tensor, " A"
    ]  # the cell of each pixel of the packed pyramid, -1 on the border and between levels
    floor: UInt8[Tensor, " A"]  # the FAST score that a corner must exceed there; 255 where none may lie
    rows: tuple[
        tuple[int, int], ...
    ]  # of the pyramid, runs (first, last + 1) of those in which there are cells
    levels: Int[Tensor, " N"]  # the level of each cell
    budgets: Int[Tensor, " L"]  # largest number of keypoints of each level


@lru_cache(maxsize=8)
def plan_grid(
    pyramid: PackedPyramid,
    num_keypoints: int,
    per_cell: int,
    border: int,
    threshold: int,
    device: torch.device,
) -> Grid:
    """Divide the levels into square cells of about `per_cell` keypoints, and the keypoints between the levels.

    No keypoint lies in the `border`, in pixels, of a level; `threshold` is the FAST score that a corner must exceed.
    """
    table = torch.full((pyramid.rows, pyramid.stride), -1, dtype=torch.int32, device="cpu")
    budgets = _level_budgets(num_keypoints, pyramid, border)
    levels: list[int] = []
    for level, ((h, w), (top, left)) in enumerate(zip(pyramid.sizes, pyramid.corners, strict=True)):
        inner_h, inner_w = h - 2 * border, w - 2 * border
        if budgets[level] == 0:
            continue
        cell = math.sqrt(inner_h * inner_w * per_cell / budgets[level])
        down, across = max(1, round(inner_h / cell)), max(1, round(inner_w / cell))
        row = torch.arange(inner_h, device="cpu") * down // inner_h
        column = torch.arange(inner_w, device="cpu") * across // inner_w
        cells = row[:, None] * across + column + len(levels)
        table[top + border : top + h - border, left + border : left + w - border] = cells.to(torch.int32)
        levels += [level] * (down * across)
    edges = F.pad((table >= 0).any(1).to(torch.int8), (1, 1)).diff().nonzero()[:, 0].tolist()
    return Grid(
        table.flatten().to(device),
        torch.where(table.flatten() >= 0, threshold, 255).to(device=device, dtype=torch.uint8),
        tuple(zip(edges[::2], edges[1::2], strict=True)),
        torch.tensor(levels, dtype=torch.int64, device=device),
        torch.tensor(budgets, dtype=torch.int64, device=device),
    )


def _level_budgets(num_keypoints: int, pyramid: PackedPyramid, border: int) -> list[int]:
    """Keypoints per level in proportion to its width; levels with no room inside the border get none."""
    shares = [
        1 / x if min(size) > 2 * border else 0.0
        for (x, _), size in zip(pyramid.scales, pyramid.sizes, strict=True)
    ]
    total = sum(shares)
    if total == 0:
        return [0] * len(shares)
    edges = [round(num_keypoints * sum(shares[:k]) / total) for k in range(len(shares) + 1)]
    return [after - before for before, after in pairwise(edges)]


def ranks_within(groups: Int[Tensor, " N"], num_groups: int) -> Int[Tensor, " N"]:
    """Number the rows of each group from 0, in the order of the rows."""
    order = torch.argsort(groups, stable=True)
    sizes = torch.bincount(groups, minlength=num_groups)
    starts = sizes.cumsum(0) - sizes
    ranks = torch.empty_like(order)
    inside = starts.index_select(0, groups.index_select(0, order))
    ranks[order] = torch.arange(order.shape[0], device=order.device) - inside
    return ranks


def best_per_cell(
    cells: Int[Tensor, " N"], scores: Shaped[Tensor, " N"], num_cells: int
) -> Bool[Tensor, " N"]:
    """Test whether a row has the highest score of its cell."""
    best = scores.new_zeros(num_cells).scatter_reduce(0, cells, scores, "amax")
    return scores == best.index_select(0, cells)


def prefilter_candidates(
    scores: UInt8[Tensor, " N"],
    candidates: Bool[Tensor, " N"],
    cells: Int[Tensor, " N"],
    images: Int[Tensor, " N"],
    grid: Grid,
    num_images: int,
    count: int,
) -> Bool[Tensor, " N"]:
    """Find corners that `select_evenly` may choose besides the best of the cells: far fewer than all, without a sort.

    A level takes at most its budget and all that other levels leave: a corner with as many stronger ones on its level
    is never chosen. Arguments as for `select_evenly`; scores are whole parts of the scores there.
    """
    num_levels = grid.budgets.shape[0]
    group = images * num_levels + grid.levels.index_select(0, cells)
    values = group * 256 + scores
    weights = candidates.to(torch.float32)
    histogram = torch.bincount(values, weights, minlength=num_images * num_levels * 256).view(
        -1, num_levels, 256
    )
    from_top = histogram.flip(-1).cumsum(-1).flip(-1)  # how many have this score or a higher one
    left = (count - torch.minimum(from_top[:, :, 0], grid.budgets).sum(1, keepdim=True)).clamp_min(0)
    stronger = F.pad(from_top[:, :, 1:], (0, 1))
    return (stronger < (grid.budgets + left)[:, :, None]).view(-1).index_select(0, values)


def select_evenly(
    scores: Float[Tensor, " N"],
    strong: Bool[Tensor, " N"],
    cells: Int[Tensor, " N"],
    images: Int[Tensor, " N"],
    grid: Grid,
    num_images: int,
    count: int,
) -> tuple[Int[Tensor, " R"], Int[Tensor, " R"]]:
    """Choose up to `count` corners per image: the best of every cell first, then the strongest elsewhere.

    Every level first takes its budget; what levels leave unused goes to the best remaining corners of any level. Only
    corners that are `strong` may be chosen besides the best of their cell. Cells are numbered within their images.

    Returns the chosen rows, and the place of each in its image's list, 0 ... count - 1, by falling score.
    """
    num_cells, num_levels = grid.levels.shape[0], grid.budgets.shape[0]
    rows = _falling(scores)  # every rank below follows this order
    cells, images, strong = (values.index_select(0, rows) for values in (cells, images, strong))
    groups, numbers = images * num_cells + cells, torch.arange(len(rows), device=rows.device)
    first = numbers.new_full((num_images * num_cells,), len(rows)).scatter_reduce(0, groups, numbers, "amin")
    extra = numbers != first.index_select(0, groups)  # not the best of its cell

    kept = (strong | ~extra).nonzero().squeeze(1)
    rows, extra, images, cells = (values.index_select(0, kept) for values in (rows, extra, images, cells))
    levels = grid.levels.index_select(0, cells)
    # A level counts its cells' best first, then the others; so does an image with what the levels' budgets hold.
    within_level = _ranks_in_turn(images * num_levels + levels, extra, num_images * num_levels)
    beyond = within_level >= grid.budgets.index_select(0, levels)
    chosen = (_ranks_in_turn(images, beyond, num_images) < count).nonzero().squeeze(1)
    return rows.index_select(0, chosen), ranks_within(images.index_select(0, chosen), num_images)


def _falling(scores: Float[Tensor, " N"]) -> Int[Tensor, " N"]:
    """Rows of scores from the highest down, equal ones in the order of the rows."""
    if scores.dtype != torch.float32:
        return torch.argsort(scores, descending=True, stable=True)
    # The bits of floats are in the order of whole numbers, which are sorted several times as fast.
    bits = (scores + 0.0).view(torch.int32)  # -0 as 0
    return torch.argsort(~torch.where(bits < 0, bits ^ 0x7FFFFFFF, bits), stable=True)


def _ranks_in_turn(groups: Tensor, second: Tensor, num_groups: int) -> Tensor:
    """Place of each row within its group if all rows that are not `second` come first."""
    ranks = ranks_within(groups * 2 + second, num_groups * 2)
    firsts = torch.bincount(groups[~second], minlength=num_groups)
    return ranks + firsts.index_select(0, groups) * second
