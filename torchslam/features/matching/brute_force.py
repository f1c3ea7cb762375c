"""Matching of descriptors: every row against every row, and guided by where a point should appear.

Binary descriptors (uint8) are compared by exact Hamming distance, float descriptors by 1 - cosine. Of equal distances
the lower index wins, so results do not depend on the device.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchslam.features.contract import NORMALIZE, are_comparable
from torchslam.features.matching.hamming import hamming, hamming_between
from torchslam.features.matching.nearest import dual_softmax, nearest_by_bits, nearest_by_cosine
from torchslam.features.matching.radius_search import SAME_SCALE, nearest_bits, window_pairs
from torchslam.geometry.precision import full_precision
from torchslam.types import Features, Matches

SCALE_TOLERANCE = 1.5
"""Factor between the scale that is expected of a keypoint and the one that it has."""
_FAR = 1e6  # pixels: no point so far outside of the image is looked for
_PIECE = 1 << 13  # pairs whose bits are counted at once: their words stay in the cache


@full_precision
def match(
    features_1: Features,
    features_2: Features,
    ratio: float | None = 0.8,
    mutual: bool = True,
    max_distance: float | None = 64,
    temperature: float | None = None,
    allowed: Tensor | None = None,
) -> Matches:
    """Nearest neighbours between two sets of features, all against all.

    features_1, features_2: batches of the same size B; rows outside their masks never match
    ratio:        the nearest must be closer than `ratio` times the second nearest; None: no such test
    mutual:       the row must be a nearest neighbour of its match in turn
    max_distance: Hamming bits, or 1 - cosine for floats; None: no limit
    temperature:  where given, `weights` are the dual softmax of -distance / temperature at the matches, with gradients
                  to float descriptors (Sun et al.: LoFTR, 2021, eq. 2)
    allowed:      (B, N1, N2) bool, pairs that may match at all; None: all

    Returns Matches with M = N1 rows, row i being keypoint i of the first set. Each keypoint of the second set is used
    at most once: the lowest distance wins, then the lowest index. Distances of float descriptors carry gradients.
    Raises ValueError if the descriptors do not go together.
    """
    descriptors_1, descriptors_2 = features_1.descriptors, features_2.descriptors
    _check_descriptors(descriptors_1, descriptors_2)
    batch, rows, columns = len(descriptors_1), descriptors_1.shape[1], descriptors_2.shape[1]
    if rows == 0 or columns == 0:
        return _no_matches(batch, rows, descriptors_1.device)
    similarity, masks = None, (features_1.mask, features_2.mask, allowed)
    if descriptors_1.dtype == torch.uint8:
        nearest = nearest_by_bits(descriptors_1, descriptors_2, *masks, with_second=ratio is not None)
        if temperature is not None:
            similarity = -hamming(descriptors_1, descriptors_2).float()
    else:
        similarity = descriptors_1 @ descriptors_2.mT
        nearest = nearest_by_cosine(similarity, *masks, with_second=ratio is not None)
    mask = nearest.found
    if max_distance is not None:
        mask = mask & (nearest.distance <= max_distance)
    if ratio is not None and nearest.second is not None:
        mask = mask & (nearest.distance < ratio * nearest.second)
    if mutual:
        mask = mask & nearest.mutual
    mask = _one_to_one(nearest.column, nearest.distance.detach(), mask, columns)
    weights = None
    if temperature is not None and similarity is not None:
        weights = dual_softmax(similarity / temperature, nearest.column, *masks) * mask
    return _matches(nearest.column, nearest.distance, mask, weights)


@full_precision
def match_projected(
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
    """Match points with known descriptors to the keypoints near their predicted pixels.

    descriptors: (B, M, 32) uint8 or (B, M, D) unit-length floats, of the points
    pixels:      (B, M, 2) where the points should appear; radius: (B, M) or one number, pixels
    features:    keypoints to match, (B, N, ...)
    mask:        (B, M) points that take part
    scales:      (B, M) predicted `Features.scales`; a keypoint's may differ by the factor `scale_tolerance`
    angles:      (B, M) predicted radians; a keypoint's may differ by `angle_tolerance`
    ratio:       the nearest must be closer than `ratio` times the nearest of the other keypoints of its scale in the
                 window (rivals on other levels mostly see the same corner); None: no such test
    max_distance: Hamming bits, or 1 - cosine for floats; None: no limit

    Returns Matches with M rows: row i is point i, `indices_2` its keypoint; every keypoint is used at most once, by the
    point of lowest distance, then lowest index. Raises ValueError if the descriptors do not go together.
    """
    _check_descriptors(descriptors, features.descriptors)
    batch, rows, columns = len(pixels), pixels.shape[1], features.keypoints.shape[1]
    if rows == 0 or columns == 0:
        return _no_matches(batch, rows, pixels.device)
    radius = torch.as_tensor(radius, dtype=pixels.dtype, device=pixels.device).expand(batch, rows)
    is_near = pixels.detach().abs().amax(-1) < _FAR  # false for NaN as well
    mask = is_near if mask is None else mask & is_near
    at = torch.where(mask[..., None], pixels.detach(), 0)
    around = torch.where(mask, radius.detach(), 0)
    row, column = window_pairs(at, around, mask, features.keypoints.detach(), features.mask)

    keypoint_scales = features.scales.detach().flatten()
    if scales is not None:
        factor = _take(keypoint_scales, column) / _take(scales.detach().flatten(), row)
        row, column = _where((factor <= scale_tolerance) & (factor * scale_tolerance >= 1), row, column)
    if angles is not None:
        turn = _take(features.angles.detach().flatten(), column) - _take(angles.detach().flatten(), row)
        row, column = _where(torch.cos(turn) >= math.cos(angle_tolerance), row, column)

    distances = _pair_distances(descriptors.flatten(0, 1), row, features.descriptors.flatten(0, 1), column)
    if descriptors.dtype == torch.uint8:
        bits = 8 * descriptors.shape[-1]
        limit = bits if max_distance is None else min(max_distance, bits)
        first, second, distance = nearest_bits(
            row, column, distances.long(), batch * rows, keypoint_scales, ratio, limit
        )
        return _matches_of(first, second, distance, batch, rows, columns)
    best, accepted, distance = _best_of_pairs(row, column, distances, keypoint_scales, batch * rows, ratio)
    if max_distance is not None:
        accepted = accepted & (distance <= max_distance)
    local = (best % columns).view(batch, rows)
    distance, accepted = distance.view(batch, rows), accepted.view(batch, rows)
    return _matches(local, distance, _one_to_one(local, distance.detach(), accepted, columns))


@full_precision
def match_pairs(
    descriptors_1: Tensor, descriptors_2: Tensor, rows: Tensor, columns: Tensor, max_distance: float
) -> tuple[Tensor, Tensor]:
    """Who of some pairs are each other's nearest: rows (m,), ascending, and columns (m,).

    descriptors_1, descriptors_2: (N1, 32) uint8 or (N1, D) unit-length floats, likewise (N2, ...)
    rows, columns: (P,), (P,) the pairs that may match; max_distance: Hamming bits, or 1 - cosine for floats

    Raises ValueError if the descriptors do not go together.
    """
    _check_descriptors(descriptors_1[None], descriptors_2[None])
    distances = _pair_distances(descriptors_1, rows, descriptors_2, columns)
    near = torch.nonzero(distances <= max_distance).squeeze(1)
    rows, columns, distances = _take(rows, near), _take(columns, near), _take(distances, near)
    column, found, _ = _best_of_pairs(rows, columns, distances, None, len(descriptors_1), None)
    row, _, _ = _best_of_pairs(columns, rows, distances, None, len(descriptors_2), None)
    kept = torch.nonzero(found).squeeze(1)
    kept = kept[row[column[kept]] == kept]
    return kept, column[kept]


def _take(values: Tensor, rows: Tensor) -> Tensor:
    """values[rows], several times faster on the CPU."""
    return values.index_select(0, rows)


def _where(mask: Tensor, first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
    """The masked rows of two columns."""
    rows = mask.nonzero().squeeze(1)
    return _take(first, rows), _take(second, rows)


def _pair_distances(descriptors_1: Tensor, rows: Tensor, descriptors_2: Tensor, columns: Tensor) -> Tensor:
    """Distances of pairs (P,), (P,) of rows of (N1, D) and (N2, D): float32 for bits, with gradients for floats."""
    if descriptors_1.dtype != torch.uint8:
        return 1 - (_take(descriptors_1, rows) * _take(descriptors_2, columns)).sum(-1)
    pieces = zip(rows.split(_PIECE), columns.split(_PIECE), strict=True)
    distances = [hamming_between(descriptors_1, r, descriptors_2, c).float() for r, c in pieces]
    return distances[0] if len(distances) == 1 else torch.cat(distances)


def _best_of_pairs(
    row: Tensor, column: Tensor, distances: Tensor, scales: Tensor | None, rows: int, ratio: float | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Of each row the nearest column, whether it passes the ratio test, and its distance (with its graph): (rows,).

    The ratio is taken to the nearest other column of the same scale. Rows without pairs get column 0, not accepted.
    """
    values = distances.detach()
    nearest = _lowest(row, values, rows)
    pair = torch.arange(row.shape[0], device=row.device)
    winner = values == _take(nearest, row)
    # Lowest column among equals, then the pair that holds it.
    unset = torch.iinfo(torch.int64).max
    winner_row, winner_column = _where(winner, row, column)
    best = row.new_full((rows,), unset).scatter_reduce(0, winner_row, winner_column, "amin")
    chosen = column == _take(best, row)
    best_pair = row.new_zeros(rows).scatter(0, row[chosen], pair[chosen])
    found = best != unset
    best = torch.where(found, best, 0)
    distance = torch.where(found, nearest, torch.inf)
    if distances.requires_grad:
        distance = torch.where(found, distances[best_pair], torch.inf)
    if ratio is not None and scales is not None:
        same = (_take(scales, column) / _take(scales[best], row) - 1).abs() < SAME_SCALE
        rival_row, rival_value = _where(same & ~chosen, row, values)
        second = _lowest(rival_row, rival_value, rows)
        found = found & (nearest < ratio * second)
    return best, found, distance


