"""Ways of scoring how much two images look alike: all (N, N) scores of a collection at once."""

from __future__ import annotations

import torch
from torch import Tensor

from experiments.places.train import k_majority
from torchslam.features import match, unpack_bits
from torchslam.features.matching.hamming import sign_products
from torchslam.loop_closing import KeyframeDatabase
from torchslam.types import Features


def places(features: Features, strongest: int, words: Tensor | None = None) -> Tensor:
    """torchslam.loop_closing, with so many descriptors of each image (at most the 400 it takes)."""
    memory, mask = KeyframeDatabase(words), features.mask.clone()
    mask[:, strongest:] = False
    for key in range(len(mask)):
        memory.add(key, features.descriptors[key], mask[key])
    scores = torch.zeros(len(mask), len(mask))
    for row in range(len(mask)):
        keys, values = memory.query(features.descriptors[row], mask[row])
        scores[row, keys] = values
    return scores


def bag_of_words(features: Features, words: Tensor) -> Tensor:
    """Cosine of tf-idf vectors, as one matrix product."""
    rows = [sign_products(image, words, 1).argmax(1) for image in features.descriptors]
    return _cosines(_histograms(torch.stack(rows), features.mask, len(words)))


def hash_tables(features: Features, bits: int, tables: int) -> Tensor:
    """No words: the value of some bits chosen at random is the word; mean over several such choices."""
    generator = torch.Generator().manual_seed(1)
    unpacked = unpack_bits(features.descriptors)
    total = torch.zeros(len(unpacked), len(unpacked))
    for _ in range(tables):
        chosen = torch.randperm(unpacked.shape[-1], generator=generator)[:bits]
        code = (unpacked[..., chosen].long() << torch.arange(bits)).sum(-1)
        total += _cosines(_histograms(code, features.mask, 1 << bits).sqrt())
    return total / tables


def direct(features: Features, strongest: int, ratio: float | None, max_distance: float) -> Tensor:
    """No words: how many of the strongest keypoints match, mutually and by the ratio test."""
    part = features.rows(slice(strongest))
    rows = []
    for row in range(len(part.mask)):
        repeated = Features.cat([part[row : row + 1]] * len(part.mask))
        rows.append(match(repeated, part, ratio, max_distance=max_distance).mask.sum(1))
    return torch.stack(rows).float()


def own_words(features: Features, num_words: int) -> Tensor:
    """Words of the collection itself: what words that are made as the images come could reach at best."""
    descriptors = features.descriptors[features.mask]
    order = torch.randperm(len(descriptors), generator=torch.Generator().manual_seed(3))
    return k_majority(descriptors[order[:60_000]], num_words, 8)


def first_words(features: Features, image: int) -> Tensor:
    """The descriptors of one image as words, as torchslam.loop_closing does for floats."""
    return features.descriptors[image][features.mask[image]][:400]


def _histograms(words: Tensor, mask: Tensor, size: int) -> Tensor:
    return torch.zeros(len(words), size).scatter_add_(1, words, mask.float())


def _cosines(histograms: Tensor) -> Tensor:
    rarity = torch.log(len(histograms) / (histograms > 0).sum(0).clamp(min=1))
    vectors = torch.nn.functional.normalize(histograms * rarity, dim=1)
    return vectors @ vectors.T
