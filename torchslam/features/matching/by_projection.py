"""Matching guided by predicted pixels: ORB-SLAM's search by projection."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchslam.features.matching.brute_force import (
    best_of_pairs,
    check_descriptors,
    no_matches,
    one_to_one,
    pair_distances,
    take_rows,
    to_matches,
    where_rows,
)
from torchslam.features.matching.hamming import hamming_between
from torchslam.features.matching.radius_search import nearest_of_pairs, pairs_within_radius
from torchslam.geometry.precision import full_precision
from torchslam.types import Features, Matches

SCALE_TOLERANCE = 1.5
"""Largest factor between the predicted and the found scale of a keypoint."""
_MAX_PIXEL = 1e6  # points projected farther outside of the image do not match


@full_precision
def match_by_projection(
    descriptors: Tensor,
    pixels: Tensor,
    radius: Tensor | float,
    features: Features,
    mask: Tensor | None = None,
    scales: Tensor | None = None,
    angles: Tensor | None = None,
    ratio: float | None = 0.9,
    max_distance: float | None = 64,
    scale_tolerance: float = SCALE_TOLERANCE,
    angle_tolerance: float = math.pi / 6,
) -> Matches:
    """Match points of known descriptors to the keypoints near their predicted pixels.

    Every keypoint is used at most once, by the point of lowest distance, then of lowest index.

    Args:
        descriptors: (B, M, 32) uint8 or (B, M, D) unit-length floats, of the points.
        pixels: (B, M, 2) predicted pixels.
        radius: (B, M) or one number, pixels.
        features: keypoints to match, (B, N, ...).
        mask: (B, M) points that take part; None: all.
        scales: (B, M) predicted `Features.scales`; a keypoint's may differ by the factor `scale_tolerance`.
        angles: (B, M) predicted angles in radians; a keypoint's may differ by `angle_tolerance`.
        ratio: the nearest must be closer than `ratio` times the nearest other keypoint of its scale in the window
            (keypoints of other levels mostly see the same corner); None: no ratio test.
        max_distance: Hamming bits, or 1 - cosine for floats; None: no limit.
        scale_tolerance: largest factor between a predicted and a found scale.
        angle_tolerance: largest difference of a predicted and a found angle, radians.

    Returns:
        Matches with M rows: row i is point i, `indices_2` its keypoint.

    Raises:
        ValueError: The descriptors differ in type or length, or are not of unit length.
    """
    check_descriptors(descriptors, features.descriptors)
    batch, rows, columns = len(pixels), pixels.shape[1], features.keypoints.shape[1]
    if rows == 0 or columns == 0:
        return no_matches(batch, rows, pixels.device)
    radius = torch.as_tensor(radius, dtype=pixels.dtype, device=pixels.device).expand(batch, rows)
    is_near = pixels.detach().abs().amax(-1) < _MAX_PIXEL  # false for NaN as well
    mask = is_near if mask is None else mask & is_near
    at = torch.where(mask[..., None], pixels.detach(), 0)
    around = torch.where(mask, radius.detach(), 0)
    row, column = pairs_within_radius(at, around, mask, features.keypoints.detach(), features.mask)

    keypoint_scales = features.scales.detach().flatten()
    if scales is not None:
        factor = take_rows(keypoint_scales, column) / take_rows(scales.detach().flatten(), row)
        row, column = where_rows((factor <= scale_tolerance) & (factor * scale_tolerance >= 1), row, column)
    if angles is not None:
        turn = take_rows(features.angles.detach().flatten(), column) - take_rows(
            angles.detach().flatten(), row
        )
        row, column = where_rows(torch.cos(turn) >= math.cos(angle_tolerance), row, column)

    pairs = descriptors.flatten(0, 1), row, features.descriptors.flatten(0, 1), column
    if descriptors.dtype == torch.uint8:
        bits = 8 * descriptors.shape[-1]
        limit = bits if max_distance is None else min(max_distance, bits)
        distances = hamming_between(*pairs)
        found = nearest_of_pairs(row, column, distances, batch * rows, keypoint_scales, ratio, limit)
        return _scattered(*found, batch, rows, columns)
    distances = pair_distances(*pairs)
    best, accepted, distance = best_of_pairs(row, column, distances, keypoint_scales, batch * rows, ratio)
    if max_distance is not None:
        accepted = accepted & (distance <= max_distance)
    local = (best % columns).view(batch, rows)
    distance, accepted = distance.view(batch, rows), accepted.view(batch, rows)
    return to_matches(local, distance, one_to_one(local, distance.detach(), accepted, columns))


def _scattered(
    first: Tensor, second: Tensor, distance: Tensor, batch: int, rows: int, columns: int
) -> Matches:
    """Matches of flat rows b * M + i (m,) with flat columns b * N + j (m,)."""
    mask = torch.zeros(batch * rows, dtype=torch.bool, device=first.device).index_fill_(0, first, True)
    column = first.new_zeros(batch * rows).index_copy_(0, first, second % columns)
    distances = distance.new_zeros(batch * rows).index_copy_(0, first, distance)
    return to_matches(column.view(batch, rows), distances.view(batch, rows), mask.view(batch, rows))