def _lowest(groups: Tensor, values: Tensor, num_groups: int) -> Tensor:
    """The lowest value of each group: (P,) int64, (P,) -> (num_groups,), infinity for empty groups."""
    return values.new_full((num_groups,), torch.inf).scatter_reduce(0, groups, values, "amin")


def _one_to_one(column: Tensor, distances: Tensor, mask: Tensor, columns: int) -> Tensor:
    """Keep of the masked rows that share a column the one of lowest distance, then of lowest index: (B, M) each."""
    batch, rows = column.shape
    offset = torch.arange(batch, device=column.device)[:, None] * columns
    target = (column + offset).flatten()
    distances = torch.where(mask, distances, torch.inf).flatten()
    winner = mask.flatten() & (distances == _lowest(target, distances, batch * columns)[target])
    row = torch.arange(batch * rows, device=column.device)
    first = row.new_full((batch * columns,), batch * rows)
    first = first.scatter_reduce(0, target[winner], row[winner], "amin")
    return (winner & (first[target] == row)).view(batch, rows)


def _matches(column: Tensor, distances: Tensor, mask: Tensor, weights: Tensor | None = None) -> Matches:
    """Matches of row i with column[i] where the mask is set; index and distance 0 elsewhere."""
    row = torch.arange(column.shape[1], device=column.device).expand_as(column)
    zero = torch.zeros_like(distances)
    return Matches(
        torch.where(mask, row, 0),
        torch.where(mask, column, 0),
        torch.where(mask, distances, zero),
        mask,
        weights,
    )


