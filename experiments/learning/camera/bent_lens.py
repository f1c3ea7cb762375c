"""Rendered recordings through a bent lens: radial and tangential distortion, and a grid of offsets on top of it."""

from __future__ import annotations

import cv2
import torch
from jaxtyping import Float
from torch import Tensor

from examples.learn_camera import GRID, LearnedCamera
from torchslam.data.sequence import Sequence, Transformed
from torchslam.geometry import Camera

SIZE = (320, 240)
FOCAL = 300.0
"""Pixels, longer than that of the rendered images at this size: they have to cover what the lens bends in."""
SAMPLES = 2  # of a pixel, in each direction
FOCAL_SPREAD, CENTER_SPREAD = 0.02, 3.0  # share, and pixels
DISTORTION = (-0.15, 0.03, 0.0, 0.0)  # k1, k2, p1, p2
DISTORTION_SPREAD = (0.05, 0.02, 0.001, 0.001)
GRID_SPREAD = 1.0  # pixels at each node


def bent_lens(seed: int) -> LearnedCamera:
    """A random lens that is not as its camera says."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*size: int) -> Tensor:
        return torch.randn(*size, generator=generator, dtype=torch.float64)

    focal = FOCAL * (FOCAL_SPREAD * normal(2)).exp()
    center = (torch.tensor(SIZE, dtype=torch.float64) - 1) / 2 + CENTER_SPREAD * normal(2)
    bend = torch.tensor(DISTORTION).double() + torch.tensor(DISTORTION_SPREAD).double() * normal(4)
    params = torch.cat((focal, center, bend, bend.new_zeros(1)))
    lens = LearnedCamera(Camera("radial_tangential", params, SIZE)).requires_grad_(False)
    lens.grid.copy_(GRID_SPREAD * normal(2, *GRID))
    return lens


class Bent(Transformed):
    """A rendered recording, of a pinhole camera, as a bent lens would have taken it; its images are kept.

    Raises:
        ValueError: The lens sees what lies outside of the images.
    """

    def __init__(self, whole: Sequence, lens: LearnedCamera, camera: Camera) -> None:
        """Take the images of `lens`; `camera` is what is known about it."""
        super().__init__(whole, camera=camera, size=camera.size)
        width, height = camera.size
        y, x = ((torch.arange(SAMPLES * side) + 0.5) / SAMPLES - 0.5 for side in (height, width))
        pixels = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1).reshape(1, -1, 2)
        with torch.no_grad():
            rays = lens.camera().unproject(lens.straightened(pixels.double())[0])
            seen, _ = whole.camera.project(rays)
        last = torch.tensor(whole.size) - 1
        if bool(((seen < 0) | (seen > last)).any()):
            raise ValueError(f"{whole.name}: the lens sees what lies outside of the images")
        self._x, self._y = seen.float().reshape(len(y), len(x), 2).unbind(-1)
        self._images: dict[int, Tensor] = {}

    def image(self, index: int) -> Float[Tensor, "1 1 H W"]:
        if index not in self._images:
            gray = super().image(index)[0, 0].numpy()
            x, y = (each.contiguous().numpy() for each in (self._x, self._y))
            fine = cv2.remap(gray, x, y, cv2.INTER_LINEAR)
            image = cv2.resize(fine, self.size, interpolation=cv2.INTER_AREA)
            self._images[index] = torch.from_numpy(image)[None, None]
        return self._images[index]


def ray_errors(lens: LearnedCamera, true: LearnedCamera) -> tuple[float, float]:
    """How far the rays of pixels are off, pixels: root mean square and largest, after the best rotation."""
    width, height = true.size
    x, y = (torch.linspace(0, side - 1, count).double() for side, count in ((width, 17), (height, 13)))
    pixels = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1).reshape(1, -1, 2)
    with torch.no_grad():
        found, exact = (
            torch.nn.functional.normalize(each.camera().unproject(each.straightened(pixels)[0]), dim=-1)
            for each in (lens, true)
        )
    U, _, Vt = torch.linalg.svd(exact.mT @ found)
    errors = FOCAL * (found @ (U @ Vt).mT - exact).norm(dim=-1)
    return float(errors.square().mean().sqrt()), float(errors.max())
