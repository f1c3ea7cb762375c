"""Binary descriptors of 256 bits, packed in 32 bytes; Hamming distances; exact nearest neighbors."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Integer, Num, Shaped, UInt8
from torch import Tensor
from torch.nn.functional import pad

from torchslam.geometry.precision import without_autocast
from torchslam.utils.indexing import true_indices
from torchslam.utils.torch_internals import int8_matmul

_INDEX_BITS = 13
"""Bits of an index in a key: the products of bits as +-64, 2^20 - 2^13 * distance, are multiples of 2^13."""
_CHUNK = 1 << 13  # pairs whose bits are counted at once: their words stay in the cache


@without_autocast
def pack_bits(bits: Shaped[Tensor, "*batch D"]) -> UInt8[Tensor, "*batch D//8"]:
    """Pack booleans into bytes, least significant bit first.

    Raises:
        ValueError: The last dimension is not a multiple of eight.
    """
    if bits.shape[-1] % 8:
        raise ValueError(f"the number of bits must be a multiple of 8, got {bits.shape[-1]}")
    words = bits.to(torch.bool).reshape(-1).view(torch.int64)
    # This product moves the eight 0/1 bytes of a little-endian word into its top byte, bit i from byte i.
    gather = sum(1 << (56 - 7 * i) for i in range(8))
    return ((words * gather) >> 56).to(torch.uint8).view(*bits.shape[:-1], bits.shape[-1] // 8)


@without_autocast
def unpack_bits(descriptors: UInt8[Tensor, "*batch D"]) -> Bool[Tensor, "*batch 8*D"]:
    """Unpack descriptors to bits, the inverse of `pack_bits`."""
    return bit_table(0, 1, descriptors.device)[descriptors.long()].flatten(-2).to(torch.bool)


@lru_cache(maxsize=16)
def bit_table(zero: int, one: int, device: torch.device) -> Int[Tensor, "256 8"]:
    """The bits of every byte (int8), least significant first, with `zero` and `one` in place of 0 and 1."""
    shifts = torch.arange(8, device=device)
    bits = (torch.arange(256, device=device)[:, None] >> shifts) & 1
    return torch.where(bits.bool(), one, zero).to(torch.int8)


def spread_bits(descriptors: UInt8[Tensor, "*batch D"], amplitude: int) -> Int[Tensor, "*batch 8*D"]:
    """Spread bits to int8 of -amplitude and +amplitude, one table row (a word) per byte."""
    words = bit_table(-amplitude, amplitude, descriptors.device).view(torch.int64).view(-1)
    rows = words.index_select(0, descriptors.reshape(-1).to(torch.int32))
    return rows.view(torch.int8).view(*descriptors.shape[:-1], 8 * descriptors.shape[-1])


def count_bits(words: Int[Tensor, "*batch"]) -> Integer[Tensor, "*batch"]:
    """Count the set bits of words of 64 bits (Warren: Hacker's Delight, 2002), on the CPU by NumPy from version 2."""
    if words.is_cpu and hasattr(np, "bitwise_count"):
        return torch.from_numpy(np.bitwise_count(words.numpy().view(np.uint64)))
    words = words - ((words >> 1) & 0x5555555555555555)
    words = (words & 0x3333333333333333) + ((words >> 2) & 0x3333333333333333)
    return (((words + (words >> 4)) & 0x0F0F0F0F0F0F0F0F) * 0x0101010101010101) >> 56


def hamming_between(
    descriptors_1: UInt8[Tensor, "N1 D"],
    rows: Int[Tensor, " M"],
    descriptors_2: UInt8[Tensor, "N2 D"],
    columns: Int[Tensor, " M"],
) -> Int[Tensor, " M"]:
    """Compute Hamming distances of pairs of rows of two tables; D must be a multiple of 8.

    On the CPU words are gathered and summed by NumPy, several times as fast.
    """
    if len(rows) > _CHUNK:
        chunks = zip(rows.split(_CHUNK), columns.split(_CHUNK), strict=True)
        return torch.cat([hamming_between(descriptors_1, r, descriptors_2, c) for r, c in chunks])
    words_1, words_2 = (each.contiguous().view(torch.int64) for each in (descriptors_1, descriptors_2))
    if not (rows.is_cpu and hasattr(np, "bitwise_count")):
        return count_bits(words_1.index_select(0, rows) ^ words_2.index_select(0, columns)).sum(-1)
    differing = words_1.numpy().view(np.uint64).take(rows.numpy(), axis=0)
    differing ^= words_2.numpy().view(np.uint64).take(columns.numpy(), axis=0)
    return torch.from_numpy(_sum_of_bytes(np.bitwise_count(differing)))


def _sum_of_bytes(counts: Any) -> Any:
    """Sums of the bits of words: (P, W) uint8, at most 64 each -> (P,) int64."""
    if counts.shape[1] != 4:
        return counts.sum(1, dtype=np.int64)
    # Of the four bytes of a number at once; in pairs first, as all four may sum to 256.
    fours = counts.view(np.uint32)[:, 0]
    pairs = (fours & 0x00FF00FF) + (fours >> 8 & 0x00FF00FF)
    return ((pairs + (pairs >> 16)) & 0xFFFF).astype(np.int64)


@without_autocast
def hamming(
    descriptors_1: UInt8[Tensor, "*batch N1 D"], descriptors_2: UInt8[Tensor, "*batch N2 D"]
) -> Int[Tensor, "*batch N1 N2"]:
    """Compute all exact Hamming distances (bits) between two batches of packed descriptors."""
    bits = 8 * descriptors_1.shape[-1]
    return (bits - sign_products(descriptors_1, descriptors_2, 1).to(torch.int32)) >> 1


def sign_products(
    descriptors_1: UInt8[Tensor, "*batch N1 D"], descriptors_2: UInt8[Tensor, "*batch N2 D"], amplitude: int
) -> Num[Tensor, "*batch N1 N2"]:
    """Compute inner products of packed bits as +-amplitude, at most 64: amplitude^2 (bits - 2 distance).

    Of the type of `int8_product`; exact, because the sums stay below 2^24.
    """
    signs_1, signs_2 = spread_bits(descriptors_1, amplitude), spread_bits(descriptors_2, amplitude)
    return int8_product(signs_1, signs_2.mT)


def int8_product(
    left: Int[Tensor, "*batch M K"], right: Int[Tensor, "*batch K N"]
) -> Num[Tensor, "*batch M N"]:
    """Multiply int8 matrices: int32 where the processor is quick at it, else float32, exact for sums up to 2^24."""
    if int8_matmul is None or not _fast_int8(left.device) or 0 in (*left.shape, *right.shape):
        return left.float() @ right.float()
    out = left.new_empty(*left.shape[:-1], right.shape[-1], dtype=torch.int32)
    factors = (values.reshape(-1, *values.shape[-2:]) for values in (left, right))
    for one, other, product in zip(*factors, out.view(-1, *out.shape[-2:]), strict=True):
        int8_matmul(one, other, out=product)
    return out


def _fast_int8(device: torch.device) -> bool:
    """Test whether int8 matrix products beat float32: on x86 processors with AVX-512, through oneDNN."""
    return (
        int8_matmul is not None
        and device.type == "cpu"
        and torch.backends.mkldnn.is_available()
        and torch.backends.cpu.get_cpu_capability().startswith("AVX512")
    )


class NearestNeighbors(NamedTuple):
    """Nearest columns of N1 rows."""

    column: Int[Tensor, "B N1"]
    distance: Float[Tensor, "B N1"]
    found: Bool[Tensor, "B N1"]  # whether any column may match
    mutual: Bool[Tensor, "B N1"]  # whether no other row is nearer to that column
    second: Float[Tensor, "B N1"] | None  # distance of the second nearest column; None if not requested


_ROWS_AT_ONCE = 512
"""Rows whose similarities are computed at once: they stay in the cache. 256 to 1024 are equally fast, all 2000 of an
image take twice as long."""
_DIRECTIONS, _VARIANCE = 0.5, 0.9
"""Share of the dimensions of descriptors by which columns are chosen, and what they must hold of the variance: 64 of
SIFT's 128 hold .96. Of the matches that pass mutual and ratio test with garden, courthouse and machine_hall, .3 % are
lost then, and .6 % pass that would not. With 48 dimensions it is .4 and 1.4 %, in four fifths of the time."""
_SAMPLE = 512
"""Descriptors of each set, the strongest, from which directions are found. Tried at this value only."""
_DIRECTIONS_FROM = 1 << 20
"""Pairs of descriptors from which on columns are chosen so, on the CPU: 3000 and 3000 take .55 of the time. With fewer
than 1000 and 1000 there is little to gain."""


class _Candidates(NamedTuple):
    """The pairs that may match: of the first `rows` and `columns` of both sets, beyond which none is used."""

    mask_1: Bool[Tensor, "B N1"]
    mask_2: Bool[Tensor, "B N2"]
    allowed: Bool[Tensor, "B N1 N2"] | None
    rows: int
    columns: int

    def best(
        self,
        keys_of: Callable[[slice], Tensor],
        lowest: float,
        at_once: int,
        index_bits: int,
        with_second: bool,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The highest key of each row, its column, the second highest key, and the highest one of that column.

        Args:
            keys_of: the keys of some rows, (B, R, columns), which are overwritten.
            lowest: key of the pairs that may not match.
            at_once: rows whose keys are computed at once.
            index_bits: lowest bits of a key, which hold its column, see `_column_of`; 0: they do not.
            with_second: False: the highest key is returned in place of the second.
        """
        parts, of_columns = [], []
        for start in range(0, self.rows, at_once):
            chunk = slice(start, min(start + at_once, self.rows))
            keys = keys_of(chunk)
            masks = zip(self.mask_1[:, chunk], self.mask_2[:, : self.columns], strict=True)
            for element, (own, other) in zip(keys, masks, strict=True):
                element.index_fill_(0, true_indices(~own), lowest)
                element.index_fill_(1, true_indices(~other), lowest)
            if self.allowed is not None:
                keys.masked_fill_(~self.allowed[:, chunk, : self.columns], lowest)
            of_columns.append(keys.amax(1))
            if index_bits:
                best = keys.amax(2)
                column = _column_of(best, lowest, index_bits)
            else:
                best, column = keys.max(2)
            second = keys.scatter_(2, column[..., None], lowest).amax(2) if with_second else best
            parts.append((best, column, second))
        best, column, second = (torch.cat(each, 1) for each in zip(*parts, strict=True))
        return best, column, second, torch.stack(of_columns).amax(0).gather(1, column)

    def neighbors(
        self, column: Tensor, distance: Tensor, found: Tensor, mutual: Tensor, second: Tensor | None
    ) -> NearestNeighbors:
        """The neighbors of all N1 rows, from those of the first `rows`."""
        tail = 0, self.mask_1.shape[1] - self.rows
        column, found, mutual = (pad(values, tail) for values in (column, found, mutual))
        second = None if second is None else pad(second, tail, value=1.0)
        return NearestNeighbors(column, pad(distance, tail, value=1.0), found, mutual, second)


def _column_of(keys: Tensor, lowest: float, index_bits: int) -> Tensor:
    """The columns that keys hold, counted from the last one, so that of equal keys the first column has the highest."""
    highest = (1 << index_bits) - 1
    return torch.where(keys > lowest, highest - (keys.to(torch.int64) & highest), 0)


def nearest_by_hamming(
    descriptors_1: UInt8[Tensor, "B N1 D"],
    descriptors_2: UInt8[Tensor, "B N2 D"],
    mask_1: Bool[Tensor, "B N1"],
    mask_2: Bool[Tensor, "B N2"],
    allowed: Bool[Tensor, "B N1 N2"] | None,
    with_second: bool,
) -> NearestNeighbors:
    """Find exact nearest neighbors by Hamming distance, by two maxima over the matrix and one more for the second."""
    keys = sign_products(
        descriptors_1, descriptors_2, 64
    )  # whose free low bits hold an index: one maximum finds both
    bits, index_bits = 8 * descriptors_1.shape[-1], _INDEX_BITS
    rows, columns = keys.shape[1:]
    if columns > 1 << _INDEX_BITS:  # more columns than the free bits can number: wider keys
        index_bits = columns.bit_length()
        keys = keys.to(torch.int64) << (index_bits - _INDEX_BITS)
    # Below every valid key, and exact in float32.
    lowest = -(2**22) << (index_bits - _INDEX_BITS)
    keys += ((1 << index_bits) - 1 - torch.arange(columns, device=keys.device)).to(keys.dtype)

    def distance(key: Tensor) -> Tensor:
        return torch.where(key > lowest, (bits // 2 - (key.to(torch.int64) >> index_bits)).float(), torch.inf)

    pairs = _Candidates(mask_1, mask_2, allowed, rows, columns)
    best, column, second, of_column = pairs.best(lambda _: keys, lowest, rows, index_bits, with_second)
    mutual = distance(best) <= distance(of_column)
    return pairs.neighbors(
        column, distance(best), best > lowest, mutual, distance(second) if with_second else None
    )


def nearest_by_cosine(
    descriptors_1: Float[Tensor, "B N1 D"],
    descriptors_2: Float[Tensor, "B N2 D"],
    mask_1: Bool[Tensor, "B N1"],
    mask_2: Bool[Tensor, "B N2"],
    allowed: Bool[Tensor, "B N1 N2"] | None,
    with_second: bool,
) -> NearestNeighbors:
    """Find nearest neighbors by cosine similarity of unit descriptors; distances keep their graph.

    Where there are many, a second one is wanted, and few directions hold most of their variance, columns are chosen by
    these; see `_nearest_by_directions`.
    """
    pairs = _Candidates(mask_1, mask_2, allowed, _used(mask_1), _used(mask_2))
    used_1, used_2 = descriptors_1[:, : pairs.rows], descriptors_2[:, : pairs.columns]
    with_gradient = torch.is_grad_enabled() and (descriptors_1.requires_grad or descriptors_2.requires_grad)
    is_large = pairs.rows * pairs.columns >= _DIRECTIONS_FROM and pairs.columns <= 1 << _INDEX_BITS
    if with_second and not with_gradient and is_large and used_1.is_cpu:
        if len(used_1) > 1:
            return _each_alone(descriptors_1, descriptors_2, mask_1, mask_2, allowed)
        strongest = zip((used_1, used_2), (mask_1, mask_2), strict=True)
        sample = torch.cat(
            [used[0, :_SAMPLE][mask[0, : used.shape[1]][:_SAMPLE]] for used, mask in strongest]
        )
        directions = _Directions.of(sample.float())
        if directions is not None:
            return _nearest_by_directions(used_1, used_2, pairs, directions)
    if with_gradient:
        similarity = used_1 @ used_2.mT
    else:  # room for it once: new pages cost as much as products
        similarity = used_2.new_empty(len(mask_2), min(_ROWS_AT_ONCE, pairs.rows), pairs.columns)

    def keys_of(chunk: slice) -> Tensor:
        if with_gradient:
            return similarity.detach()[:, chunk].clone()
        return torch.matmul(used_1[:, chunk], used_2.mT, out=similarity[:, : chunk.stop - chunk.start])

    best, column, second, of_column = pairs.best(keys_of, -torch.inf, _ROWS_AT_ONCE, 0, with_second)
    found = best > -torch.inf
    nearest = 1 - (similarity.gather(2, column[..., None])[..., 0] if with_gradient else best)
    nearest = torch.where(found, nearest, 1.0)
    return pairs.neighbors(column, nearest, found, best >= of_column, 1 - second if with_second else None)


def _each_alone(
    descriptors_1: Float[Tensor, "B N1 D"],
    descriptors_2: Float[Tensor, "B N2 D"],
    mask_1: Bool[Tensor, "B N1"],
    mask_2: Bool[Tensor, "B N2"],
    allowed: Bool[Tensor, "B N1 N2"] | None,
) -> NearestNeighbors:
    """`nearest_by_cosine` with the second nearest, element by element: directions are those of an element."""
    found = [
        nearest_by_cosine(
            descriptors_1[row : row + 1],
            descriptors_2[row : row + 1],
            mask_1[row : row + 1],
            mask_2[row : row + 1],
            None if allowed is None else allowed[row : row + 1],
            True,
        )
        for row in range(len(descriptors_1))
    ]
    return NearestNeighbors(*(torch.cat(columns) for columns in zip(*found, strict=True)))


def _nearest_by_directions(
    descriptors_1: Float[Tensor, "1 N1 D"],
    descriptors_2: Float[Tensor, "1 N2 D"],
    pairs: _Candidates,
    directions: _Directions,
) -> NearestNeighbors:
    """`nearest_by_cosine` with columns chosen by the main directions of descriptors; the distances to these are exact.

    A key is 1 - the squared distance / 2 along the directions, whose lowest bits are replaced with the column.
    """
    index_bits = pairs.columns.bit_length()
    one, two = (directions.coordinates(each[0].float()) for each in (descriptors_1, descriptors_2))
    ones = [torch.ones_like(each[:, :1]) for each in (one, two)]
    halves = [0.5 * each.square().sum(1, keepdim=True) for each in (one, two)]
    factors_1 = torch.cat((one, 1 - halves[0], ones[0]), dim=1)
    factors_2 = torch.cat((two, ones[1], -halves[1]), dim=1).mT
    lowest, highest = torch.iinfo(torch.int32).min, (1 << index_bits) - 1
    numbers = highest - torch.arange(pairs.columns, dtype=torch.int32, device=one.device)
    room = one.new_empty(1, min(_ROWS_AT_ONCE, pairs.rows), pairs.columns)

    def keys_of(chunk: slice) -> Tensor:
        values = room[:, : chunk.stop - chunk.start]
        torch.matmul(factors_1[chunk], factors_2, out=values[0])
        return values.view(torch.int32).bitwise_and_(~highest).bitwise_or_(numbers)

    def distance(keys: Tensor, otherwise: float) -> Tensor:
        chosen = descriptors_2[0].index_select(0, _column_of(keys[0], lowest, index_bits))
        return torch.where(keys > lowest, 1 - chosen.mul_(descriptors_1[0]).sum(-1), otherwise)

    best, column, second, of_column = pairs.best(keys_of, lowest, _ROWS_AT_ONCE, index_bits, True)
    mutual = best >> index_bits >= of_column >> index_bits
    return pairs.neighbors(column, distance(best, 1.0), best > lowest, mutual, distance(second, torch.inf))


class _Directions(NamedTuple):
    """The directions in which descriptors differ most."""

    mean: Float[Tensor, " D"]
    axes: Float[Tensor, "D K"]

    @classmethod
    def of(cls, descriptors: Float[Tensor, "N D"]) -> _Directions | None:
        """By principal components; None if few of these hold too little of the variance, or without descriptors."""
        if len(descriptors) == 0:
            return None
        mean = descriptors.mean(0)
        rest = descriptors - mean
        values, vectors = torch.linalg.eigh((rest.mT @ rest).double())
        count = int(_DIRECTIONS * len(mean))
        if float(values[-count:].sum()) < _VARIANCE * float(values.sum()):
            return None
        return cls(mean, vectors[:, -count:].to(descriptors))

    def coordinates(self, descriptors: Float[Tensor, "N D"]) -> Float[Tensor, "N K"]:
        """The coordinates of descriptors along the directions."""
        return descriptors @ self.axes - self.mean @ self.axes


def _used(mask: Bool[Tensor, "B N"]) -> int:
    """Number of rows up to the last one that some element uses, at least one: feature extractors pad at the end."""
    used = torch.nonzero(mask.any(0))
    return int(used[-1]) + 1 if len(used) else 1


def dual_softmax(
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
