"""Binary descriptors of 256 bits, packed in 32 bytes; Hamming distances; exact nearest neighbors."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Int, Integer, Num, Shaped, UInt8
from torch import Tensor

from torchslam.features.matching.nearest import INDEX_BITS, Candidates, NearestNeighbors, best_keys
from torchslam.geometry.precision import without_autocast
from torchslam.utils.torch_internals import int8_matmul

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
    bits, index_bits = 8 * descriptors_1.shape[-1], INDEX_BITS
    rows, columns = keys.shape[1:]
    if columns > 1 << INDEX_BITS:  # more columns than the free bits can number: wider keys
        index_bits = columns.bit_length()
        keys = keys.to(torch.int64) << (index_bits - INDEX_BITS)
    # Below every valid key, and exact in float32.
    lowest = -(2**22) << (index_bits - INDEX_BITS)
    keys += ((1 << index_bits) - 1 - torch.arange(columns, device=keys.device)).to(keys.dtype)

    def distance(key: Tensor) -> Tensor:
        return torch.where(key > lowest, (bits // 2 - (key.to(torch.int64) >> index_bits)).float(), torch.inf)

    pairs = Candidates(mask_1, mask_2, allowed, rows, columns)
    best, column, second, of_column = best_keys(
        lambda chunk: pairs.only(keys, chunk, lowest), rows, columns, lowest, rows, index_bits, with_second
    )
    mutual = distance(best) <= distance(of_column)
    return pairs.neighbors(
        column, distance(best), best > lowest, mutual, distance(second) if with_second else None
    )
