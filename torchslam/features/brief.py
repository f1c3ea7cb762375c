"""Orientation by the intensity centroid and rotated BRIEF descriptors (Rublee et al.: ORB, 2011)."""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from torch import Tensor

from torchslam.features.chunks import library_of, on_host, pieces
from torchslam.features.corners import gather_patches
from torchslam.features.matching.hamming import int8_product, pack_bits
from torchslam.features.pattern import PATTERN

RADIUS = 15
BLUR_RADIUS = 3
ANGLE_BINS = 256  # 1.4 degrees: at the pattern's rim the rounding of the angle stays below 0.2 px


@lru_cache(maxsize=8)
def _moment_weights(device: torch.device) -> Tensor:
    """(2, side^2) int8: x and y of each pixel of the patch within the disk of RADIUS, else 0; they sum to 0."""
    axis = torch.arange(-RADIUS, RADIUS + 1, dtype=torch.float32)
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    disk = (x * x + y * y <= (RADIUS + 0.5) ** 2).float()
    return torch.stack([x * disk, y * disk]).flatten(1).to(device, torch.int8)


def orientations(pixels: Tensor, positions: Tensor, stride: int) -> Tensor:
    """Angle from each keypoint to the intensity centroid of the disk around it.

    pixels: (P,) uint8 flattened atlas; positions: (N,) int64 into it. Returns (N,) float32 radians in [-pi, pi],
    from x towards y; 0 on a uniform patch. The moments are whole numbers below 2^24, hence exact.
    """
    patches = gather_patches(pixels, positions, stride, RADIUS).flatten(1)
    # As int8: what is subtracted is the same everywhere, and has no moment. The other order of factors is slower.
    x, y = int8_product(_moment_weights(pixels.device), (patches ^ 128).view(torch.int8).mT)
    # In float64, as vectorised float32 may differ in the last bit from one position in memory to another.
    return torch.atan2(y.double(), x.double()).float()


def blur(pixels: Tensor, stride: int) -> Tensor:
    """Smooth a flattened image by a 7x7 near-Gaussian of sigma 1.6 px, in whole numbers.

    pixels: (P,) uint8. Returns (P - 6 stride - 6,) int16, 256 times the blurred value less 2^15: entry i belongs to
    pixel i + BLUR_RADIUS * (stride + 1). Per direction two boxes of width 4, each the sum of two shifted sums.
    """
    margin = 2 * BLUR_RADIUS * (stride + 1)
    blurred = pixels.new_empty(max(0, pixels.shape[0] - margin), dtype=torch.int16)
    whole = on_host(blurred)
    *shifts, last = (1, 1, 2, 2, stride, stride, 2 * stride, 2 * stride)
    for start, count in pieces(whole, 0, len(blurred)):
        # Subtracting 128 first makes the sum of weights, 256, fit int16 without rounding.
        smooth = on_host((pixels.narrow(0, start, count + margin) ^ 128).view(torch.int8).to(torch.int16))
        for shift in shifts:
            smooth = smooth[shift:] + smooth[:-shift]
        library_of(whole).add(smooth[last:], smooth[:-last], out=whole[start : start + count])
    return blurred


@lru_cache(maxsize=16)
def rotated_offsets(points: tuple[tuple[int, int], ...], stride: int, device: torch.device) -> Tensor:
    """(ANGLE_BINS, K) int32: flat offsets of K points (x, y) around a keypoint, turned by every angle and rounded."""
    angles = torch.arange(ANGLE_BINS, dtype=torch.float64) * (2 * math.pi / ANGLE_BINS)
    cos, sin = angles.cos()[:, None], angles.sin()[:, None]
    x, y = torch.tensor(points, dtype=torch.float64).unbind(-1)
    offsets = (x * sin + y * cos).round() * stride + (x * cos - y * sin).round()
    return offsets.to(device=device, dtype=torch.int32)


def sample_rotated(
    blurred: Tensor, positions: Tensor, angles: Tensor, stride: int, points: tuple[tuple[int, int], ...]
) -> Tensor:
    """Values of a blurred image at points around each keypoint, turned by its angle.

    blurred: from `blur`; positions: (N,) int64 into the image before blurring; angles: (N,) radians; points: K times
    (x, y) in pixels of the level. Returns (N, K) int16.
    """
    bins = torch.round(angles * (ANGLE_BINS / (2 * math.pi))).to(torch.int64) % ANGLE_BINS
    origins = (positions - BLUR_RADIUS * (stride + 1)).to(torch.int32)
    samples = rotated_offsets(points, stride, blurred.device).index_select(0, bins).add_(origins[:, None])
    return blurred.index_select(0, samples.view(-1)).view(samples.shape)


# The first ends of all tests, then the second ends.
_ENDS = tuple((test[2 * end], test[2 * end + 1]) for end in (0, 1) for test in PATTERN)


def describe(blurred: Tensor, positions: Tensor, angles: Tensor, stride: int) -> Tensor:
    """256 brightness comparisons around each keypoint, turned by its angle: (N, 32) uint8, arguments as above.

    Keypoints must lie RADIUS + BLUR_RADIUS inside their level.
    """
    first, second = sample_rotated(blurred, positions, angles, stride, _ENDS).chunk(2, dim=1)
    return pack_bits(first < second)
