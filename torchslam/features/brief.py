"""Orientation by the intensity centroid and rotated BRIEF descriptors (Rublee et al.: ORB, 2011)."""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from torchslam.features.corners import array_module, chunks, gather_patches, to_numpy
from torchslam.features.matching.hamming import int8_product, pack_bits

PATTERN: tuple[tuple[int, int, int, int], ...] = (
    (0, -5, 0, 0), (-1, -2, -2, 4), (4, -2, 5, 13), (-8, -12, -4, 1),
    (2, -6, 2, 5), (-6, -1, -8, 12), (0, 0, 3, 4), (12, -7, 5, 2),
    (-13, -4, -4, 3), (4, -13, 4, -5), (-3, -2, -1, -1), (-1, 7, -2, 14),
    (-3, -3, -6, 5), (3, 3, 10, 10), (0, 0, -1, 10), (-3, -10, -1, 9),
    (-6, 4, -11, 9), (6, 0, 1, 1), (1, -14, 1, -9), (6, -2, 12, -2),
    (-5, -4, -2, -1), (5, -6, 4, -1), (6, -4, 5, 7), (-10, -8, -4, -6),
    (-1, -6, 2, 14), (-7, -9, -13, 0), (-1, 4, -3, 9), (6, 7, 12, 8),
    (0, 0, -2, 2), (-2, -10, -1, -4), (-4, -1, -1, 6), (-13, -1, -11, -1),
    (1, -3, -1, 0), (-8, 2, -4, 2), (9, -10, 9, -4), (-2, -8, -2, 6),
    (3, -3, 5, 0), (-9, -10, -8, 12), (4, 1, 7, 3), (-7, 0, -13, 6),
    (-5, -13, -3, -10), (7, -4, 5, -3), (1, -1, 2, 4), (-2, -4, 1, 0),
    (-5, -5, -4, -3), (2, -11, 1, 6), (8, -12, 5, -7), (6, 2, 8, 11),
    (0, -1, -2, 4), (-13, 2, -9, 3), (3, -2, 2, 2), (10, -7, 10, 6),
    (3, -9, 0, 0), (-4, 9, -5, 13), (-2, 2, -6, 6), (-7, -4, -4, 4),
    (11, -1, 14, -1), (2, -12, 0, -8), (-8, -4, -5, -3), (3, 10, 6, 13),
    (3, 3, 3, 5), (-12, -7, -9, -7), (3, -2, 1, -1), (2, 5, 1, 14),
    (-1, -2, -5, 1), (-4, -13, -4, -4), (3, -8, 5, 12), (13, 1, 8, 4),
    (1, -6, 0, 10), (-6, 6, -7, 12), (-12, -6, -10, -2), (2, -14, 2, -12),
    (2, -9, 1, -4), (1, -5, 2, 1), (-5, -13, -2, 6), (8, 9, 11, 9),
    (-1, 5, -1, 7), (11, -9, 6, -6), (-2, 0, -3, 2), (-10, -4, -4, 1),
    (-1, -1, 1, 2), (-13, -3, -12, 8), (7, 0, 6, 2), (5, -7, 5, -4),
    (-3, -3, -2, -1), (3, 5, 6, 7), (-6, -1, -12, 2), (-3, -9, -1, -5),
    (-8, -11, -7, -8), (2, -5, 1, -1), (6, 5, 3, 14), (-4, 7, -6, 9),
    (1, -14, 3, 10), (6, -2, 3, -1), (-5, -2, -3, -2), (10, -10, 8, 12),
    (3, -1, 3, 3), (-1, -6, -3, 12), (7, -4, 13, 3), (-3, 2, -1, 7),
    (2, -3, -1, 6), (5, -13, 2, -10), (-3, 3, -6, 4), (13, -6, 10, -3),
    (-6, -7, -5, 0), (9, 4, 12, 8), (-2, 9, -1, 12), (-9, -11, -4, -8),
    (4, -7, 2, -5), (-4, 5, -12, 7), (-1, -1, -3, 0), (1, -12, 1, -7),
    (5, 2, 4, 5), (0, -4, 1, -1), (-14, 0, -9, 2), (5, 2, 14, 2),
    (0, 0, 4, 3), (-10, 0, -7, 8), (0, 3, -3, 14), (3, 4, 4, 6),
    (-4, -1, -8, 4), (-1, -1, -1, 3), (-13, -5, -9, -3), (3, -14, 2, -9),
    (7, -7, 6, 1), (-3, -10, -3, 9), (-8, -8, -3, -3), (5, -4, 1, 0),
    (9, -11, 11, -5), (0, -9, 2, 6), (2, -7, 3, 13), (-1, -2, -1, 1),
    (1, -7, 2, -5), (3, 5, 10, 9), (0, -7, -3, 0), (-2, -3, -7, 11),
    (-1, -14, -3, -9), (-10, -5, -2, 4), (1, 1, 0, 7), (10, -5, 4, -3),
    (-10, -9, -12, 7), (-4, 10, -6, 13), (-4, -5, -5, 4), (12, 0, 11, 3),
    (6, -11, 5, -8), (-12, -2, -6, 0), (-6, 0, -2, 1), (1, -1, 3, -1),
    (2, -5, 0, 8), (6, 7, 10, 10), (1, -7, 0, -5), (-2, -11, -2, 12),
    (-6, 6, -9, 10), (-2, -4, 0, -1), (9, 3, 4, 5), (-9, -11, -4, -3),
    (8, 1, 10, 4), (4, -4, 3, 3), (0, 0, -3, 6), (-3, 4, -4, 8),
    (2, 1, 3, 3), (8, -12, 5, -10), (-8, 4, -13, 6), (-4, -13, -2, -7),
    (3, 2, 3, 14), (7, -2, 10, -2), (-14, -3, -12, -1), (-5, 3, -9, 4),
    (-5, -6, -2, -5), (-3, 11, -3, 13), (1, 3, 3, 7), (10, -5, 9, -2),
    (2, -4, 3, 1), (-1, -1, -3, 3), (5, -9, 3, -5), (-2, -9, -3, -2),
    (-9, -3, -11, -2), (4, -3, 2, -2), (11, 5, 13, 6), (-4, -10, -6, 13),
    (-10, -10, -2, 5), (6, 2, 6, 8), (0, -8, 0, 13), (-4, -1, -6, 0),
    (0, -11, -1, 7), (-3, -1, 0, 1), (1, -5, -1, 0), (13, -4, 9, -3),
    (7, 0, 5, 2), (-13, 5, -11, 6), (3, -14, 1, -7), (-9, -4, -9, 3),
    (1, -1, 1, 1), (-3, -1, -6, 8), (8, 9, 8, 11), (-11, 3, -12, 8),
    (-1, -7, 1, 8), (7, -12, 2, 5), (-9, -1, -5, 1), (-1, -1, -1, 6),
    (-5, 5, -6, 11), (13, -5, 14, 1), (3, 1, 6, 3), (-1, -11, 3, -4),
    (-2, -5, -3, 2), (-11, -8, -9, -5), (-6, 2, -4, 2), (-1, -13, -1, -10),
    (3, 8, 7, 12), (0, -4, 0, -2), (4, -6, 4, 8), (10, -4, 6, 0),
    (-7, -5, -6, 0), (-3, -1, -1, -1), (-3, -10, -1, 5), (-6, -11, -6, -8),
    (1, 5, 0, 7), (3, -1, 1, 2), (7, -3, 3, -2), (-6, 0, -5, 5),
    (8, -6, 11, -2), (-12, -4, -7, -2), (5, 1, 7, 5), (2, -10, 3, 14),
    (0, 6, -3, 12), (8, -12, 5, -5), (-8, -4, -3, -1), (2, 1, 0, 5),
    (-2, -1, 0, 3), (-8, -12, -5, -9), (-9, 1, -13, 6), (6, 6, 8, 9),
    (-4, 2, -8, 4), (1, 2, 3, 5), (2, -6, 3, 0), (-3, -3, -5, 2),
    (5, -8, 3, -3), (1, -1, 5, -1), (-4, -12, 0, -4), (-3, -5, 0, 2),
    (-13, -1, -7, 2), (11, 3, 13, 5), (2, -5, 2, 9), (13, -1, 2, 4),
    (-3, 6, -8, 11), (-4, -13, -4, 10), (2, -14, 3, 14), (-3, -7, -2, -2),
    (10, -10, 7, -7), (-1, -7, -2, 7), (1, -14, 3, 4), (-7, -6, -5, -4),
    (-2, 2, 0, 8), (5, 10, 4, 13), (-1, 1, -5, 6), (-9, -6, -12, 4),
)  # fmt: skip


