"""Nearest neighbors among candidate pairs, by keys that are compared as numbers."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad

from torchslam.utils.indexing import true_indices

INDEX_BITS = 13
"""Bits of an index in a key: the products of bits as +-64, 2^20 - 2^13 * distance, are multiples of 2^13. Of the 23
bits of a float, 10 remain."""


class NearestNeighbors(NamedTuple):
    """Nearest columns of N1 rows."""

    column: Int[Tensor, "B N1"]
    distance: Float[Tensor, "B N1"]
    found: Bool[Tensor, "B N1"]  # whether any column may match
    mutual: Bool[Tensor, "B N1"]  # whether no other row is nearer to that column
    second: Float[Tensor, "B N1"] | None  # distance of the second nearest column; None if not requested


class Candidates(NamedTuple):
    """The pairs that may match: of the first `rows` and `columns` of both sets, beyond which none is used."""

    mask_1: Bool[Tensor, "B N1"]
    mask_2: Bool[Tensor, "B N2"]
    allowed: Bool[Tensor, "B N1 N2"] | None
    rows: int
    columns: int

    def only(self, keys: Tensor, chunk: slice, lowest: float) -> tuple[Tensor, slice]:
        """The keys of some rows, those of pairs that may not match overwritten, and all columns."""
        masks = zip(self.mask_1[:, chunk], self.mask_2[:, : self.columns], strict=True)
        for element, (own, other) in zip(keys, masks, strict=True):
            element.index_fill_(0, true_indices(~own), lowest)
            element.index_fill_(1, true_indices(~other), lowest)
        if self.allowed is not None:
            keys.masked_fill_(~self.allowed[:, chunk, : self.columns], lowest)
        return keys, slice(0, self.columns)

    def neighbors(
        self, column: Tensor, distance: Tensor, found: Tensor, mutual: Tensor, second: Tensor | None
    ) -> NearestNeighbors:
        """The neighbors of all N1 rows, from those of the first `rows`."""
        tail = 0, self.mask_1.shape[1] - self.rows
        column, found, mutual = (pad(values, tail) for values in (column, found, mutual))
        second = None if second is None else pad(second, tail, value=1.0)
        return NearestNeighbors(column, pad(distance, tail, value=1.0), found, mutual, second)


def best_keys(
    keys_of: Callable[[slice], tuple[Tensor, slice]],
    rows: int,
    columns: int,
    lowest: float,
    at_once: int,
    index_bits: int,
    with_second: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The highest key of each row, its column, the second highest key, and the highest one of that column.

    Args:
        keys_of: the keys of some rows, (B, R, C), which are overwritten, and the C columns that these have.
        rows, columns: how many there are, at least one.
        lowest: key of the pairs that may not match, and where there is no key.
        at_once: rows whose keys are computed at once.
        index_bits: lowest bits of a key, which hold its column, see `column_of`; 0: they do not.
        with_second: False: the highest key is returned in place of the second.
    """
    parts, of_columns = [], None
    for start in range(0, rows, at_once):
        keys, at = keys_of(slice(start, min(start + at_once, rows)))
        if of_columns is None:
            of_columns = keys.new_full((len(keys), columns), lowest)
        of_columns[:, at] = torch.maximum(of_columns[:, at], keys.amax(1))
        if index_bits:
            best = keys.amax(2)
            column = column_of(best, lowest, index_bits)
            own_column = (column - at.start).clamp(min=0)
        else:
            best, own_column = keys.max(2)
            column = own_column + at.start
        second = keys.scatter_(2, own_column[..., None], lowest).amax(2) if with_second else best
        parts.append((best, column, second))
    assert of_columns is not None
    best, column, second = (torch.cat(each, 1) for each in zip(*parts, strict=True))
    return best, column, second, of_columns.gather(1, column)


def column_of(keys: Tensor, lowest: float, index_bits: int) -> Tensor:
    """The columns that keys hold, counted from the last one, so that of equal keys the first column has the highest."""
    highest = (1 << index_bits) - 1
    return torch.where(keys > lowest, highest - (keys.to(torch.int64) & highest), 0)
