"""A slanted plane with a smooth texture, whose images and depth are known exactly."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.geometry import Camera, se3_exp, se3_inverse

NORMAL = (0.25, -0.15, -1.0)
DISTANCE = 2.0
NEAR, FAR = 1.0, 5.0
MOVES = ((0.25, 0.0), (-0.25, 0.02), (0.02, 0.2), (-0.1, -0.2))


def a_camera(width: int, height: int, dtype: torch.dtype = torch.float64) -> Camera:
    camera = Camera.pinhole(0.9 * width, 0.9 * width, (width - 1) / 2, (height - 1) / 2, (width, height))
    return camera.to(dtype)


def poses(count: int = 4) -> Float[Tensor, "V 4 4"]:
    """T_sr of views that moved sideways and turned a little, from the camera at the origin."""
    tangents = [[-x, -y, 0.02 * x, 0.2 * y, -0.2 * x, 0.05 * x] for x, y in MOVES[:count]]
    return se3_exp(torch.tensor(tangents, dtype=torch.float64))


def depth_of(T_cw: Float[Tensor, "V 4 4"], camera: Camera) -> Float[Tensor, "V H W"]:
    """Depth of the plane in views."""
    rays = _rays(camera)
    T_wc = se3_inverse(T_cw)
    n = torch.tensor(NORMAL, dtype=torch.float64)
    along = torch.einsum("i,vij,hwj->vhw", n, T_wc[:, :3, :3], rays)
    return (-DISTANCE - T_wc[:, :3, 3] @ n)[:, None, None] / along


def images_of(T_cw: Float[Tensor, "V 4 4"], camera: Camera) -> Float[Tensor, "V H W"]:
    """Gray images of the plane in views."""
    T_wc = se3_inverse(T_cw)
    points_c = _rays(camera) * depth_of(T_cw, camera)[..., None]
    points_w = torch.einsum("vij,vhwj->vhwi", T_wc[:, :3, :3], points_c) + T_wc[:, None, None, :3, 3]
    x, y = points_w[..., 0], points_w[..., 1]
    gray = torch.zeros_like(x)
    for number, (a, b) in enumerate(((9, 2), (-4, 11), (17, -7), (6, 19), (-23, 5), (13, 24))):
        gray = gray + torch.sin(a * x + b * y + number) / 6
    return 0.5 + 0.4 * gray


def scene(
    width: int, height: int, count: int = 4
) -> tuple[
    Float[Tensor, "H W"], Float[Tensor, "V H W"], Camera, Float[Tensor, "V 4 4"], Float[Tensor, "H W"]
]:
    """Reference image, other images, camera, T_sr and the exact depth of the reference."""
    camera, T_sr = a_camera(width, height), poses(count)
    eye = torch.eye(4, dtype=torch.float64)[None]
    return images_of(eye, camera)[0], images_of(T_sr, camera), camera, T_sr, depth_of(eye, camera)[0]


def _rays(camera: Camera) -> Float[Tensor, "H W 3"]:
    y, x = torch.meshgrid(
        *(torch.arange(side, dtype=torch.float64) for side in reversed(camera.size)), indexing="ij"
    )
    fx, fy, cx, cy = camera.params.double().unbind()
    return torch.stack(((x - cx) / fx, (y - cy) / fy, torch.ones_like(x)), dim=-1)
