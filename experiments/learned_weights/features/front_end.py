"""What is trained: a small network that moves keypoints by up to a few pixels, behind an extractor that stays."""

from __future__ import annotations

from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from torchslam import Features

RADIUS = 5  # of the patch around a keypoint, pixels
NUM_INPUTS = (2 * RADIUS + 1) ** 2
REACH = 3.0  # pixels a keypoint may move along x and along y
NOISE = 0.02  # gray value below which contrast is not amplified


class SubPixel(nn.Module):
    """Features of a feature extractor, their keypoints moved by what the image patches around them suggest.

    extractor: module from images (B, 1, H, W) to Features; it gets no gradient
    width:     of the hidden layers
    reach:     pixels
    seed:      of the weights; without training nothing moves
    """

    def __init__(self, extractor: nn.Module, width: int = 64, reach: float = REACH, seed: int = 0) -> None:
        super().__init__()
        self.extractor = extractor.requires_grad_(False)
        self.reach = reach
        layers = [nn.Linear(NUM_INPUTS, width), nn.Linear(width, width), nn.Linear(width, 2)]
        generator = torch.Generator().manual_seed(seed)
        for layer in layers:
            nn.init.kaiming_uniform_(layer.weight, generator=generator)
            nn.init.zeros_(layer.bias)
        nn.init.zeros_(layers[-1].weight)
        self.network = nn.Sequential(layers[0], nn.ReLU(), layers[1], nn.ReLU(), layers[2])

    def forward(self, images: Tensor) -> Features:
        features = self.extractor(images)
        moves = self.moves(patches(images, features.keypoints))
        return replace(features, keypoints=features.keypoints + moves)

    def moves(self, inputs: Tensor) -> Tensor:
        """(..., NUM_INPUTS) of `patches` -> (..., 2) pixels."""
        return self.reach * torch.tanh(self.network(inputs))


class Remembering(nn.Module):
    """A feature extractor that caches the features of its last images."""

    def __init__(self, extractor: nn.Module) -> None:
        super().__init__()
        self.extractor = extractor
        self._last: tuple[Tensor, Features] | None = None

    def forward(self, images: Tensor) -> Features:
        if self._last is None or self._last[0] is not images:
            self._last = images, self.extractor(images)
        return self._last[1]


def patches(images: Tensor, keypoints: Tensor) -> Tensor:
    """(B, N, NUM_INPUTS) gray values around keypoints (B, N, 2), row by row, with mean 0 and deviation 1."""
    height, width = images.shape[-2:]
    axis = torch.arange(-RADIUS, RADIUS + 1, device=images.device, dtype=images.dtype)
    around = torch.cartesian_prod(axis, axis).flip(-1)  # (x, y)
    places = keypoints.detach().to(images.dtype)[:, :, None] + around
    grid = (2 * places + 1) / places.new_tensor([width, height]) - 1
    values = F.grid_sample(images, grid, mode="bilinear", padding_mode="border", align_corners=False)[:, 0]
    values = values - values.mean(-1, keepdim=True)
    return values / (values.std(-1, keepdim=True) + NOISE)
