"""Normals of depth maps by planes fitted to inverse depth, which is linear in the pixel on a plane.

`kornia.geometry.depth_to_normals` differentiates depth between the next pixels: its normals are as noisy as the depth,
and wrong beside pixels without one. Here unknown pixels and those beyond an edge have no weight.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from torchslam.geometry import Camera

RADIUS = 3
"""Of the windows, pixels."""
EDGE = 0.05
"""Relative difference of depths from which on a pixel belongs to another surface."""
LEAST_SHARE = 0.3
"""Of a window that must be known."""


def depth_normals(
    depth: Float[Tensor, "B H W"], camera: Camera, radius: int = RADIUS
) -> Float[Tensor, "B 3 H W"]:
    """Compute unit normals in the camera frame, facing the camera; 0 where they or the depth are unknown.

    Differentiable with respect to depth and camera.
    """
    is_known = depth > 0
    q = torch.where(is_known, 1 / torch.where(is_known, depth, 1.0), 0.0)
    size = 2 * radius + 1
    height, width = depth.shape[-2:]

    def windows(values: Tensor) -> Tensor:
        return F.unfold(values[:, None], size, padding=radius).unflatten(-1, (height, width))

    around = windows(q)
    weight = ((around > 0) & ((around - q[:, None]).abs() <= EDGE * q[:, None])).to(q.dtype)
    offset = torch.arange(-radius, radius + 1, dtype=q.dtype, device=q.device)
    y, x = (each.flatten() for each in torch.meshgrid(offset, offset, indexing="ij"))
    # Least squares of q - q0 = a x + b y + c: the three moments of the window, centered.
    moments = torch.stack((torch.ones_like(x), x, y, x * x, y * y, x * y))
    sums = torch.einsum("mp,bphw->mbhw", moments, weight)
    total = sums[0].clamp(min=1)
    mean_x, mean_y, xx, yy, xy = sums[1:] / total
    sums = torch.einsum("mp,bphw->mbhw", moments[:3], weight * (around - q[:, None]))
    mean_q, xq, yq = sums / total
    xx, yy, xy = xx - mean_x**2, yy - mean_y**2, xy - mean_x * mean_y
    xq, yq = xq - mean_x * mean_q, yq - mean_y * mean_q
    determinant = xx * yy - xy * xy
    is_known = is_known & (total >= LEAST_SHARE * size**2) & (determinant > 0.1)
    safe = torch.where(is_known, determinant, 1.0)
    a, b = (yy * xq - xy * yq) / safe, (xx * yq - xy * xq) / safe
    # On the plane n X = 1 inverse depth is n (ray): n_x = fx a, n_y = fy b, and n_z makes it q at the pixel itself.
    fx, fy, cx, cy = (each[..., None, None] for each in camera.params.to(q).unbind(-1))
    row = torch.arange(height, dtype=q.dtype, device=q.device)[:, None]
    column = torch.arange(width, dtype=q.dtype, device=q.device)
    n_z = q + mean_q - a * (column + mean_x - cx) - b * (row + mean_y - cy)
    plane = torch.stack((fx * a, fy * b, n_z), dim=1)
    plane = torch.where(is_known[:, None], plane, plane.new_tensor((0.0, 0.0, 1.0))[:, None, None])
    # n X = 1 > 0 points away from the camera.
    return torch.where(is_known[:, None], -F.normalize(plane, dim=1), 0.0)
