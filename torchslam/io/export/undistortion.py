"""Images and keypoints as a camera without distortion would have them."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import torch
from torch import Tensor

from torchslam.errors import ResultsError
from torchslam.geometry import Camera
from torchslam.io.export.scene import Scene

MAX_GROWTH = 2.0  # of width and height: toward 90 degrees from the axis a plane has no end


def pinhole_within(camera: Camera) -> Camera:
    """The pinhole camera with the largest field of view all of which the camera sees.

    Its focal lengths are those of the camera, so that the middle of the image keeps its size and pixels their shape;
    shorter only where the image would be more than MAX_GROWTH times as wide or high.

    Raises ResultsError for a camera that sees too much for one.
    """
    if camera.model == "pinhole":
        return camera
    x, y = (torch.arange(size, dtype=camera.params.dtype) for size in camera.size)
    left, right = (camera.normalize(_line(at, y))[:, 0] for at in (0, camera.width - 1))
    top, bottom = (camera.normalize(_line(at, x).flip(1))[:, 1] for at in (0, camera.height - 1))
    low, high = torch.stack((left.max(), top.max())), torch.stack((right.min(), bottom.min()))
    focal = camera.params[:2]
    extent, size = (high - low) * focal, torch.tensor(camera.size)
    if not bool((extent >= 1).all()):
        raise ResultsError("the camera's field of view is too wide for an image without distortion")
    scale = (MAX_GROWTH * size / extent).min().clamp(max=1.0)
    width, height = (int(side) + 1 for side in scale * extent)
    params = torch.cat((scale * focal, -scale * focal * low))
    return Camera("pinhole", params, (width, height))


def undistorted(scene: Scene) -> Scene:
    """The scene as `pinhole_within` of its camera sees it; keypoints may lie outside of the new images."""
    if scene.camera.model == "pinhole":
        return scene
    pinhole = pinhole_within(scene.camera)
    return replace(scene, camera=pinhole, pixels=undistorted_pixels(scene.pixels, scene.camera, pinhole))


def undistorted_pixels(pixels: Tensor, camera: Camera, pinhole: Camera) -> Tensor:
    """(N, 2) pixels of a camera as its `pinhole_within` sees them."""
    return camera.normalize(pixels) * pinhole.params[:2] + pinhole.params[2:]


class Undistorter:
    """Images of a camera as its `pinhole_within` would have taken them."""

    def __init__(self, camera: Camera) -> None:
        pinhole = pinhole_within(camera)
        v, u = torch.meshgrid(*(torch.arange(size) for size in reversed(pinhole.size)), indexing="ij")
        rays = torch.nn.functional.pad(
            pinhole.normalize(torch.stack((u, v), -1).flatten(0, 1).double()), (0, 1), value=1.0
        )
        pixels = camera.project(rays)[0].reshape(pinhole.height, pinhole.width, 2)
        self._x, self._y = (pixels[..., axis].float().numpy() for axis in (0, 1))

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """(H, W, C) uint8 -> the same in the new size."""
        # A pixel of the rim may come to lie outside by a thousandth: the rim is sampled at its pixels.
        return cv2.remap(image, self._x, self._y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def _line(at: int, values: Tensor) -> Tensor:
    """(N, 2) pixels (at, values)."""
    return torch.stack((torch.full_like(values, at), values), dim=-1)
