"""Keyframe database: place recognition for relocalization and loop closing.

The score of two images sums, over the visual words they share, the rarity of the word times the similarity of their
codes. It is 1 for an image with itself and 0 for images without a common word. Recall and cost compared with
alternatives: docs/studies.md.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int, Shaped, UInt8
from safetensors.torch import load_file
from torch import Tensor
from torch.nn.functional import pad

from torchslam.features.matching.hamming import count_bits, pack_bits, sign_products, spread_bits

BITS = 256
"""Bits of a descriptor: ORB's, and of the random projections of floats."""
CODE_BITS = 64
"""Bits of a code: one machine word."""
_CODE_NOISE = 9.0
"""Bits by which codes of one place differ: their similarity falls by exp(-(distance / _CODE_NOISE)^2).
Tried at this value only."""
_SEED = 0  # of the choice of bits and of the projections of floats; part of what a saved state means


@lru_cache(maxsize=4)
def default_vocabulary(device: torch.device) -> UInt8[Tensor, "1024 32"]:
    """The vocabulary of the package: centers of ORB descriptors of rendered images (experiments/vocabulary.py)."""
    return load_file(Path(__file__).with_name("words.safetensors"))["words"].to(device)


def binarize(descriptors: UInt8[Tensor, "N 32"] | Float[Tensor, "N D"]) -> UInt8[Tensor, "N 32"]:
    """Convert descriptors to 256 packed bits: bits stay, floats become the signs of random projections.

    The Hamming distance of such bits grows with the angle between the floats (Charikar, 2002).

    Raises:
        ValueError: The descriptors are bits of another number.
    """
    if descriptors.dtype == torch.uint8:
        if descriptors.shape[-1] != BITS // 8:
            raise ValueError(f"binary descriptors must have {BITS} bits, got {8 * descriptors.shape[-1]}")
        return descriptors
    values = descriptors.detach().float()
    return pack_bits(values @ _projections(values.shape[-1], values.device) > 0)


def quantize(
    descriptors: UInt8[Tensor, "N 32"], words: UInt8[Tensor, "W 32"]
) -> tuple[Int[Tensor, " R"], Int[Tensor, " R"]]:
    """Quantize descriptors: the words that they use, ascending, and the code of each word.

    Of equally near words the lower one wins, of equally many bits 0 and 1 the 0.
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


def _nearest(descriptors: UInt8[Tensor, "N 32"], words: UInt8[Tensor, "W 32"]) -> Int[Tensor, " N"]:
    """The nearest word by Hamming distance, the lower one of equals on every device."""
    keys = sign_products(descriptors, words, 1).to(torch.int32)
    # One maximum finds product and word: a quarter of the time of argmax.
    keys = keys * len(words) + torch.arange(len(words) - 1, -1, -1, device=words.device, dtype=torch.int32)
    return len(words) - 1 - keys.amax(1).remainder(len(words)).to(torch.int64)


@lru_cache(maxsize=4)
def _code_bits(device: torch.device) -> Int[Tensor, "64"]:
    """The bits of a descriptor that make its code."""
    generator = torch.Generator().manual_seed(_SEED)
    return torch.randperm(BITS, generator=generator, device="cpu")[:CODE_BITS].to(device)


@lru_cache(maxsize=4)
def _projections(size: int, device: torch.device) -> Float[Tensor, "{size} 256"]:
    """Random directions."""
    generator = torch.Generator().manual_seed(_SEED)
    return torch.randn(size, BITS, generator=generator, dtype=torch.float32, device="cpu").to(device)


def code_similarity(
    codes_1: Int[Tensor, "*#batch"], codes_2: Int[Tensor, "*#batch"]
) -> Float[Tensor, "*#batch"]:
    """Similarity of codes of the same word, 0 to 1."""
    distance = count_bits(codes_1 ^ codes_2)
    return _kernel(codes_1.device).index_select(0, distance.view(-1).int()).view(distance.shape)


@lru_cache(maxsize=4)
def _kernel(device: torch.device) -> Float[Tensor, "65"]:
    """Similarity by Hamming distance."""
    distance = torch.arange(CODE_BITS + 1, dtype=torch.float64, device="cpu")
    values = torch.exp(-((distance / _CODE_NOISE) ** 2)) * (distance <= 19)  # 0.01 there
    return values.float().to(device)


MAX_DESCRIPTORS = 400
"""Descriptors of an image, the strongest: nearly as good as all of them, at less than half the cost."""
NO_KEY = -1
"""Key of an empty slot; keys of keyframes are not negative."""
_CHUNK = 1 << 17
"""Pairs of codes that are compared at once: what a processor's cache holds."""
_MIN_FLOAT_WORDS = 64
"""Descriptors below which an image is too empty to give the words of a float feature extractor. Tried at this value
only."""


