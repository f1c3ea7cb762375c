"""The image pyramid, packed in one rectangle so that every dense step is one operation for all levels.

All levels of an image lie in one rectangle with a common row stride. In the flattened rectangle the neighbor
(dx, dy) of pixel p is p + dy * stride + dx, on every level alike. Neighborhoods reach over a level's edge into
another level; keypoints keep a border from the edge, so these values are never used.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int, UInt8
from torch import Tensor

MIN_SIDE = 40  # of a packed pyramid, so that every neighborhood fits whatever the image


@dataclass(frozen=True)
class PackedPyramid:
    """Layout of the levels of a pyramid in one rectangle of `rows` times `stride` pixels."""

    sizes: tuple[tuple[int, int], ...]  # (height, width) of each level
    corners: tuple[tuple[int, int], ...]  # (top, left)
    scales: tuple[tuple[float, float], ...]  # full-resolution pixels (x, y) per pixel
    rows: int
    stride: int


@lru_cache(maxsize=32)
def plan_pyramid(height: int, width: int, scale_factor: float, num_levels: int) -> PackedPyramid:
    """Compute sizes and places of the levels: each goes on the first shelf with room, or opens a new one."""
    sizes = [
        (max(1, round(height / scale_factor**k)), max(1, round(width / scale_factor**k)))
        for k in range(num_levels)
    ]
    corners: list[tuple[int, int]] = []
    shelves: list[list[int]] = []  # [top, height, used width]
    bottom = 0
    for h, w in sizes:
        shelf = next((s for s in shelves if s[1] >= h and s[2] + w <= width), None)
        if shelf is None:
            shelf = [bottom, h, 0]
            shelves.append(shelf)
            bottom += h
        corners.append((shelf[0], shelf[2]))
        shelf[2] += w
    scales = tuple((width / w, height / h) for h, w in sizes)
    return PackedPyramid(tuple(sizes), tuple(corners), scales, max(bottom, MIN_SIDE), max(width, MIN_SIDE))


def build_levels(images: Float[Tensor, "B 1 H W"], pyramid: PackedPyramid) -> list[Float[Tensor, "B 1 _ _"]]:
    """Build the pyramid of images in [0, 1]: each level is resized bilinearly from the one before.

    Returns:
        Gray values of 0 to 255, plus a half, so that truncation rounds.
    """
    levels = [(images * 255).add_(0.5)]
    for size in pyramid.sizes[1:]:
        levels.append(F.interpolate(levels[-1], size=size, mode="bilinear", align_corners=False))
    return levels


def pack_levels(
    levels: list[Float[Tensor, "B 1 _ _"]], pyramid: PackedPyramid
) -> UInt8[Tensor, "B {pyramid.rows} {pyramid.stride}"]:
    """Truncate levels to bytes and put them at their places."""
    filled = torch.zeros(
        levels[0].shape[0], pyramid.rows, pyramid.stride, dtype=torch.uint8, device=levels[0].device
    )
    for level, (top, left), (h, w) in zip(levels, pyramid.corners, pyramid.sizes, strict=True):
        # Through int16: torch converts float to int16 and int16 to bytes with vector instructions.
        filled[:, top : top + h, left : left + w] = level[:, 0].to(torch.int16)
    return filled


def gather_level_patches(
    levels: list[Float[Tensor, "B 1 _ _"]],
    images: Int[Tensor, " N"],
    level: Int[Tensor, " N"],
    xy: Int[Tensor, "N 2"],
    radius: int,
) -> Float[Tensor, "N S S"]:
    """Gather patches around keypoints on their own levels of `build_levels`, with gradients to these.

    The keypoints lie `radius` pixels of their level inside; the side of a patch is 2 radius + 1 pixels.
    """
    device = xy.device
    heights, widths = (torch.tensor([lv.shape[d] for lv in levels], device=device) for d in (-2, -1))
    areas = heights * widths * levels[0].shape[0]
    starts = areas.cumsum(0) - areas
    flat = torch.cat([lv.reshape(-1) for lv in levels])
    centers = starts[level] + (images * heights[level] + xy[:, 1]) * widths[level] + xy[:, 0]
    axis = torch.arange(-radius, radius + 1, device=device)
    rows = centers[:, None] + widths[level][:, None] * axis
    return flat[rows[:, :, None] + axis]
