"""ORB in tensor operations, and the one of OpenCV.

FAST corners on a pyramid are ranked, spread over the image, oriented, and described by rotated BRIEF, as in Rublee,
Rabaud, Konolige, Bradski: ORB, an efficient alternative to SIFT or SURF (ICCV 2011).
"""

from __future__ import annotations

import math

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor, nn

from torchslam.features.brief import blur, describe, orientations
from torchslam.features.contract import check_gray
from torchslam.features.corners import (
    Bands,
    fast_scores,
    find_peaks,
    gather_patches,
    harris_responses,
    patch_scores,
    quadratic_peak,
    soft_peak,
)
from torchslam.features.pyramid import (
    PackedPyramid,
    build_levels,
    gather_level_patches,
    pack_levels,
    plan_pyramid,
)
from torchslam.features.selection import Grid, best_per_cell, plan_grid, prefilter_candidates, select_evenly
from torchslam.types import Features

BORDER = 19  # of every level: the descriptor's disk (15), its blur (3), and one for rounding
PATCH_RADIUS = 4  # 3 of the circle of FAST and 1 of the soft arg-max; just what a Harris response needs
MAX_SCORE = 255  # a score that no corner exceeds
WEAK_TEXTURE_RATIO = 0.5  # of the keypoints that may be chosen: an image that offers fewer has weak texture
FAINT_THRESHOLD = 4  # gray values: corners of an image of the weakest texture, above a good camera's noise
KEYPOINTS_PER_CELL = 8  # keypoints of a cell if they were spread evenly


