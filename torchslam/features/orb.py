"""ORB in tensor operations: FAST corners on a pyramid, ranked by Harris, oriented, described by rotated BRIEF.

The steps follow Rublee, Rabaud, Konolige, Bradski: ORB, an efficient alternative to SIFT or SURF (ICCV 2011).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from torchslam.features.brief import blur, describe, orientations
from torchslam.features.corners import gather_patches, harris_responses, quadratic_peak, soft_peak
from torchslam.features.fast import fast_scores, patch_scores, suppress_non_maxima
from torchslam.features.pyramid import Atlas, build_levels, fill_atlas, gather_level_patches, plan_atlas
from torchslam.features.selection import Grid, best_per_cell, plan_grid, spread, true_indices
from torchslam.types import Features

BORDER = 19  # of every level: the descriptor's disk (15), its blur (3), and one for rounding
HARRIS_RADIUS = 4  # of the patch that one response needs
FAST_RADIUS = 3  # of the circle
HARRIS_UNIT = (
    49.0 * (8 * 255) ** 2
) ** -2  # makes responses those of mean squared derivatives of [0, 1] images
SOFT_RADIUS = 2
CANDIDATES = 4  # per cell, how many times the keypoints wanted there are ranked by Harris


@dataclass(frozen=True)
class Corners:
    """The chosen corners of a batch of images, K in all, and the pyramid they were found in.

    levels: (B, 1, h, w) floats per level; pixels: (B * rows * stride,) uint8, the flattened atlases
    positions: (K,) int64 into pixels; slots: (K,) int64, row in the flattened (B, num_keypoints) table
    image, level: (K,) int64; xy: (K, 2) int64, pixels of the level
    harris: (K,) float32 responses, for pixels of 0 to 255; fast: (K, 3, 3) uint8, FAST scores around each corner
    """

    levels: list[Tensor]
    pixels: Tensor
    atlas: Atlas
    positions: Tensor
    slots: Tensor
    image: Tensor
    level: Tensor
    xy: Tensor
    harris: Tensor
    fast: Tensor


class ORB(nn.Module):
    """Oriented FAST corners with 256-bit descriptors, for batches of images on any device.

    num_keypoints:  keypoints per image, at most; rows beyond what the image offers are masked
    scale_factor:   ratio of the sizes of neighbouring pyramid levels
    num_levels:     of the pyramid; levels too small to hold a keypoint stay empty
    threshold:      of FAST, in grey values of 0 to 255, for corners anywhere
    low_threshold:  for the best corners of each cell, so that regions of little contrast have keypoints too
    differentiable: keypoints and scores carry gradients to the image (soft arg-max over 5x5 FAST scores); what is
                    chosen, angles and descriptors stay discrete
    """

    def __init__(
        self,
        num_keypoints: int = 1000,
        scale_factor: float = 1.2,
        num_levels: int = 8,
        threshold: int = 20,
        low_threshold: int = 7,
        differentiable: bool = False,
    ) -> None:
        super().__init__()
        if num_keypoints < 1 or num_levels < 1 or scale_factor <= 1:
            raise ValueError("ORB needs num_keypoints >= 1, num_levels >= 1 and scale_factor > 1")
        if not 0 < low_threshold <= threshold < 256:
            raise ValueError("ORB needs 0 < low_threshold <= threshold < 256")
        self.num_keypoints = num_keypoints
        self.scale_factor = scale_factor
        self.num_levels = num_levels
        self.threshold = threshold
        self.low_threshold = low_threshold
        self.differentiable = differentiable
        self.per_cell = 4
        self.guaranteed_per_cell = 2

    def forward(self, images: Tensor) -> Features:
        """Detect and describe: (B, 1, H, W) floats in [0, 1] -> Features with N = num_keypoints rows.

        Raises ValueError for another shape or type. Rows are in order of falling Harris score, masked ones last.
        """
        check_images(images)
        corners = self.detect(images)
        stride = corners.atlas.stride
        angles = orientations(corners.pixels, corners.positions, stride)
        descriptors = describe(blur(corners.pixels, stride), corners.positions, angles, stride)
        offsets, scores = self._refine(corners)
        scale_xy = torch.tensor(corners.atlas.scales, dtype=images.dtype, device=images.device)[corners.level]
        keypoints = (corners.xy + offsets.to(images.dtype) + 0.5) * scale_xy - 0.5
        scales = self.scale_factor ** corners.level.to(images.dtype)

        def table(values: Tensor, fill: int = 0) -> Tensor:
            empty = values.new_full((len(images) * self.num_keypoints, *values.shape[1:]), fill)
            return empty.index_copy(0, corners.slots, values).unflatten(0, (len(images), -1))

        return Features(
            table(keypoints),
            table(scores.to(images.dtype) * HARRIS_UNIT),
            table(scales, fill=1),
            table(angles.to(images.dtype)),
            table(descriptors),
            table(torch.ones_like(corners.slots, dtype=torch.bool)),
        )

    def detect(self, images: Tensor) -> Corners:
        """Choose the corners of a batch of images (B, 1, H, W), without their descriptors."""
        atlas = plan_atlas(*images.shape[-2:], self.scale_factor, self.num_levels)
        grid = plan_grid(atlas, self.num_keypoints, self.per_cell, BORDER, images.device)
        with torch.set_grad_enabled(self.differentiable and torch.is_grad_enabled()):
            levels = build_levels(images, atlas)
        with torch.no_grad():
            pixels = fill_atlas(levels, atlas).flatten()
            area = grid.table.shape[0]
            fast = fast_scores(pixels, atlas.stride)
            peaks = suppress_non_maxima(fast, atlas.stride) & (fast > self.low_threshold)
            positions = true_indices((peaks.view(-1, area) & (grid.table >= 0)).flatten())
            positions, slots, harris = self._choose(pixels, positions, fast[positions], grid, atlas.stride)
            neighbours = gather_patches(fast, positions, atlas.stride, 1)
            cell = grid.table[positions % area].to(torch.int64)
            level, inside = grid.levels[cell], positions % area
            top, left = torch.tensor(atlas.corners, device=images.device)[level].unbind(-1)
            xy = torch.stack([inside % atlas.stride - left, inside // atlas.stride - top], dim=-1)
        return Corners(
            levels, pixels, atlas, positions, slots, positions // area, level, xy, harris, neighbours
        )

    def _choose(
        self, pixels: Tensor, positions: Tensor, fast: Tensor, grid: Grid, stride: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Out of the FAST corners, those to keep: positions, rows of the flattened (B, num_keypoints) table, Harris."""
        area, num_cells = grid.table.shape[0], grid.levels.shape[0]
        batch = pixels.shape[0] // area
        image, cell = positions // area, grid.table[positions % area].to(torch.int64)
        kept = best_per_cell(image * num_cells + cell, fast, CANDIDATES * self.per_cell, batch * num_cells)
        positions, image, cell, fast = positions[kept], image[kept], cell[kept], fast[kept]
        patches = gather_patches(pixels, positions, stride, HARRIS_RADIUS)
        harris = harris_responses(patches.to(torch.float32)).flatten()
        strong = fast > self.threshold
        rows, places = spread(
            harris, strong, cell, image, grid, self.guaranteed_per_cell, batch, self.num_keypoints
        )
        return positions[rows], image[rows] * self.num_keypoints + places, harris[rows]

    def _refine(self, corners: Corners) -> tuple[Tensor, Tensor]:
        """Sub-pixel offsets (K, 2) in pixels of the level, and Harris scores (K,).

        Corners sit where the FAST score peaks; the maximum of the Harris response lies further inside the corner and
        repeats less precisely.
        """
        if not self.differentiable:
            return quadratic_peak(corners.fast.to(torch.float32)), corners.harris
        radius = FAST_RADIUS + SOFT_RADIUS
        patches = 255 * gather_level_patches(corners.levels, corners.image, corners.level, corners.xy, radius)
        rim = radius - HARRIS_RADIUS
        harris = harris_responses(patches[:, rim:-rim, rim:-rim])
        return soft_peak(patch_scores(patches)), harris[:, 0, 0]


def check_images(images: Tensor) -> None:
    """Raise ValueError unless the images are (B, 1, H, W) floats."""
    if images.dim() != 4 or images.shape[1] != 1 or 0 in images.shape:
        raise ValueError(f"images must be (B, 1, H, W), got {tuple(images.shape)}")
    if not images.is_floating_point():
        raise ValueError(f"images must be floats in [0, 1], got {images.dtype}")
