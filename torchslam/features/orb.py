"""ORB in tensor operations.

FAST corners on a pyramid are ranked, spread over the image, oriented, and described by rotated BRIEF, as in Rublee,
Rabaud, Konolige, Bradski: ORB, an efficient alternative to SIFT or SURF (ICCV 2011).
"""

from __future__ import annotations

import math
from functools import lru_cache
from pathlib import Path

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, UInt8
from safetensors.torch import load_file
from torch import Tensor, nn

from torchslam.features.contract import check_images
from torchslam.features.corners import (
    Bands,
    array_module,
    chunks,
    fast_scores,
    find_peaks,
    gather_patches,
    harris_responses,
    patch_scores,
    quadratic_peak,
    soft_peak,
    to_numpy,
)
from torchslam.features.matching.hamming import int8_product, pack_bits
from torchslam.features.pyramid import (
    PackedPyramid,
    build_levels,
    gather_level_patches,
    pack_levels,
    plan_pyramid,
)
from torchslam.features.selection import Grid, best_per_cell, plan_grid, prefilter_candidates, select_evenly
from torchslam.types import Features

RADIUS = 15
"""Of the disk for the orientation, and of the sampling pattern, pixels (Rublee et al.: ORB, 2011)."""
BLUR_RADIUS = 3
"""Of the Gaussian filter before the tests, pixels: 7 x 7 as in the ORB of OpenCV."""
_PATTERN_FILE = Path(__file__).with_name("brief.safetensors")
ANGLE_BINS = 256  # 1.4 degrees: at the pattern's rim the rounding of the angle stays below 0.2 px
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


@lru_cache(maxsize=8)
def _moment_weights(device: torch.device) -> Int[Tensor, "2 S"]:
    """x and y (int8) of each pixel of the flattened patch within the disk of RADIUS, else 0; they sum to 0."""
    axis = torch.arange(-RADIUS, RADIUS + 1, dtype=torch.float32, device="cpu")
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    disk = (x * x + y * y <= (RADIUS + 0.5) ** 2).float()
    return torch.stack([x * disk, y * disk]).flatten(1).to(device, torch.int8)


def orientations(
    pixels: UInt8[Tensor, " A"], positions: Int[Tensor, " N"], stride: int
) -> Float[Tensor, " N"]:
    """Compute the angle from each keypoint in flattened pixels to the intensity centroid of the disk around it.

    Radians in [-pi, pi], from x towards y; 0 on a uniform patch. The moments are whole numbers below 2^24, hence exact.
    """
    patches = gather_patches(pixels, positions, stride, RADIUS).flatten(1)
    # As int8: subtracting a constant changes no moment. The other order of factors is slower.
    x, y = int8_product(_moment_weights(pixels.device), (patches ^ 128).view(torch.int8).mT)
    # In float64, as vectorized float32 may differ in the last bit from one position in memory to another.
    return torch.atan2(y.double(), x.double()).float()


def blur(pixels: UInt8[Tensor, " A"], stride: int) -> Int[Tensor, " R"]:
    """Smooth a flattened image by a 7x7 near-Gaussian of sigma 1.6 px, in whole numbers.

    Per direction two boxes of width 4, each the sum of two shifted sums.

    Returns:
        int16, 256 times the blurred value less 2^15, without the first and the last BLUR_RADIUS * (stride + 1) pixels.
    """
    margin = 2 * BLUR_RADIUS * (stride + 1)
    blurred = pixels.new_empty(max(0, pixels.shape[0] - margin), dtype=torch.int16)
    whole = to_numpy(blurred)
    *shifts, last = (1, 1, 2, 2, stride, stride, 2 * stride, 2 * stride)
    for start, count in chunks(whole, 0, len(blurred)):
        # Subtracting 128 first makes the sum of weights, 256, fit int16 without rounding.
        smooth = to_numpy((pixels.narrow(0, start, count + margin) ^ 128).view(torch.int8).to(torch.int16))
        for shift in shifts:
            smooth = smooth[shift:] + smooth[:-shift]
        array_module(whole).add(smooth[last:], smooth[:-last], out=whole[start : start + count])
    return blurred


@lru_cache(maxsize=1)
def pattern() -> Int[Tensor, "256 4"]:
    """The tests of a descriptor: x and y of the first and of the second pixel, whose brightness is compared."""
    return load_file(_PATTERN_FILE)["pattern"]


@lru_cache(maxsize=16)
def _rotated_offsets(stride: int, device: torch.device) -> Int[Tensor, "256 512"]:
    """Flat offsets of the first and then the second pixels of all tests, rotated by every angle and rounded."""
    angles = torch.arange(ANGLE_BINS, dtype=torch.float64, device="cpu") * (2 * math.pi / ANGLE_BINS)
    cos, sin = angles.cos()[:, None], angles.sin()[:, None]
    x, y = pattern().double().view(256, 2, 2).permute(2, 1, 0).flatten(1)
    offsets = (x * sin + y * cos).round() * stride + (x * cos - y * sin).round()
    return offsets.to(device=device, dtype=torch.int32)


def describe(
    blurred: Int[Tensor, " R"], positions: Int[Tensor, " N"], angles: Float[Tensor, " N"], stride: int
) -> UInt8[Tensor, "N 32"]:
    """Describe keypoints by 256 brightness comparisons, rotated by their angles.

    Args:
        blurred: from `blur`.
        positions: of the keypoints in the image before blurring, RADIUS + BLUR_RADIUS inside their level.
        angles: radians.
        stride: length of a row of pixels.
    """
    bins = torch.round(angles * (ANGLE_BINS / (2 * math.pi))).to(torch.int64) % ANGLE_BINS
    origins = (positions - BLUR_RADIUS * (stride + 1)).to(torch.int32)
    samples = _rotated_offsets(stride, blurred.device).index_select(0, bins).add_(origins[:, None])
    first, second = blurred.index_select(0, samples.view(-1)).view(samples.shape).chunk(2, dim=1)
    return pack_bits(first < second)
