"""Descriptors as words of a vocabulary and short binary codes: how a place is written down.

A word is the nearest of 1024 binary centres. The descriptors of one image that share a word are summed up in one code
of 64 bits, the majority of 64 of their 256 bits, so that a repeated texture counts once. Of two codes of the same word
the Hamming distance tells whether they mean the same thing.
Sources: Sivic and Zisserman: Video Google, 2003; Jegou et al.: Hamming embedding, 2008; Tolias et al.: To aggregate or
not to aggregate (ASMK), 2013.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import Tensor

from torchslam.features.matching.hamming import pack_bits, sign_products, spread_bits

BITS = 256  # of a descriptor
CODE_BITS = 64  # of a code: one machine word
_CODE_NOISE = 9.0  # bits: the likeness of codes falls by exp(-(distance / _CODE_NOISE)^2)
_CODE_LIMIT = 19  # bits: codes further apart mean different things
# by experiments/places/train.py, from rendered images
_WORDS_FILE = Path(__file__).parent / "words.safetensors"
_SEED = 0  # of the choice of bits and of the projections of floats; part of what a saved state means


@lru_cache(maxsize=4)
def rendered_words(device: torch.device) -> Tensor:
    """(1024, 32) uint8: centres of ORB descriptors of rendered images."""
    return load_file(_WORDS_FILE)["words"].to(device)


def binary(descriptors: Tensor) -> Tensor:
    """Descriptors as 256 packed bits: (N, 32) uint8 as they are, (N, D) floats by the signs of random projections.

    The Hamming distance of such bits grows with the angle between the floats (Charikar, 2002). Returns (N, 32) uint8.
    Raises ValueError for bits of another number.
    """
    if descriptors.dtype == torch.uint8:
        if descriptors.shape[-1] != BITS // 8:
            raise ValueError(f"binary descriptors must have {BITS} bits, got {8 * descriptors.shape[-1]}")
        return descriptors
    values = descriptors.detach().float()
    return pack_bits(values @ _projections(values.shape[-1], values.device) > 0)


def words_and_codes(descriptors: Tensor, words: Tensor) -> tuple[Tensor, Tensor]:
    """The words that descriptors (N, 32) uint8 use out of words (W, 32) uint8, ascending, and the code of each.

    Of equally near words the lower one wins, of equally many bits 0 and 1 the 0. Returns (n,) int64 and (n,) int64.
    """
    if len(descriptors) == 0:
        nothing = torch.zeros(0, dtype=torch.int64, device=descriptors.device)
        return nothing, nothing
    nearest = _nearest(descriptors, words)
    chosen = _code_bits(descriptors.device)
    signs = spread_bits(descriptors, 1).index_select(1, chosen).float()
    votes = signs.new_zeros(len(words), CODE_BITS).index_add_(0, nearest, signs)
    used = torch.nonzero(torch.bincount(nearest, minlength=len(words)))[:, 0]
    return used, pack_bits(votes[used] > 0).view(torch.int64)[:, 0]


def _nearest(descriptors: Tensor, words: Tensor) -> Tensor:
    """(N,) the nearest word by Hamming distance, the lower one of equals on every device."""
    keys = sign_products(descriptors, words, 1).to(torch.int32)
    # One maximum finds product and word: a quarter of the time of argmax.
    keys = keys * len(words) + torch.arange(len(words) - 1, -1, -1, device=words.device, dtype=torch.int32)
    return len(words) - 1 - keys.amax(1).remainder(len(words)).to(torch.int64)


@lru_cache(maxsize=4)
def _code_bits(device: torch.device) -> Tensor:
    """(64,) which bits of a descriptor make its code."""
    generator = torch.Generator().manual_seed(_SEED)
    return torch.randperm(BITS, generator=generator)[:CODE_BITS].to(device)


@lru_cache(maxsize=4)
def _projections(size: int, device: torch.device) -> Tensor:
    """(size, 256) random directions."""
    generator = torch.Generator().manual_seed(_SEED)
    return torch.randn(size, BITS, generator=generator).to(device)


def likeness(codes_1: Tensor, codes_2: Tensor) -> Tensor:
    """How much alike codes of the same word are: (...) int64 twice, broadcast -> (...) float32 in [0, 1]."""
    distance = _count_bits(codes_1 ^ codes_2)
    return _kernel(codes_1.device).index_select(0, distance.view(-1)).view(distance.shape)


@lru_cache(maxsize=4)
def _kernel(device: torch.device) -> Tensor:
    """(65,) float32: likeness by Hamming distance."""
    distance = torch.arange(CODE_BITS + 1, dtype=torch.float64)
    values = torch.exp(-((distance / _CODE_NOISE) ** 2)) * (distance <= _CODE_LIMIT)
    return values.float().to(device)


def _count_bits(words: Tensor) -> Tensor:
    """How many bits of each word are set: (...) int64 -> (...) int64 (Warren: Hacker's Delight, 2002). Overwrites."""
    part = (words >> 1).bitwise_and_(0x5555555555555555)
    words -= part
    torch.bitwise_right_shift(words, 2, out=part)
    words.bitwise_and_(0x3333333333333333).add_(part.bitwise_and_(0x3333333333333333))
    words += torch.bitwise_right_shift(words, 4, out=part)
    words.bitwise_and_(0x0F0F0F0F0F0F0F0F).mul_(0x0101010101010101)
    return words.bitwise_right_shift_(56)  # at most 64, so the sign bit stays clear