RADIUS = 15
"""Of the disk for the orientation, and of the sampling pattern, pixels (Rublee et al.: ORB, 2011)."""
BLUR_RADIUS = 3
"""Of the Gaussian filter before the tests, pixels: 7 x 7 as in the ORB of OpenCV."""
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
    """Compute the angle from each keypoint to the intensity centroid of the disk around it.

    The moments are whole numbers below 2^24, hence exact.

    Args:
        pixels: flattened packed pyramids.
        positions: of the keypoints in the pixels.
        stride: length of a row of pixels.

    Returns:
        Radians in [-pi, pi], from x towards y; 0 on a uniform patch.
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


@lru_cache(maxsize=16)
def rotated_offsets(
    points: tuple[tuple[int, int], ...], stride: int, device: torch.device
) -> Int[Tensor, "256 S"]:
    """Compute flat offsets of points (x, y) around a keypoint, rotated by every angle and rounded."""
    angles = torch.arange(ANGLE_BINS, dtype=torch.float64, device="cpu") * (2 * math.pi / ANGLE_BINS)
    cos, sin = angles.cos()[:, None], angles.sin()[:, None]
    x, y = torch.tensor(points, dtype=torch.float64, device="cpu").unbind(-1)
    offsets = (x * sin + y * cos).round() * stride + (x * cos - y * sin).round()
    return offsets.to(device=device, dtype=torch.int32)


def sample_rotated(
    blurred: Int[Tensor, " R"],
    positions: Int[Tensor, " N"],
    angles: Float[Tensor, " N"],
    stride: int,
    points: tuple[tuple[int, int], ...],
) -> Int[Tensor, "N S"]:
    """Sample a blurred image at points around each keypoint, rotated by its angle.

    Args:
        blurred: from `blur`.
        positions: of the keypoints in the image before blurring.
        angles: radians.
        stride: length of a row of pixels.
        points: (x, y) of the samples, in pixels of the level.
    """
    bins = torch.round(angles * (ANGLE_BINS / (2 * math.pi))).to(torch.int64) % ANGLE_BINS
    origins = (positions - BLUR_RADIUS * (stride + 1)).to(torch.int32)
    samples = rotated_offsets(points, stride, blurred.device).index_select(0, bins).add_(origins[:, None])
    return blurred.index_select(0, samples.view(-1)).view(samples.shape)


# The first ends of all tests, then the second ends.
_ENDS = tuple((test[2 * end], test[2 * end + 1]) for end in (0, 1) for test in PATTERN)


def describe(
    blurred: Int[Tensor, " R"], positions: Int[Tensor, " N"], angles: Float[Tensor, " N"], stride: int
) -> UInt8[Tensor, "N 32"]:
    """Describe keypoints by 256 brightness comparisons, rotated by their angles; arguments as for `sample_rotated`.

    Keypoints must lie RADIUS + BLUR_RADIUS inside their level.
    """
    first, second = sample_rotated(blurred, positions, angles, stride, _ENDS).chunk(2, dim=1)
    return pack_bits(first < second)
