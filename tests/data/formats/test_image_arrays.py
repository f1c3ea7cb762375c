"""Images of one's own loop."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchslam import SLAM
from torchslam.config import load_config
from torchslam.data import open_sequence
from torchslam.data.formats.image_file import image_tensor
from torchslam.errors import FrameError

GREEN = np.zeros((4, 6, 3), np.uint8)
GREEN[..., 1] = 200
RED = GREEN[..., [1, 0, 2]]


@pytest.mark.parametrize(
    ("image", "channels", "gray"),
    [
        (RED, "rgb", 0.299 * 200),
        (RED, "bgr", 0.114 * 200),
        (RED[..., ::-1], "bgr", 0.299 * 200),
        (np.dstack([RED, GREEN[..., :1]]), "rgba", 0.299 * 200),
        (np.dstack([RED, GREEN[..., :1]]), "bgra", 0.114 * 200),
        (GREEN[..., 1], "rgb", 200),
        (GREEN[..., 1:2], "gray", 200),
    ],
)
def test_images_of_every_channel_count_are_accepted(image: np.ndarray, channels: str, gray: float) -> None:
    tensor = image_tensor(image, channels)
    assert (tensor.shape, tensor.dtype) == ((1, 1, 4, 6), torch.float32)
    assert float(tensor.mean()) == pytest.approx(gray / 255, abs=0.6 / 255)
    for kind in (np.float32, np.float64):
        scaled = image_tensor((image / 255).astype(kind), channels)
        torch.testing.assert_close(scaled, tensor, atol=0.6 / 255, rtol=0)


@pytest.mark.parametrize(
    ("image", "channels", "message"),
    [
        (RED, "hsv", "channels must be one of gray, rgb"),
        (RED, "gray", r"must be \(H, W\)"),
        (RED, "rgba", r"\(H, W, 4\) for channels 'rgba', not \(4, 6, 3\)"),
        (RED[0, 0], "rgb", r"not \(3,\)"),
        (RED[:0], "rgb", r"not \(0, 6, 3\)"),
        (RED.astype(np.uint16), "rgb", "not uint16: divide it by what is white"),
        (RED.astype(np.float32), "rgb", "these are from 0 to 200"),
        (np.full((4, 6), np.nan), "rgb", r"must be in \[0, 1\]"),
    ],
)
def test_wrong_images(image: np.ndarray, channels: str, message: str) -> None:
    with pytest.raises(FrameError, match=message):
        image_tensor(image, channels)


def test_step_accepts_an_image_array() -> None:
    sequence = open_sequence("synthetic:room").part(0, 3)
    frames, images = (
        SLAM(sequence.camera, load_config(None, ["features.kind=opencv-orb"])) for _ in range(2)
    )
    for frame in sequence:
        expected = frames.step(frame)
        array = (frame.image[0, 0] * 255).round().to(torch.uint8).numpy()
        result = images.step_image(array, frame.timestamp)
        assert (result.index, result.state, result.reason) == (
            expected.index,
            expected.state,
            expected.reason,
        )
    with pytest.raises(FrameError, match="does not come after"):
        images.step_image(array, 0.0)
    with pytest.raises(FrameError, match="640 x 480"):
        images.step_image(array[:100], 100.0)
