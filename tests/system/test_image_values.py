"""Images that are not gray in [0, 1] are refused wherever they come in, with one error."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from torchslam import ORB, SIFT, SLAM, Camera, ClipSLAM, Frame, OpenCVORB
from torchslam.errors import FrameError

CAMERA = Camera.pinhole(100.0, 100.0, 63.5, 47.5, size=(128, 96))
GRAY = torch.rand(1, 1, 96, 128, generator=torch.Generator().manual_seed(0))
ENTRIES: dict[str, Callable[[Tensor], object]] = {
    "ORB": lambda image: ORB(50)(image),
    "differentiable ORB": lambda image: ORB(50, differentiable=True)(image),
    "OpenCVORB": lambda image: OpenCVORB(50)(image),
    "SIFT": lambda image: SIFT(50)(image),
    "SLAM.step": lambda image: SLAM(CAMERA).step(Frame(0, 0.0, image)),
    "SLAM.step_image": lambda image: SLAM(CAMERA).step_image(image[0, 0].numpy(), 0.0),
    "ClipSLAM": lambda image: ClipSLAM(ORB(50))(image.expand(4, -1, -1, -1), CAMERA),
}


@pytest.mark.parametrize("entry", ENTRIES.values(), ids=ENTRIES)
def test_values_out_of_range_are_refused(entry: Callable[[Tensor], object]) -> None:
    hole = GRAY.clone()
    hole[0, 0, 20, 30] = torch.nan
    for image, span in (
        (255 * GRAY, "from .* to 25"),
        (GRAY - 0.5, "from -0.*to 0.4"),
        (hole, "from nan to nan"),
    ):
        with pytest.raises(FrameError, match=rf"must be in \[0, 1\], these are {span}"):
            entry(image)
    entry(GRAY)


def test_a_frame_of_bytes_or_with_a_mask_of_numbers_is_refused() -> None:
    slam = SLAM(CAMERA)
    with pytest.raises(FrameError, match=r"frame 0 must be floats in \[0, 1\], not torch.uint8: divide"):
        slam.step(Frame(0, 0.0, (255 * GRAY).to(torch.uint8)))
    with pytest.raises(
        FrameError, match=r"frame 0 has a mask of torch.float32, not torch.bool: compare it with 0"
    ):
        slam.step(Frame(0, 0.0, GRAY, mask=torch.ones_like(GRAY)))
    assert slam.step(Frame(0, 0.0, GRAY)).T_cw is None  # the frame can be tried again
    with pytest.raises(FrameError):
        slam.step_image(np.full((96, 128), 300, np.uint16), 1.0)
