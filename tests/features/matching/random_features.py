"""Random features for the tests of matching."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from torchslam.features import hamming
from torchslam.types import Features, Matches

WIDTH, HEIGHT = 320, 240


def features(batch: int, count: int, seed: int = 0, floats: int | None = None) -> Features:
    """Random keypoints, some of them masked."""
    g = torch.Generator().manual_seed(seed)
    keypoints = torch.rand(batch, count, 2, generator=g) * torch.tensor([WIDTH, HEIGHT])
    level = torch.randint(0, 3, (batch, count), generator=g)
    if floats is None:
        descriptors = torch.randint(0, 256, (batch, count, 32), dtype=torch.uint8, generator=g)
    else:
        descriptors = torch.nn.functional.normalize(torch.randn(batch, count, floats, generator=g), dim=-1)
    return Features(
        keypoints=keypoints,
        scores=torch.rand(batch, count, generator=g),
        scales=1.2**level,
        angles=(torch.rand(batch, count, generator=g) * 2 - 1) * math.pi,
        descriptors=descriptors,
        mask=torch.rand(batch, count, generator=g) < 0.9,
    )


def disturbed(first: Features, seed: int, flips: int = 30) -> Features:
    """The same features in another order, with some bits flipped (floats: some noise)."""
    g = torch.Generator().manual_seed(seed)
    order = torch.randperm(first.mask.shape[1], generator=g)
    second = first.rows(order)
    d = second.descriptors
    if d.dtype == torch.uint8:
        noise = torch.rand(*d.shape, 8, generator=g) < flips / 256
        d = d ^ (noise * 2 ** torch.arange(8)).sum(-1).to(torch.uint8)
    else:
        d = torch.nn.functional.normalize(d + 0.1 * torch.randn(d.shape, generator=g), dim=-1)
    return replace(second, descriptors=d)


def pairs(matches: Matches, row: int = 0) -> dict[int, int]:
    kept = matches.mask[row]
    return dict(
        zip(matches.indices_1[row][kept].tolist(), matches.indices_2[row][kept].tolist(), strict=True)
    )


def distances_between(first: Features, second: Features) -> Tensor:
    if first.descriptors.dtype == torch.uint8:
        return hamming(first.descriptors, second.descriptors).float()
    return 1 - first.descriptors @ second.descriptors.mT
