"""Binary descriptors of 256 bits, packed in 32 bytes; Hamming distances; exact nearest neighbors."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Num, Shaped, UInt8
from torch import Tensor

from torchslam.geometry.precision import without_autocast
from torchslam.utils.indexing import true_indices
from torchslam.utils.torch_internals import int8_matmul

# Product with this word moves the eight 0/1 bytes of a little-endian word into its top byte, bit i from byte i.
_GATHER_BITS = sum(1 << (56 - 7 * i) for i in range(8))

# Bits as +-64 have the product 2^20 - 2^13 * distance: the 13 bits below hold an index, and one maximum finds both.
_AMPLITUDE = 64
_INDEX_BITS = 13
"""Bits of an index: the products above are multiples of 2^13."""
_CHUNK = 1 << 13  # pairs whose bits are counted at once: their words stay in the cache
_MASKED = -(2**22)  # lowers a key below every valid one and keeps it exact in float32


@without_autocast
def pack_bits(bits: Shaped[Tensor, "*batch D"]) -> UInt8[Tensor, "*batch D//8"]:
    """Pack booleans into bytes, least significant bit first.

    Raises:
        ValueError: The last dimension is not a multiple of eight.
    """
    if bits.shape[-1] % 8:
        raise ValueError(f"the number of bits must be a multiple of 8, got {bits.shape[-1]}")
    words = bits.to(torch.bool).reshape(-1).view(torch.int64)
    return ((words * _GATHER_BITS) >> 56).to(torch.uint8).view(*bits.shape[:-1], bits.shape[-1] // 8)


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


def hamming_pairs(
    descriptors_1: UInt8[Tensor, "*batch D"], descriptors_2: UInt8[Tensor, "*batch D"]
) -> Int[Tensor, "*batch"]:
    """Compute Hamming distances row by row; D must be a multiple of 8 up to 248.

    Counts set bits by summing neighboring bit fields of whole words (Warren: Hacker's Delight, 2002).
    """
    words_1 = descriptors_1.contiguous().view(torch.int64)
    words_2 = descriptors_2.contiguous().view(torch.int64)
    words = words_1 ^ words_2
    words = words - ((words >> 1) & 0x5555555555555555)
    words = (words & 0x3333333333333333) + ((words >> 2) & 0x3333333333333333)
    in_bytes = ((words + (words >> 4)) & 0x0F0F0F0F0F0F0F0F).sum(-1)
    in_pairs = (in_bytes & 0x00FF00FF00FF00FF) + ((in_bytes >> 8) & 0x00FF00FF00FF00FF)
    return ((in_pairs * 0x0001000100010001) >> 48) & 0xFFFF


def hamming_between(
    descriptors_1: UInt8[Tensor, "N1 D"],
    rows: Int[Tensor, " M"],
    descriptors_2: UInt8[Tensor, "N2 D"],
    columns: Int[Tensor, " M"],
) -> Int[Tensor, " M"]:
    """Compute Hamming distances of pairs of rows of two tables, D as for `hamming_pairs`.

    On the CPU by NumPy, which gathers words and counts bits several times as fast, in versions from 2 on.
    """
    if len(rows) > _CHUNK:
        chunks = zip(rows.split(_CHUNK), columns.split(_CHUNK), strict=True)
        return torch.cat([hamming_between(descriptors_1, r, descriptors_2, c) for r, c in chunks])
    if not (rows.is_cpu and hasattr(np, "bitwise_count")):
        return hamming_pairs(descriptors_1.index_select(0, rows), descriptors_2.index_select(0, columns))
    words_1, words_2 = (
        descriptors.contiguous().numpy().view(np.uint64).take(which.numpy(), axis=0)
        for descriptors, which in ((descriptors_1, rows), (descriptors_2, columns))
    )
    words_1 ^= words_2
    return torch.from_numpy(_sum_of_bytes(np.bitwise_count(words_1)))


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
    """Compute inner products of the bits as +-amplitude: amplitude^2 (bits - 2 distance).

    Args:
        descriptors_1: packed bits.
        descriptors_2: packed bits.
        amplitude: at most 64.

    Returns:
        int32 if the processor multiplies int8 matrices quickly, else float32. Both are exact, because the sums stay
        below 2^24.
    """
    signs_1, signs_2 = spread_bits(descriptors_1, amplitude), spread_bits(descriptors_2, amplitude)
    return int8_product(signs_1, signs_2.mT)


def int8_product(
    left: Int[Tensor, "*batch M K"], right: Int[Tensor, "*batch K N"]
) -> Num[Tensor, "*batch M N"]:
    """Multiply int8 matrices.

    Returns:
        int32 where the processor multiplies these quickly, else float32, which is exact while no sum exceeds 2^24.
    """
    if int8_matmul is None or not _fast_int8(left.device) or 0 in (*left.shape, *right.shape):
        return left.float() @ right.float()
    batch = left.shape[:-2]
    pairs = zip(left.reshape(-1, *left.shape[-2:]), right.reshape(-1, *right.shape[-2:]), strict=True)
    products = [int8_matmul(*pair) for pair in pairs]
    stacked = products[0] if len(products) == 1 else torch.stack(products)
    return stacked.view(*batch, *products[0].shape)


def _fast_int8(device: torch.device) -> bool:
    """Test whether int8 matrix products beat float32: on x86 processors with AVX-512, through oneDNN."""
    return (
        device.type == "cpu"
        and torch.backends.mkldnn.is_available()
        and torch.backends.cpu.get_cpu_capability().startswith("AVX512")
    )


class NearestNeighbors(NamedTuple):
    """Nearest columns of N1 rows.

    Attributes:
        column: the nearest column.
        distance: distance to it.
        found: whether any column may match.
        mutual: whether no other row is nearer to that column.
        second: distance of the second nearest column; None if not requested.
    """

    column: Int[Tensor, "B N1"]
    distance: Float[Tensor, "B N1"]
    found: Bool[Tensor, "B N1"]
    mutual: Bool[Tensor, "B N1"]
    second: Float[Tensor, "B N1"] | None


def _possible(
    mask_1: Bool[Tensor, "B N1"], mask_2: Bool[Tensor, "B N2"], allowed: Bool[Tensor, "B N1 N2"] | None
) -> Bool[Tensor, "B N1 N2"]:
    """The pairs that may match."""
    possible = mask_1[:, :, None] & mask_2[:, None, :]
    return possible if allowed is None else possible & allowed


def nearest_by_hamming(
    descriptors_1: UInt8[Tensor, "B N1 D"],
    descriptors_2: UInt8[Tensor, "B N2 D"],
    mask_1: Bool[Tensor, "B N1"],
    mask_2: Bool[Tensor, "B N2"],
    allowed: Bool[Tensor, "B N1 N2"] | None,
    with_second: bool,
) -> NearestNeighbors:
    """Find exact nearest neighbors by Hamming distance, by two maxima over the matrix and one more for the second."""
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
    return NearestNeighbors(column, nearest, nearest <= bits, mutual, second)


_ROWS_AT_ONCE = 512
"""Rows whose similarities are computed at once: they stay in the cache. 256 to 1024 are equally fast, all 2000 of an
image take twice as long."""


_BYTES_FROM = 1 << 20
"""Pairs of descriptors from which on columns are chosen by bytes: 3000 and 3000 of SIFT take a third of the time. With
fewer than 1000 and 1000 there is little to gain."""
_BYTE_ROWS_AT_ONCE = 256
"""As `_ROWS_AT_ONCE`: 128 is as fast, 512 takes 1.4 times as long."""
_STEPS = 360.0
"""Steps of one number of a unit descriptor: products then leave room for `_INDEX_BITS`, as 360^2 < 2^17. The largest
number of SIFT's root-normalized descriptors is 0.36."""


def nearest_by_cosine(
    descriptors_1: Float[Tensor, "B N1 D"],
    descriptors_2: Float[Tensor, "B N2 D"],
    mask_1: Bool[Tensor, "B N1"],
    mask_2: Bool[Tensor, "B N2"],
    allowed: Bool[Tensor, "B N1 N2"] | None,
    with_second: bool,
) -> NearestNeighbors:
    """Find nearest neighbors by cosine similarity of unit descriptors; distances keep their graph.

    Where there are many, a second one is wanted, and the processor multiplies bytes quickly, columns are chosen by
    descriptors rounded to bytes; see `_nearest_by_bytes`.
    """
    batch, rows, count = len(mask_2), _used(mask_1), _used(mask_2)
    with_gradient = torch.is_grad_enabled() and (descriptors_1.requires_grad or descriptors_2.requires_grad)
    if (
        with_second
        and not with_gradient
        and rows * count >= _BYTES_FROM
        and count <= 1 << _INDEX_BITS
        and int8_matmul is not None
        and _fast_int8(descriptors_1.device)
    ):
        return _nearest_by_bytes(descriptors_1, descriptors_2, mask_1, mask_2, allowed)
    descriptors_2, mask_2 = descriptors_2[:, :count], mask_2[:, :count]
    best_of_column = descriptors_2.new_full((batch, count), -torch.inf)
    parts = []
    room = descriptors_2.new_empty(
        batch, min(_ROWS_AT_ONCE, rows), count
    )  # once: new pages cost as much as products
    for start in range(0, rows, _ROWS_AT_ONCE):
        chunk = slice(start, min(start + _ROWS_AT_ONCE, rows))
        out = None if with_gradient else room[:, : chunk.stop - start]
        similarity = torch.matmul(descriptors_1[:, chunk], descriptors_2.mT, out=out)
        values = similarity.detach().clone() if with_gradient else similarity  # changed in place
        for element, (own, other) in zip(values, zip(mask_1[:, chunk], mask_2, strict=True), strict=True):
            element.index_fill_(0, true_indices(~own), -torch.inf)
            element.index_fill_(1, true_indices(~other), -torch.inf)
        if allowed is not None:
            values.masked_fill_(~allowed[:, chunk, :count], -torch.inf)
        best, column = values.max(2)
        best_of_column = torch.maximum(best_of_column, values.amax(1))
        nearest = 1 - similarity.gather(2, column[..., None])[..., 0]
        nearest = torch.where(best > -torch.inf, nearest, 1.0)
        second = None
        if with_second:
            second = 1 - values.scatter_(2, column[..., None], -torch.inf).amax(2)
        parts.append((column, nearest, best, best if second is None else second))
    column, nearest, most, seconds = (torch.cat(each, 1) for each in zip(*parts, strict=True))
    tail = 0, mask_1.shape[1] - rows
    return NearestNeighbors(
        torch.nn.functional.pad(column, tail),
        torch.nn.functional.pad(nearest, tail, value=1.0),
        torch.nn.functional.pad(most > -torch.inf, tail),
        torch.nn.functional.pad(most >= best_of_column.gather(1, column), tail),
        torch.nn.functional.pad(seconds, tail, value=1.0) if with_second else None,
    )


def _nearest_by_bytes(
    descriptors_1: Float[Tensor, "B N1 D"],
    descriptors_2: Float[Tensor, "B N2 D"],
    mask_1: Bool[Tensor, "B N1"],
    mask_2: Bool[Tensor, "B N2"],
    allowed: Bool[Tensor, "B N1 N2"] | None,
) -> NearestNeighbors:
    """`nearest_by_cosine` with columns chosen by descriptors rounded to bytes; the distances to these are exact.

    The similarities by which columns are chosen have an error of 0.001, its standard deviation. So the nearest may be
    another column only where two are as close as that, where no ratio test passes.
    """
    batch, rows, count = len(mask_2), _used(mask_1), _used(mask_2)
    descriptors_2, mask_2 = descriptors_2[:, :count], mask_2[:, :count]
    bytes_1, bytes_2 = _rounded(descriptors_1[:, :rows]), _rounded(descriptors_2)
    lowest, highest = torch.iinfo(torch.int32).min, (1 << _INDEX_BITS) - 1
    numbers = highest - torch.arange(count, dtype=torch.int32, device=mask_2.device)

    def column(keys: Tensor) -> Tensor:
        return torch.where(keys > lowest, highest - (keys & highest), 0).long()

    best_of_column = numbers.new_full((batch, count), lowest)
    parts = []
    for start in range(0, rows, _BYTE_ROWS_AT_ONCE):
        chunk = slice(start, min(start + _BYTE_ROWS_AT_ONCE, rows))
        keys = int8_product(bytes_1[:, chunk], bytes_2.mT).mul_(1 << _INDEX_BITS).add_(numbers)
        for element, (own, other) in zip(keys, zip(mask_1[:, chunk], mask_2, strict=True), strict=True):
            element.index_fill_(0, true_indices(~own), lowest)
            element.index_fill_(1, true_indices(~other), lowest)
        if allowed is not None:
            keys.masked_fill_(~allowed[:, chunk, :count], lowest)
        best_of_column = torch.maximum(best_of_column, keys.amax(1))
        best = keys.amax(2)
        keys.scatter_(2, column(best)[..., None], lowest)
        parts.append((best, keys.amax(2)))
    best, second = (torch.cat(each, 1) for each in zip(*parts, strict=True))
    tail = 0, mask_1.shape[1] - rows

    def distance(keys: Tensor, otherwise: float) -> Tensor:
        chosen = torch.stack(
            [own.index_select(0, each) for own, each in zip(descriptors_2, column(keys), strict=True)]
        )
        exact = 1 - (descriptors_1[:, :rows] * chosen).sum(-1)
        return torch.nn.functional.pad(torch.where(keys > lowest, exact, otherwise), tail, value=1.0)

    mutual = best >> _INDEX_BITS >= best_of_column.gather(1, column(best)) >> _INDEX_BITS
    return NearestNeighbors(
        torch.nn.functional.pad(column(best), tail),
        distance(best, 1.0),
        torch.nn.functional.pad(best > lowest, tail),
        torch.nn.functional.pad(mutual, tail),
        distance(second, torch.inf),
    )


def _rounded(descriptors: Float[Tensor, "B N D"]) -> Int[Tensor, "B N D"]:
    """Unit descriptors in steps of at most 1 / `_STEPS`; the sums of their products are below 2^17."""
    low, high = descriptors.aminmax()
    largest = max(-float(low), float(high))
    steps = min(_STEPS, 127 / largest) if largest > 0 else _STEPS
    return (descriptors * steps).round_().to(torch.int8)


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
    logits = logits.masked_fill(~_possible(mask_1, mask_2, allowed), low)
    both = logits.softmax(2) * logits.softmax(1)
    return both.gather(2, column[..., None])[..., 0]
