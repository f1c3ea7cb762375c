"""What is trained: a small network that moves keypoints by a fraction of a pixel, behind a front end that stays."""

from __future__ import annotations

from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from torchslam import Features

RADIUS = 5  # of the patch around a keypoint, pixels
REACH = 1.0  # pixels a keypoint may move along x and along y
NOISE = 0.02  # grey value below which contrast is not amplified


class SubPixel(nn.Module):
    """Features of a front end, their keypoints moved by what the image patches around them suggest.

    front_end: module from images (B, 1, H, W) to Features; it gets no gradient
    Without training nothing moves.
    """

    def __init__(self, front_end: nn.Module, width: int = 64) -> None:
        super().__init__()
        self.front_end = front_end.requires_grad_(False)
        size = (2 * RADIUS + 1) ** 2
        self.moves = nn.Sequential(
            nn.Linear(size, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU(), nn.Linear(width, 2)
        )
        nn.init.zeros_(self.moves[-1].weight)
        nn.init.zeros_(self.moves[-1].bias)

    def forward(self, images: Tensor) -> Features:
        features = self.front_end(images)
        moves = REACH * torch.tanh(self.moves(patches(images, features.keypoints)))
        return replace(features, keypoints=features.keypoints + moves)


def patches(images: Tensor, keypoints: Tensor) -> Tensor:
    """(B, N, S * S) grey values around the pixels nearest to keypoints (B, N, 2), with mean 0 and deviation 1."""
    height, width = images.shape[-2:]
    axis = torch.arange(-RADIUS, RADIUS + 1, device=images.device, dtype=images.dtype)
    around = torch.cartesian_prod(axis, axis).flip(-1)  # row by row, as (x, y)
    places = keypoints.detach().to(images.dtype).round()[:, :, None] + around
    grid = (2 * places + 1) / places.new_tensor([width, height]) - 1
    values = F.grid_sample(images, grid, mode="nearest", padding_mode="border", align_corners=False)[:, 0]
    values = values - values.mean(-1, keepdim=True)
    return values / (values.std(-1, keepdim=True) + NOISE)
