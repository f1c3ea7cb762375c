"""Small windows of the images of a submap, to be compared by their correlation."""

from __future__ import annotations

import math

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.errors import FrameError
from torchslam.metric.source import SubmapView

CONTRAST = 2.0 / 255
"""Minimum standard deviation of the gray levels of a window; flatter ones count as noise."""


def read_gray(view: SubmapView, frame_index: int) -> Float[np.ndarray, "H W"] | None:
    """Read an image of a view that has a sequence; None if it cannot be read."""
    assert view.sequence is not None  # the caller's condition
    try:
        return view.sequence.image(frame_index)[0, 0].cpu().numpy()
    except FrameError:
        return None


def sample_windows(
    image: Float[np.ndarray, "H W"], pixels: Float[Tensor, "W P 2"], seen: Tensor | None = None
) -> Float[np.ndarray, "W P"]:
    """Sample windows of P pixels, normalized to mean zero and unit length; flat ones are nearly zero.

    Args:
        image: gray levels; beyond it are those of its border.
        pixels: x and y.
        seen: pixels that are defined; others are sampled at the origin.
    """
    if seen is not None:
        pixels = torch.where(seen[..., None], pixels, 0.0)
    x, y = pixels.numpy().astype(np.float32).transpose(2, 0, 1)
    window = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(float)
    window -= window.mean(axis=-1, keepdims=True)
    least = CONTRAST * math.sqrt(window.shape[-1])
    normalized: Float[np.ndarray, "W P"] = window / np.maximum(
        np.linalg.norm(window, axis=-1, keepdims=True), least
    )
    return normalized
