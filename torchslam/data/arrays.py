"""Images of one's own, as arrays, to tensors."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from torch import Tensor

from torchslam.errors import FrameError

CHANNELS = {
    "gray": None,
    "rgb": cv2.COLOR_RGB2GRAY,
    "bgr": cv2.COLOR_BGR2GRAY,
    "rgba": cv2.COLOR_RGBA2GRAY,
    "bgra": cv2.COLOR_BGRA2GRAY,
}
"""Orders of channels, and how OpenCV makes them gray."""


def image_tensor(image: np.ndarray, channels: str = "rgb") -> Tensor:
    """An array (H, W) or (H, W, C), uint8, or floats in [0, 1] -> (1, 1, H, W) float32 gray in [0, 1].

    channels: the order of the C channels, one of CHANNELS; an image with a single one is gray whatever is said

    Raises FrameError for another shape or type, and for floats that are not in [0, 1].
    """
    array = np.asarray(image)
    if channels not in CHANNELS:
        raise FrameError(f"channels must be one of {', '.join(CHANNELS)}, not {channels!r}")
    if array.ndim == 3 and array.shape[2] == 1:
        array = array[:, :, 0]
    expected = len(channels)
    if 0 in array.shape or not (
        array.ndim == 2 or (array.ndim == 3 and array.shape[2] == expected and channels != "gray")
    ):
        raise FrameError(
            f"an image must be (H, W), or (H, W, {expected}) for channels {channels!r}, not {array.shape}"
        )
    if array.dtype != np.uint8 and array.dtype.kind != "f":
        raise FrameError(
            f"an image must be uint8, or floats in [0, 1], not {array.dtype}: divide it by what is white in it"
        )
    if array.dtype.kind == "f":
        array = array.astype(np.float32)
        if not (array.min() >= 0 and array.max() <= 1):  # also for NaN
            raise FrameError(f"floats must be in [0, 1], these are from {array.min():g} to {array.max():g}")
    code = CHANNELS[channels]
    gray = array if array.ndim == 2 or code is None else cv2.cvtColor(np.ascontiguousarray(array), code)
    tensor = torch.from_numpy(np.ascontiguousarray(gray).astype(np.float32))
    return (tensor / 255.0 if array.dtype == np.uint8 else tensor)[None, None]
