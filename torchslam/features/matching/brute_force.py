"""Matching of descriptors, all against all or among given pairs, and helpers of all matching.

Binary descriptors (uint8) are compared by exact Hamming distance, float descriptors by 1 - cosine. Of equal distances
the lower index wins, so results do not depend on the device. `index_select` is several times faster on the CPU than
indexing.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from torchslam.features.contract import NORMALIZE, are_unit_or_zero
from torchslam.features.matching.cosine import SortedDescriptors, nearest_by_cosine, nearest_of_sorted
from torchslam.features.matching.hamming import hamming, hamming_between, nearest_by_hamming
from torchslam.features.matching.nearest import NearestNeighbors
from torchslam.geometry.precision import check_positive, without_autocast
from torchslam.types import Features, Matches
from torchslam.utils.indexing import true_indices

SAME_SCALE = 0.05
"""Relative difference up to which two scales belong to one pyramid level."""


@without_autocast
def match(
    features_1: Features,
    features_2: Features,
    ratio: float | None = 0.8,
    mutual: bool = True,
    max_distance: float | None = 64,
    temperature: float | None = None,
    allowed: Bool[Tensor, "B N1 N2"] | None = None,
) -> Matches:
    """Match two sets of features by nearest descriptors, all against all.

    Each keypoint of the second set is used at most once: the lowest distance wins, then the lowest index. Distances of
    float descriptors carry gradients.

    Args:
        features_1: batch of sets of N1 keypoints; rows outside their mask never match.
        features_2: batch of sets of N2 keypoints.
        ratio: the nearest must be closer than `ratio` times the second nearest; None: no ratio test.
        mutual: require that the row is a nearest neighbor of its match in turn.
        max_distance: Hamming bits, or 1 - cosine for floats; None: no limit.
        temperature: if given, `weights` are the dual softmax of -distance / temperature at the matches, with gradients
            to float descriptors (Sun et al.: LoFTR, 2021, eq. 2).
        allowed: pairs that may match; None: all.

    Returns:
        Matches with M = N1 rows; row i is keypoint i of the first set.

    Raises:
        ValueError: The descriptors of the two sets differ in type or length, or are not of unit length, or an option is
            not above zero.
    """
    check_positive(ratio=ratio, temperature=temperature)
    descriptors_1, descriptors_2 = features_1.descriptors, features_2.descriptors
    check_descriptors(descriptors_1, descriptors_2)
    batch, rows, columns = len(descriptors_1), descriptors_1.shape[1], descriptors_2.shape[1]
    if rows == 0 or columns == 0:
        return empty_matches(batch, rows, descriptors_1.device)
    similarity, masks = None, (features_1.mask, features_2.mask, allowed)
    if descriptors_1.dtype == torch.uint8:
        nearest = nearest_by_hamming(descriptors_1, descriptors_2, *masks, with_second=ratio is not None)
        if temperature is not None:
            similarity = -hamming(descriptors_1, descriptors_2).float()
    else:
        nearest = nearest_by_cosine(
            descriptors_1, descriptors_2, *masks, ratio is not None, max_distance if mutual else None
        )
        if temperature is not None:
            similarity = descriptors_1 @ descriptors_2.mT
    mask = _accepted(nearest, columns, ratio, mutual, max_distance)
    weights = None
    if temperature is not None and similarity is not None:
        weights = _dual_softmax(similarity / temperature, nearest.column, *masks) * mask
    return to_matches(nearest.column, nearest.distance, mask, weights)


def match_sorted(
    one: SortedDescriptors,
    other: SortedDescriptors,
    ratio: float | None,
    max_distance: float,
    allowed: Callable[[Tensor, Tensor], Tensor] | None = None,
) -> Matches:
    """`match`, mutually, of sorted descriptors of two images: where an image is matched with many, it is sorted once.

    `allowed`: which of some rows and columns, (R, C), may match; None: all.
    """
    nearest = nearest_of_sorted(one, other, max_distance, allowed)
    mask = _accepted(nearest, len(other.all), ratio, True, max_distance)
    return to_matches(nearest.column, nearest.distance, mask)


def _accepted(
    nearest: NearestNeighbors, columns: int, ratio: float | None, mutual: bool, max_distance: float | None
) -> Bool[Tensor, "B N1"]:
    """The rows that match their nearest column, by the options of `match`."""
    mask = nearest.found
    if max_distance is not None:
        mask = mask & (nearest.distance <= max_distance)
    if ratio is not None and nearest.second is not None:
        mask = mask & (nearest.distance < ratio * nearest.second)
    if mutual:
        mask = mask & nearest.mutual
    return one_to_one(nearest.column, nearest.distance.detach(), mask, columns)


def _dual_softmax(
    logits: Float[Tensor, "B N1 N2"],
    column: Int[Tensor, "B N1"],
    mask_1: Bool[Tensor, "B N1"],
    mask_2: Bool[Tensor, "B N2"],
    allowed: Bool[Tensor, "B N1 N2"] | None,
) -> Float[Tensor, "B N1"]:
    """Compute the product of the softmax over columns and over rows at (row, column[row])."""
    low = torch.finfo(logits.dtype).min / 2
    possible = mask_1[:, :, None] & mask_2[:, None, :]
    logits = logits.masked_fill(~(possible if allowed is None else possible & allowed), low)
    both = logits.softmax(2) * logits.softmax(1)
    return both.gather(2, column[..., None])[..., 0]


@without_autocast
def match_pairs(
    descriptors_1: Shaped[Tensor, "N1 D"],
    descriptors_2: Shaped[Tensor, "N2 D"],
    rows: Int[Tensor, " M"],
    columns: Int[Tensor, " M"],
    max_distance: float,
) -> tuple[Int[Tensor, " R"], Int[Tensor, " R"]]:
    """Match mutual nearest descriptors among given pairs.

    Args:
        descriptors_1: 32 uint8 or unit-length floats.
        descriptors_2: as `descriptors_1`.
        rows: of the pairs that may match.
        columns: of these pairs.
        max_distance: Hamming bits, or 1 - cosine for floats.

    Returns:
        Rows, ascending, and columns of the matches.

    Raises:
        ValueError: The descriptors differ in type or length, or are not of unit length.
    """
    check_descriptors(descriptors_1[None], descriptors_2[None])
    distances = pair_distances(descriptors_1, rows, descriptors_2, columns)
    rows, columns, distances = masked_rows(distances <= max_distance, rows, columns, distances)
    column, found, _ = best_per_row(rows, columns, distances, None, len(descriptors_1), None)
    row, _, _ = best_per_row(columns, rows, distances, None, len(descriptors_2), None)
    kept = torch.nonzero(found).squeeze(1)
    kept = kept[row[column[kept]] == kept]
    return kept, column[kept]


def masked_rows(mask: Bool[Tensor, " N"], *columns: Shaped[Tensor, " N"]) -> list[Shaped[Tensor, " R"]]:
    """Select the masked rows of columns."""
    rows = true_indices(mask)
    return [values.index_select(0, rows) for values in columns]


def pair_distances(
    descriptors_1: Shaped[Tensor, "N1 D"],
    rows: Int[Tensor, " M"],
    descriptors_2: Shaped[Tensor, "N2 D"],
    columns: Int[Tensor, " M"],
) -> Float[Tensor, " M"]:
    """Compute distances of pairs of rows of two tables, with gradients for floats."""
    if descriptors_1.dtype != torch.uint8:
        return 1 - (descriptors_1.index_select(0, rows) * descriptors_2.index_select(0, columns)).sum(-1)
    return hamming_between(descriptors_1, rows, descriptors_2, columns).float()


def best_per_row(
    row: Int[Tensor, " M"],
    column: Int[Tensor, " M"],
    distances: Float[Tensor, " M"],
    scales: Float[Tensor, " N"] | None,
    rows: int,
    ratio: float | None,
) -> tuple[Int[Tensor, "{rows}"], Bool[Tensor, "{rows}"], Float[Tensor, "{rows}"]]:
    """Find the nearest column of each of `rows` rows among candidate pairs.

    Returns the column of each row, whether it is accepted, and its distance (with its graph). Rows without pairs get
    column 0, not accepted. With `ratio`, the nearest must be closer than that times the nearest other column of its
    scale; `scales` are those of the columns.
    """
    values = distances.detach()
    nearest = _lowest(row, values, rows)
    pair = torch.arange(row.shape[0], device=row.device)
    # Lowest column among equals, then the pair that holds it.
    unset = torch.iinfo(torch.int64).max
    winner_row, winner_column = masked_rows(values == nearest.index_select(0, row), row, column)
    best = row.new_full((rows,), unset).scatter_reduce(0, winner_row, winner_column, "amin")
    chosen = column == best.index_select(0, row)
    best_pair = row.new_zeros(rows).scatter(0, row[chosen], pair[chosen])
    found = best != unset
    best = torch.where(found, best, 0)
    distance = torch.where(found, nearest, torch.inf)
    if distances.requires_grad:
        distance = torch.where(found, distances[best_pair], torch.inf)
    if ratio is not None and scales is not None:
        same = (scales.index_select(0, column) / scales[best].index_select(0, row) - 1).abs() < SAME_SCALE
        rival_row, rival_value = masked_rows(same & ~chosen, row, values)
        second = _lowest(rival_row, rival_value, rows)
        found = found & (nearest < ratio * second)
    return best, found, distance


def _lowest(
    groups: Int[Tensor, " N"], values: Float[Tensor, " N"], num_groups: int
) -> Float[Tensor, "{num_groups}"]:
    """The lowest value of each group, infinity for empty groups."""
    return values.new_full((num_groups,), torch.inf).scatter_reduce(0, groups, values, "amin")


def one_to_one(
    column: Int[Tensor, "B M"], distances: Float[Tensor, "B M"], mask: Bool[Tensor, "B M"], columns: int
) -> Bool[Tensor, "B M"]:
    """Keep of the masked rows that share a column the one of lowest distance, then of lowest index."""
    batch, rows = column.shape
    offset = torch.arange(batch, device=column.device)[:, None] * columns
    target = (column + offset).flatten()
    distances = torch.where(mask, distances, torch.inf).flatten()
    winner = mask.flatten() & (distances == _lowest(target, distances, batch * columns)[target])
    row = torch.arange(batch * rows, device=column.device)
    first = row.new_full((batch * columns,), batch * rows)
    first = first.scatter_reduce(0, target[winner], row[winner], "amin")
    return (winner & (first[target] == row)).view(batch, rows)


def to_matches(
    column: Int[Tensor, "B M"],
    distances: Float[Tensor, "B M"],
    mask: Bool[Tensor, "B M"],
    weights: Float[Tensor, "B M"] | None = None,
) -> Matches:
    """Build matches of row i with column[i] where the mask is set; index and distance are 0 elsewhere."""
    row = torch.arange(column.shape[1], device=column.device).expand_as(column)
    row, column = torch.where(mask, row, 0), torch.where(mask, column, 0)
    return Matches(row, column, torch.where(mask, distances, torch.zeros_like(distances)), mask, weights)


def empty_matches(batch: int, rows: int, device: torch.device) -> Matches:
    """Build matches of which no row is valid."""
    index = torch.zeros(batch, rows, dtype=torch.int64, device=device)
    return Matches(index, index, index.float(), index.bool())


def check_descriptors(descriptors_1: Tensor, descriptors_2: Tensor) -> None:
    """Raise a ValueError unless descriptors are two (B, N, D) of one type, floats of unit length."""
    is_same = descriptors_1.dtype == descriptors_2.dtype
    is_same &= descriptors_1.shape[::2] == descriptors_2.shape[::2]  # batch and length
    if not (descriptors_1.dim() == descriptors_2.dim() == 3 and is_same):
        raise ValueError(
            f"descriptors must be two (B, N, D) of one type, got {tuple(descriptors_1.shape)} {descriptors_1.dtype} "
            f"and {tuple(descriptors_2.shape)} {descriptors_2.dtype}"
        )
    for descriptors in (descriptors_1, descriptors_2) if descriptors_1.is_floating_point() else ():
        if not bool(are_unit_or_zero(descriptors).all()):
            raise ValueError(
                f"descriptors must be finite and have unit length, or be zero where there is no keypoint; {NORMALIZE}"
            )