class ORB(nn.Module):
    """Oriented FAST corners with 256-bit descriptors, for batches of images on any device.

    Args:
        num_keypoints: largest number of keypoints per image; rows beyond what the image offers are masked.
        scale_factor: ratio of the sizes of neighboring pyramid levels.
        num_levels: of the pyramid; levels too small to hold a keypoint stay empty.
        threshold: of FAST, gray values of 0 to 255, for corners anywhere.
        low_threshold: of FAST for the best corner of each cell, so that regions of low contrast have keypoints too;
            for all corners of an image of weak texture, which otherwise offers less than half of `num_keypoints`.
            If there are still fewer, faint corners of more than 4 gray values count.
        ranking: "fast" ranks corners by their FAST score, which repeats better; "harris" by their Harris response.
        differentiable: keypoints and scores carry gradients to the image (soft arg-max over 3x3 FAST scores); the
            choice of corners, angles and descriptors stay discrete.
    """

    def __init__(
        self,
        num_keypoints: int = 1000,
        scale_factor: float = 1.2,
        num_levels: int = 8,
        threshold: int = 20,
        low_threshold: int = 7,
        ranking: str = "fast",
        differentiable: bool = False,
    ) -> None:
        super().__init__()
        if num_keypoints < 1 or num_levels < 1 or scale_factor <= 1:
            raise ValueError("ORB needs num_keypoints >= 1, num_levels >= 1 and scale_factor > 1")
        if not 0 < low_threshold <= threshold < 255:
            raise ValueError("ORB needs 0 < low_threshold <= threshold < 255")
        if ranking not in ("fast", "harris"):
            raise ValueError(f'ranking must be "fast" or "harris", got {ranking!r}')
        self.num_keypoints = num_keypoints
        self.scale_factor = scale_factor
        self.num_levels = num_levels
        self.threshold = threshold
        self.low_threshold = low_threshold
        self.ranking = ranking
        self.differentiable = differentiable

    def forward(
        self, images: Float[Tensor, "B 1 H W"], mask: Bool[Tensor, "B 1 H W"] | None = None
    ) -> Features:
        """Detect and describe keypoints.

        Args:
            images: gray, in [0, 1].
            mask: where keypoints may lie; None: everywhere.

        Returns:
            Features with N = num_keypoints rows, in order of falling score, masked ones last.

        Raises:
            ValueError: The images or the mask have another shape or type.
            FrameError: The images are not in [0, 1].
        """
        check_images(images, mask)
        pyramid = plan_pyramid(*images.shape[-2:], self.scale_factor, self.num_levels)
        grid = plan_grid(
            pyramid, self.num_keypoints, KEYPOINTS_PER_CELL, BORDER, self.low_threshold, images.device
        )
        stride, dtype = pyramid.stride, images.dtype
        with torch.set_grad_enabled(self.differentiable and torch.is_grad_enabled()):
            levels = build_levels(images, pyramid)
        with torch.no_grad():
            pixels = pack_levels(levels, pyramid).flatten()
            # Peaks lie in cells, and the FAST scores next to them are needed as well.
            fast = fast_scores(pixels, stride, _bands(grid, pyramid, len(images), margin=1))
            floor = grid.floor.expand(len(images), -1).reshape(-1)
            if mask is not None:
                floor = torch.where(_packed_mask(mask, pyramid), floor, MAX_SCORE)
            positions = self._peaks(fast, floor, len(images), stride, _bands(grid, pyramid, len(images)))
            positions, slots, strengths = self._choose(pixels, fast, positions, grid, stride)
            area = grid.table.shape[0]
            image, inside = positions // area, positions % area
            level = grid.levels[grid.table[inside].to(torch.int64)]
            top, left = torch.tensor(pyramid.corners, device=images.device)[level].unbind(-1)
            xy = torch.stack([inside % stride - left, inside // stride - top], dim=-1)
            angles = orientations(pixels, positions, stride)
            descriptors = describe(blur(pixels, stride), positions, angles, stride)
        # Corners are where the FAST score peaks; the maximum of the Harris response lies further inside the corner and
        # repeats less precisely.
        if self.differentiable:
            offsets, strengths = self._soft_peaks(
                gather_level_patches(levels, image, level, xy, PATCH_RADIUS)
            )
        else:
            offsets = quadratic_peak(gather_patches(fast, positions, stride, 1).to(torch.float32))
        scale_xy = torch.tensor(pyramid.scales, dtype=dtype, device=images.device)[level]
        keypoints = (xy + offsets.to(dtype) + 0.5) * scale_xy - 0.5

        def table(values: Tensor, fill: int = 0) -> Tensor:
            empty = values.new_full((len(images) * self.num_keypoints, *values.shape[1:]), fill)
            return empty.index_copy(0, slots, values).unflatten(0, (len(images), -1))

        return Features(
            table(keypoints),
            table(strengths.to(dtype)),
            table(self.scale_factor ** level.to(dtype), fill=1),
            table(angles.to(dtype)),
            table(descriptors),
            table(torch.ones_like(slots, dtype=torch.bool)),
        )

    def _peaks(
        self, scores: UInt8[Tensor, " A"], floor: UInt8[Tensor, " A"], batch: int, stride: int, bands: Bands
    ) -> Int[Tensor, " R"]:
        """Positions of corners: peaks of the scores above a floor, which is lower in images with few of them."""
        positions = find_peaks(scores, floor, stride, bands)
        images = _images_of(positions, len(scores), batch)
        faint = self._are_few(torch.ones_like(positions, dtype=torch.bool), images, batch)
        if self.low_threshold <= FAINT_THRESHOLD or not bool(faint.any()):
            return positions
        lower = torch.where(
            faint[:, None] & (floor.view(batch, -1) < MAX_SCORE), FAINT_THRESHOLD, floor.view(batch, -1)
        )
        return find_peaks(scores, lower.flatten(), stride, bands)

    def _are_few(
        self, corners: Bool[Tensor, " N"], images: Int[Tensor, " N"], batch: int
    ) -> Bool[Tensor, "{batch}"]:
        """Whether an image has few of the masked corners, given the image of each corner."""
        count = corners.sum()[None] if batch == 1 else torch.bincount(images[corners], minlength=batch)
        return count < WEAK_TEXTURE_RATIO * self.num_keypoints

    def _choose(
        self,
        pixels: UInt8[Tensor, " A"],
        scores: UInt8[Tensor, " A"],
        positions: Int[Tensor, " N"],
        grid: Grid,
        stride: int,
    ) -> tuple[Int[Tensor, " R"], Int[Tensor, " R"], Float[Tensor, " R"]]:
        """Choose corners: their positions, rows of the flattened (B, num_keypoints) table, and strengths."""
        area, num_cells = grid.table.shape[0], grid.levels.shape[0]
        batch = pixels.shape[0] // area
        image = _images_of(positions, len(scores), batch)
        cell = grid.table.index_select(0, positions - image * area).to(torch.int64)
        fast = scores.index_select(0, positions)
        strong = fast > self.threshold
        best = best_per_cell(image * num_cells + cell, fast, batch * num_cells)
        strong |= self._are_few(strong | best, image, batch).index_select(0, image)
        competing = best | strong
        if self.ranking == "fast":  # the whole part of what they compete by
            count = self.num_keypoints
            competing = best | (
                strong & prefilter_candidates(fast, competing, cell, image, grid, batch, count)
            )
        kept = competing.nonzero().squeeze(1)
        positions, image, cell, strong = (x.index_select(0, kept) for x in (positions, image, cell, strong))
        if self.ranking == "harris":
            patches = gather_patches(pixels, positions, stride, PATCH_RADIUS)
            strengths = harris_responses(patches.to(torch.float32)).flatten()
        else:
            strengths = _contrast_score(gather_patches(scores, positions, stride, 1).to(torch.float32))
        rows, places = select_evenly(strengths, strong, cell, image, grid, batch, self.num_keypoints)
        return positions[rows], image[rows] * self.num_keypoints + places, strengths[rows]

    def _soft_peaks(
        self, patches: Float[Tensor, "N 9 9"]
    ) -> tuple[Float[Tensor, "N 2"], Float[Tensor, " N"]]:
        """Differentiable sub-pixel offsets of corners in pixels of the level, and their scores."""
        fast = patch_scores(patches)
        if self.ranking == "harris":
            return soft_peak(fast), harris_responses(patches).flatten()
        return soft_peak(fast), _contrast_score(fast)


def _bands(grid: Grid, pyramid: PackedPyramid, batch: int, margin: int = 0) -> Bands:
    """Runs of pixels of `batch` flattened pyramids in whose rows there are cells, with `margin` rows around them."""
    tops = [image * pyramid.rows for image in range(batch)]
    runs = [(top + first - margin, top + last + margin) for top in tops for first, last in grid.rows]
    return tuple((first * pyramid.stride, last * pyramid.stride) for first, last in runs)


def _images_of(positions: Int[Tensor, " N"], pixels: int, batch: int) -> Int[Tensor, " N"]:
    """The image of each position in `batch` flattened pyramids of `pixels` pixels together."""
    return torch.zeros_like(positions) if batch == 1 else positions // (pixels // batch)


def _contrast_score(fast: Float[Tensor, "N 3 3"]) -> Float[Tensor, " N"]:
    """The FAST score (below 256), with ties settled below its unit by how much it exceeds the mean around it."""
    return fast[:, 1, 1] + (fast[:, 1, 1] - fast.flatten(1).mean(1)) / 256


def _packed_mask(mask: Bool[Tensor, "B 1 H W"], pyramid: PackedPyramid) -> Bool[Tensor, " A"]:
    """Masks of images at the pixels of the flattened packed pyramids, by nearest neighbor."""
    levels = [F.interpolate(mask.float(), size=size, mode="nearest-exact") for size in pyramid.sizes]
    return pack_levels(levels, pyramid).flatten() > 0


def check_images(images: Tensor, mask: Tensor | None = None) -> None:
    """Check the input of an extractor.

    Raises:
        ValueError: The images are not (B, 1, H, W) floats, or the mask is not (B, 1, H, W) bool.
        FrameError: The images are not in [0, 1].
    """
    if mask is not None and (mask.shape != images.shape or mask.dtype != torch.bool):
        raise ValueError(f"a mask must be bool {tuple(images.shape)}, got {mask.dtype} {tuple(mask.shape)}")
    if images.dim() != 4 or images.shape[1] != 1 or 0 in images.shape:
        raise ValueError(f"images must be (B, 1, H, W), got {tuple(images.shape)}")
    if images.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"images must be float32 or float64, in [0, 1], got {images.dtype}")
    check_gray(images, "images")


def gray_bytes(images: Float[Tensor, "B 1 H W"]) -> UInt8[Tensor, "B H W"]:
    """Images as OpenCV takes them, on the CPU."""
    return images.detach().mul(255).add(0.5).clamp(0, 255).to(torch.uint8)[:, 0].cpu()


class OpenCVORB(nn.Module):
    """OpenCV's ORB behind the interface of `ORB`. Not differentiable; results are on the images' device.

    Args:
        num_keypoints: largest number of keypoints per image; rows beyond what OpenCV finds are masked.
        scale_factor: ratio of the sizes of neighboring pyramid levels.
        num_levels: of the pyramid.
        threshold: of FAST, gray values of 0 to 255.
    """

    def __init__(
        self, num_keypoints: int = 1000, scale_factor: float = 1.2, num_levels: int = 8, threshold: int = 20
    ) -> None:
        super().__init__()
        self.num_keypoints = num_keypoints
        self.scale_factor = scale_factor
        self._orb = cv2.ORB.create(
            nfeatures=num_keypoints, scaleFactor=scale_factor, nlevels=num_levels, fastThreshold=threshold
        )

    def forward(
        self, images: Float[Tensor, "B 1 H W"], mask: Bool[Tensor, "B 1 H W"] | None = None
    ) -> Features:
        """Detect and describe keypoints; arguments, result and errors as for `ORB.forward`."""
        check_images(images, mask)
        masks = [None] * len(images) if mask is None else list(mask[:, 0].to(torch.uint8).cpu().numpy())
        batch = [self._extract(*each, images.dtype) for each in zip(gray_bytes(images), masks, strict=True)]
        fields = (torch.stack(column) for column in zip(*batch, strict=True))
        return Features(*fields).to(images.device)

    def _extract(self, image: Tensor, mask: np.ndarray | None, dtype: torch.dtype) -> tuple[Tensor, ...]:
        """The fields of `Features` of one (H, W) uint8 image, where `mask` is not 0."""
        # cv2 fails on images that leave no room for a keypoint instead of finding none.
        roomy = min(image.shape) > 2 * self._orb.getEdgeThreshold()
        found, described = self._orb.detectAndCompute(image.numpy(), mask) if roomy else ((), None)
        # cv2 may return a few more than asked for when responses tie.
        rows = sorted(range(len(found)), key=lambda row: -found[row].response)[: self.num_keypoints]
        values = torch.tensor([0, 0, 0, 1, 0], dtype=dtype, device="cpu").repeat(self.num_keypoints, 1)
        descriptors = torch.zeros(self.num_keypoints, 32, dtype=torch.uint8, device="cpu")
        found_mask = torch.arange(self.num_keypoints, device="cpu") < len(rows)
        if described is not None:
            points = [found[row] for row in rows]
            values[: len(rows)] = torch.tensor(
                [self._row(point) for point in points], dtype=dtype, device="cpu"
            )
            descriptors[: len(rows)] = torch.from_numpy(described[rows])
        return values[:, :2], values[:, 2], values[:, 3], values[:, 4], descriptors, found_mask

    def _row(self, point: cv2.KeyPoint) -> tuple[float, float, float, float, float]:
        """x, y, score, scale, angle of a keypoint.

        cv2 scales pixels of a level about the center of the first one, but resizes images about their corner; the
        difference is half a pixel of the level less half a pixel of the image.
        """
        scale = self.scale_factor**point.octave
        shift = (scale - 1) / 2
        angle = math.remainder(math.radians(point.angle), 2 * math.pi)
        return point.pt[0] + shift, point.pt[1] + shift, point.response, scale, angle
