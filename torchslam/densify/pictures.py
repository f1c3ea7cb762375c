"""Pictures of depth maps: image, depth and normals side by side."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from torchslam.errors import ResultsError

QUANTILES = (0.02, 0.98)
"""Of inverse depth, between which the colors reach from far (blue) to near (red)."""


def depth_colors(depth: Float[Tensor, "H W"]) -> UInt8[np.ndarray, "H W 3"]:
    """Colors of depth, blue, green, red; black where unknown."""
    is_known = depth > 0
    if not bool(is_known.any()):
        return np.zeros((*depth.shape, 3), np.uint8)
    inverse = torch.where(is_known, 1 / torch.where(is_known, depth, 1.0), 0.0)
    far, near = (
        inverse[is_known].quantile(torch.tensor(QUANTILES, dtype=inverse.dtype, device="cpu")).tolist()
    )
    scaled = ((inverse - far) / max(near - far, 1e-12)).clamp(0, 1)
    colors = cv2.applyColorMap((scaled * 255).round().to(torch.uint8).numpy(), cv2.COLORMAP_TURBO)
    colors[~is_known.numpy()] = 0
    return colors


def normal_colors(normal: Float[Tensor, "3 H W"]) -> UInt8[np.ndarray, "H W 3"]:
    """Colors of normals, blue, green, red: x right is red, y up is green, towards the camera is blue."""
    is_known = (normal != 0).any(0)
    shown = normal * normal.new_tensor((1.0, -1.0, -1.0))[:, None, None]
    colors = ((shown + 1) * 127.5).round().to(torch.uint8)
    return torch.where(is_known, colors, torch.zeros_like(colors)).flip(0).movedim(0, -1).contiguous().numpy()


def write_picture(
    path: Path,
    depth: Float[Tensor, "H W"],
    normal: Float[Tensor, "3 H W"],
    color: UInt8[Tensor, "H W 3"],
) -> None:
    """Write image, depth and normals side by side. Raises ResultsError."""
    parts = (cv2.cvtColor(color.numpy(), cv2.COLOR_RGB2BGR), depth_colors(depth), normal_colors(normal))
    if not cv2.imwrite(str(path), np.concatenate(parts, axis=1)):
        raise ResultsError(f"{path}: cannot be written")
