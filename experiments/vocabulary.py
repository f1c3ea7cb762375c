"""Build the vocabulary that torchslam.loop_closing ships: centers of ORB descriptors of rendered images."""

from __future__ import annotations

from pathlib import Path

import torch
from safetensors.torch import save_file
from torch import Tensor

import torchslam.loop_closing.keyframe_database
from torchslam.data import open_sequence
from torchslam.features import ORB, pack_bits
from torchslam.features.matching.hamming import sign_products, spread_bits

# Seed 0 is left to measurements, tests and demonstrations.
TRAINING = [f"synthetic:room?seed={seed}" for seed in range(1, 13)]
TRAINING += [f"synthetic:planar?seed={seed}" for seed in range(1, 7)]
DESCRIPTORS = 60_000
STRIDE = 16  # of 160 frames of each scene
NUM_WORDS = 1024
ROUNDS = 8


def main() -> None:
    torch.set_num_threads(1)
    words = k_majority(sample(rendered_descriptors(), DESCRIPTORS), NUM_WORDS, ROUNDS)
    path = Path(torchslam.loop_closing.keyframe_database.__file__).parent / "words.safetensors"
    save_file({"words": words}, path)
    print(f"{len(words)} words in {path}")


def rendered_descriptors() -> Tensor:
    """(n, 32) uint8: ORB descriptors of the training images."""
    orb, found = ORB(1000), []
    for name in TRAINING:
        for frame in open_sequence(name, stride=STRIDE):
            features = orb(frame.image)
            found.append(features.descriptors[features.mask])
    return torch.cat(found)


def sample(descriptors: Tensor, count: int, seed: int = 0) -> Tensor:
    """A random choice of rows."""
    order = torch.randperm(len(descriptors), generator=torch.Generator().manual_seed(seed))
    return descriptors[order[:count]]


def k_majority(descriptors: Tensor, num_words: int, rounds: int) -> Tensor:
    """Binary words (num_words, 32) by k-majority, k-means whose centers take the more frequent value of each bit.

    Starts at the first descriptors; a word that nothing is near to stays as it is. Source: Grana et al., "A fast
    approach for integrating ORB descriptors in the bag of words model", 2013.
    """
    words = descriptors[:num_words].clone()
    for _ in range(rounds):
        nearest = torch.cat([sign_products(part, words, 1).argmax(1) for part in descriptors.split(4096)])
        votes = torch.zeros(num_words, 8 * descriptors.shape[1])
        for part, rows in zip(descriptors.split(4096), nearest.split(4096), strict=True):
            votes.index_add_(0, rows, spread_bits(part, 1).float())
        used = torch.bincount(nearest, minlength=num_words) > 0
        words = torch.where(used[:, None], pack_bits(votes > 0), words)
    return words


if __name__ == "__main__":
    main()
