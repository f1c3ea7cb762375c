"""ORB in tensor operations: FAST corners on a pyramid, ranked by Harris, oriented, described by rotated BRIEF.

The steps follow Rublee, Rabaud, Konolige, Bradski: ORB, an efficient alternative to SIFT or SURF (ICCV 2011).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torchslam.features.brief import blur, describe, orientations
from torchslam.features.corners import gather_patches, harris_responses, quadratic_peak, soft_peak
from torchslam.features.fast import fast_scores, suppress_non_maxima
from torchslam.features.pyramid import Atlas, build_levels, fill_atlas, gather_level_patches, plan_atlas
from torchslam.features.selection import Grid, best_per_cell, plan_grid, spread, true_indices
from torchslam.types import Features

BORDER = 19  # of every level: the descriptor's disk (15), its blur (3), and one for rounding
HARRIS_RADIUS = 4  # of the patch that gives one response; each further pixel gives a ring more of responses
HARRIS_UNIT = (
    49.0 * (8 * 255) ** 2
) ** -2  # makes responses those of mean squared derivatives of [0, 1] images
SOFT_RADIUS = 2
CANDIDATES = 4  # per cell, how many times the keypoints wanted there are ranked by Harris


class ORB(nn.Module):
    """Oriented FAST corners with 256-bit descriptors, for batches of images on any device.

    num_keypoints:  keypoints per image, at most; rows beyond what the image offers are masked
    scale_factor:   ratio of the sizes of neighbouring pyramid levels
    num_levels:     of the pyramid; levels too small to hold a keypoint stay empty
    threshold:      of FAST, in grey values of 0 to 255, for corners anywhere
    low_threshold:  for the best corners of each cell, so that regions of little contrast have keypoints too
    differentiable: keypoints and scores carry gradients to the image (soft arg-max over 5x5 Harris responses); what
                    is chosen, angles and descriptors stay discrete
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

        Raises ValueError for another shape or type. Rows are in order of falling score, masked ones last.
        """
        check_images(images)
        batch, _, height, width = images.shape
        atlas = plan_atlas(height, width, self.scale_factor, self.num_levels)
        grid = plan_grid(atlas, self.num_keypoints, self.per_cell, BORDER, images.device)
        with torch.set_grad_enabled(self.differentiable and torch.is_grad_enabled()):
            levels = build_levels(images, atlas)
        with torch.no_grad():
            pixels = fill_atlas(levels, atlas).flatten()
            positions, slots = self._detect(pixels, atlas, grid, batch)
            angles = orientations(pixels, positions, atlas.stride)
            descriptors = describe(blur(pixels, atlas.stride), positions, angles, atlas.stride)
            image, level, xy = _locate(positions, atlas, grid)
        if self.differentiable:
            patches = gather_level_patches(levels, image, level, xy, HARRIS_RADIUS + SOFT_RADIUS)
            offsets, scores = soft_peak(harris_responses(patches * 255) * HARRIS_UNIT)
        else:
            patches = gather_patches(pixels, positions, atlas.stride, HARRIS_RADIUS + 1)
            responses = harris_responses(patches.to(images.dtype)) * HARRIS_UNIT
            offsets, scores = quadratic_peak(responses), responses[:, 1, 1]
        scale_xy = xy.new_tensor(atlas.scales, dtype=images.dtype)[level]
        keypoints = (xy + offsets + 0.5) * scale_xy - 0.5
        scales = self.scale_factor ** level.to(images.dtype)

        def table(values: Tensor, fill: int = 0) -> Tensor:
            empty = values.new_full((batch * self.num_keypoints, *values.shape[1:]), fill)
            return empty.index_copy(0, slots, values).unflatten(0, (batch, -1))

        mask = table(torch.ones_like(slots, dtype=torch.bool))
        return Features(
            table(keypoints),
            table(scores),
            table(scales, 1),
            table(angles.to(images.dtype)),
            table(descriptors),
            mask,
        )

    def _detect(self, pixels: Tensor, atlas: Atlas, grid: Grid, batch: int) -> tuple[Tensor, Tensor]:
        """Where the keypoints are: flat atlas positions (K,) and, for each, its row among batch * num_keypoints."""
        fast = fast_scores(pixels, atlas.stride)
        corners = suppress_non_maxima(fast, atlas.stride) & (fast > self.low_threshold)
        corners = (corners.view(batch, -1) & (grid.table >= 0)).flatten()
        positions = true_indices(corners)
        image, cell = (
            positions // grid.table.shape[0],
            grid.table[positions % grid.table.shape[0]].to(torch.int64),
        )

        num_cells = batch * grid.levels.shape[0]
        kept = best_per_cell(
            image * grid.levels.shape[0] + cell, fast[positions], CANDIDATES * self.per_cell, num_cells
        )
        positions, image, cell = positions[kept], image[kept], cell[kept]
        patches = gather_patches(pixels, positions, atlas.stride, HARRIS_RADIUS)
        harris = harris_responses(patches.to(torch.float32)).flatten()
        strong = fast[positions] > self.threshold
        rows, places = spread(
            harris, strong, cell, image, grid, self.guaranteed_per_cell, batch, self.num_keypoints
        )
        return positions[rows], image[rows] * self.num_keypoints + places


def _locate(positions: Tensor, atlas: Atlas, grid: Grid) -> tuple[Tensor, Tensor, Tensor]:
    """Image (K,), level (K,) and pixel of the level (K, 2) of flat atlas positions."""
    area = grid.table.shape[0]
    level = grid.levels[grid.table[positions % area].to(torch.int64)]
    corners = positions.new_tensor(atlas.corners)[level]
    inside = positions % area
    xy = torch.stack([inside % atlas.stride - corners[:, 1], inside // atlas.stride - corners[:, 0]], dim=-1)
    return positions // area, level, xy


def check_images(images: Tensor) -> None:
    """Raise ValueError unless the images are (B, 1, H, W) floats."""
    if images.dim() != 4 or images.shape[1] != 1 or 0 in images.shape:
        raise ValueError(f"images must be (B, 1, H, W), got {tuple(images.shape)}")
    if not images.is_floating_point():
        raise ValueError(f"images must be floats in [0, 1], got {images.dtype}")
