"""Orientation by the intensity centroid and rotated BRIEF descriptors (Rublee et al.: ORB, 2011)."""

from __future__ import annotations

import math
from functools import lru_cache
from pathlib import Path

import torch
from jaxtyping import Float, Int, UInt8
from safetensors.torch import load_file
from torch import Tensor

from torchslam.features.corners import array_module, chunks, gather_patches, to_numpy
from torchslam.features.matching.hamming import int8_product, pack_bits

RADIUS = 15
"""Of the disk for the orientation, and of the sampling pattern, pixels (Rublee et al.: ORB, 2011)."""
BLUR_RADIUS = 3
"""Of the Gaussian filter before the tests, pixels: 7 x 7 as in the ORB of OpenCV."""
_PATTERN_FILE = Path(__file__).with_suffix(".safetensors")
ANGLE_BINS = 256  # 1.4 degrees: at the pattern's rim the rounding of the angle stays below 0.2 px


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