def _matches_of(
    first: Tensor, second: Tensor, distance: Tensor, batch: int, rows: int, columns: int
) -> Matches:
    """Matches of flat rows b * M + i (m,) with flat columns b * N + j (m,)."""
    mask = torch.zeros(batch * rows, dtype=torch.bool, device=first.device).index_fill_(0, first, True)
    column = first.new_zeros(batch * rows).index_copy_(0, first, second % columns)
    distances = distance.new_zeros(batch * rows).index_copy_(0, first, distance)
    return _matches(column.view(batch, rows), distances.view(batch, rows), mask.view(batch, rows))


def _no_matches(batch: int, rows: int, device: torch.device) -> Matches:
    index = torch.zeros(batch, rows, dtype=torch.int64, device=device)
    return Matches(index, index, index.float(), index.bool())


def _check_descriptors(descriptors_1: Tensor, descriptors_2: Tensor) -> None:
    same = descriptors_1.dtype == descriptors_2.dtype and descriptors_1.shape[-1] == descriptors_2.shape[-1]
    if (
        descriptors_1.dim() != 3
        or descriptors_2.dim() != 3
        or len(descriptors_1) != len(descriptors_2)
        or not same
    ):
        raise ValueError(
            f"descriptors must be two (B, N, D) of one type, got {tuple(descriptors_1.shape)} {descriptors_1.dtype} "
            f"and {tuple(descriptors_2.shape)} {descriptors_2.dtype}"
        )
    for descriptors in (descriptors_1, descriptors_2) if descriptors_1.is_floating_point() else ():
        if not bool(are_comparable(descriptors).all()):
            raise ValueError(
                f"descriptors must be finite and have unit length, or be zero where there is no keypoint; {NORMALIZE}"
            )
