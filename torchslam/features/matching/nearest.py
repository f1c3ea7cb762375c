"""Who is nearest to whom, where every row may match every row: by exact Hamming distance, or by cosine."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchslam.features.matching.hamming import sign_products

# Bits as +-64 have the product 2^20 - 2^13 * distance: the 13 bits below hold an index, and one maximum finds both.
_AMPLITUDE = 64
_INDEX_BITS = 13
_MASKED = -(2**22)  # lowers a key below every valid one and keeps it exact in float32


class Nearest(NamedTuple):
    """For each of N1 rows its nearest (B, N1) column, the distance to it, whether there is one that may match, whether
    no other row is nearer to that column, and the distance to the second nearest, where it was asked for."""

    column: Tensor
    distance: Tensor
    found: Tensor
    mutual: Tensor
    second: Tensor | None


def _possible(mask_1: Tensor, mask_2: Tensor, allowed: Tensor | None) -> Tensor:
    """(B, N1, N2) bool, the pairs that may match."""
    possible = mask_1[:, :, None] & mask_2[:, None, :]
    return possible if allowed is None else possible & allowed


def nearest_by_bits(
    descriptors_1: Tensor,
    descriptors_2: Tensor,
    mask_1: Tensor,
    mask_2: Tensor,
    allowed: Tensor | None,
    with_second: bool,
) -> Nearest:
    """Exact nearest neighbours by Hamming distance; needs two maxima over the matrix and one more for the second."""
    keys = sign_products(descriptors_1, descriptors_2, _AMPLITUDE)
    bits, index_bits = 8 * descriptors_1.shape[-1], _INDEX_BITS
    columns = keys.shape[2]
    if columns > 1 << _INDEX_BITS:  # more columns than the free bits can number: wider keys
        index_bits = columns.bit_length()
        keys = keys.to(torch.int64) << (index_bits - _INDEX_BITS)
    highest = (1 << index_bits) - 1
    masked = _MASKED << (index_bits - _INDEX_BITS)
    if allowed is not None:
        keys.masked_fill_(~allowed, masked)
    numbers = highest - torch.arange(columns, device=keys.device) + masked * ~mask_2
    keys += numbers.to(keys.dtype)[:, None, :]
    keys += (masked * ~mask_1).to(keys.dtype)[:, :, None]

    def distance(key: Tensor) -> Tensor:
        return (bits // 2 - (key.to(torch.int64) >> index_bits)).float()

    best, column_best = keys.amax(2), keys.amax(1)
    column, nearest, second = highest - (best.to(torch.int64) & highest), distance(best), None
    if with_second:
        keys.scatter_(2, column[..., None], 2 * masked)
        second = distance(keys.amax(2))
        second = torch.where(second > bits, torch.inf, second)
    mutual = nearest <= distance(column_best).gather(1, column)
    return Nearest(column, nearest, nearest <= bits, mutual, second)


def nearest_by_cosine(
    similarity: Tensor, mask_1: Tensor, mask_2: Tensor, allowed: Tensor | None, with_second: bool
) -> Nearest:
    """Nearest neighbours by cosine similarity (B, N1, N2); distances keep their graph."""
    values = similarity.detach().masked_fill(~_possible(mask_1, mask_2, allowed), -torch.inf)
    best, column = values.max(2)
    mutual = best >= values.amax(1).gather(1, column)
    second = 1 - values.scatter(2, column[..., None], -torch.inf).amax(2) if with_second else None
    nearest = 1 - similarity.gather(2, column[..., None])[..., 0]
    return Nearest(column, nearest, best > -torch.inf, mutual, second)


def dual_softmax(
    logits: Tensor, column: Tensor, mask_1: Tensor, mask_2: Tensor, allowed: Tensor | None
) -> Tensor:
    """Product of the softmax over columns and over rows at (row, column[row]): (B, N1, N2), (B, N1) -> (B, N1)."""
    low = torch.finfo(logits.dtype).min / 2
    logits = logits.masked_fill(~_possible(mask_1, mask_2, allowed), low)
    both = logits.softmax(2) * logits.softmax(1)
    return both.gather(2, column[..., None])[..., 0]
