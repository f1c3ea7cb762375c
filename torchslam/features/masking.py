"""Features only where they are wanted."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchslam.types import Features


def only_where(features: Features, wanted: Tensor) -> Features:
    """Features without the keypoints whose nearest pixel is not wanted; pixels beyond the image count as its edge.

    wanted: (B, 1, H, W) bool.
    """
    height, width = wanted.shape[-2:]
    x, y = features.keypoints.detach().round().to(torch.int64).unbind(-1)
    inside = wanted[:, 0].flatten(1).gather(1, y.clamp(0, height - 1) * width + x.clamp(0, width - 1))
    return replace(features, mask=features.mask & inside)