class KeyframeDatabase:
    """Inverted index of keyframes, by key, that ranks them by similarity to an image.

    Descriptors are ordered by decreasing strength, as the extractors return them, and of one kind for all images.

    Args:
        words: the vocabulary. By default bits use that of the package, which was trained on rendered images, and
            floats the descriptors of the first keyframe that has at least 64.
    """

    def __init__(self, words: UInt8[Tensor, "W 32"] | None = None) -> None:
        self._words = words
        self._keys = torch.zeros(0, dtype=torch.int64, device="cpu")  # (slots,) NO_KEY where the slot is free
        # (W, slots), of each word in each keyframe
        self._codes = torch.zeros(0, 0, dtype=torch.int64, device="cpu")
        # (W, slots), 1 where the keyframe has the word, else 0
        self._used = torch.zeros(0, 0, dtype=torch.float32, device="cpu")
        self._slots: dict[int, int] = {}

    def __len__(self) -> int:
        """The number of keyframes."""
        return len(self._slots)

    def __contains__(self, key: int) -> bool:
        """Whether there is a keyframe of this key."""
        return key in self._slots

    @property
    def keys(self) -> Int[Tensor, " K"]:
        """Keys of all keyframes, ascending."""
        return torch.sort(self._keys[self._keys != NO_KEY]).values

    def add(self, key: int, descriptors: Shaped[Tensor, "N D"], mask: Bool[Tensor, " N"]) -> None:
        """Add a keyframe by its descriptors, bits or unit floats, where the mask is True.

        Raises:
            ValueError: The key is negative or already there.
        """
        if key < 0 or key in self._slots:
            raise ValueError(f"a key must be new and at least 0, not {key}")
        floats, descriptors = descriptors.is_floating_point(), _strongest(descriptors, mask)
        slot = self._free_slot(descriptors.device)
        if self._words is None and (not floats or len(descriptors) >= _MIN_FLOAT_WORDS):
            self._words = descriptors if floats else default_vocabulary(descriptors.device)
        if self._words is not None and len(self._codes) == 0:
            self._set_words(self._words.to(descriptors.device))
        if self._words is not None:
            used, codes = quantize(descriptors, self._words)
            self._used[used, slot], self._codes[used, slot] = 1.0, codes
        self._keys[slot] = key
        self._slots[key] = slot

    def remove(self, keys: Int[Tensor, " K"] | Iterable[int]) -> None:
        """Remove keyframes.

        Raises:
            KeyError: A key is missing; nothing was removed.
        """
        keys = [int(key) for key in keys]
        slots = [self._slots[key] for key in keys]
        self._keys[slots] = NO_KEY
        self._used[:, slots] = 0.0
        for key in keys:
            self._slots.pop(key, None)

    def query(
        self, descriptors: Shaped[Tensor, "N D"], mask: Bool[Tensor, " N"]
    ) -> tuple[Int[Tensor, " K"], Float[Tensor, " K"]]:
        """Rank all keyframes by similarity to an image with these descriptors, where the mask is True.

        Returns:
            Keys and scores in [0, 1], the best first, of equals the lower key first.
        """
        if not self._slots or self._words is None:
            return self.keys, torch.zeros(len(self), device=self._keys.device, dtype=torch.float32)
        return self._ranked(*quantize(_strongest(descriptors, mask), self._words))

    def query_by_key(self, key: int) -> tuple[Int[Tensor, " K"], Float[Tensor, " K"]]:
        """Rank all keyframes by similarity to one of them, as `query`.

        Raises:
            KeyError: The key is missing.
        """
        slot = self._slots[key]
        used = torch.nonzero(self._used[:, slot])[:, 0]
        return self._ranked(used, self._codes[used, slot])

    def _ranked(
        self, used: Int[Tensor, " R"], codes: Int[Tensor, " R"]
    ) -> tuple[Int[Tensor, " K"], Float[Tensor, " K"]]:
        """Keys and scores by similarity to an image that uses these words with these codes, in order."""
        size = len(self._keys)
        # A word that no keyframe has yet is taken to be as rare as one that a single one has.
        rarity = torch.log((len(self) + 1) / self._used.sum(1).clamp(min=1.0)).square()
        shared = self._used.new_zeros(size)
        for rows in torch.arange(len(used), device=used.device).split(max(1, _CHUNK // size)):
            word = used[rows]
            alike = code_similarity(self._codes.index_select(0, word), codes[rows, None])
            shared += rarity[word] @ alike.mul_(self._used.index_select(0, word))
        own = rarity[used].sum()
        scores = shared / (own * (rarity @ self._used)).sqrt().clamp(min=1e-12)
        slots = torch.nonzero(self._keys != NO_KEY)[:, 0]
        slots = slots[torch.argsort(self._keys[slots])]
        ranked = torch.sort(scores[slots].clamp(max=1.0), descending=True, stable=True)
        return self._keys[slots][ranked.indices], ranked.values

    def _set_words(self, words: UInt8[Tensor, "W 32"]) -> None:
        """Set the vocabulary; the keyframes so far, which are empty, use no words."""
        self._words = words
        self._codes = torch.zeros(len(words), len(self._keys), dtype=torch.int64, device=words.device)
        self._used = torch.zeros(len(words), len(self._keys), device=words.device, dtype=torch.float32)

    def _free_slot(self, device: torch.device) -> int:
        """The lowest slot that no keyframe has, with nothing in it."""
        if len(self) == len(self._keys):
            # Room for a quarter more, so that adding a keyframe costs the same on average.
            more = 0, max(64 - len(self), len(self) // 4)
            self._keys = pad(self._keys.to(device), more, value=NO_KEY)
            self._codes, self._used = (pad(each.to(device), more) for each in (self._codes, self._used))
        return int(torch.nonzero(self._keys == NO_KEY)[0, 0])


def _strongest(descriptors: Shaped[Tensor, "N D"], mask: Bool[Tensor, " N"]) -> UInt8[Tensor, "R 32"]:
    """The first MAX_DESCRIPTORS descriptors of the mask, as bits."""
    return binarize(descriptors[torch.nonzero(mask)[:MAX_DESCRIPTORS, 0]])
