"""What a camera saw stays where the camera sees it, when the camera gets another pose and another unit of length."""

from __future__ import annotations

import torch
from torch import Tensor

from torchslam.geometry.lie import rigid, sim3_inverse, sim3_scale, transform


def carry_points(
    points_w: Tensor, covariances_w: Tensor, normals_w: Tensor, T_cw: Tensor, S_cw: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Points, their covariances and unit normals in the world in which a similarity S_cw stands for the pose T_cw.

    points_w: (..., 3); covariances_w: (..., 3, 3); normals_w: (..., 3); T_cw, S_cw: (..., 4, 4), one for each point,
    world to camera. What is seen in the direction and with the relative depth p_c = T_cw p is seen so by S_cw after.
    """
    S_wc = sim3_inverse(S_cw)
    moved_w = transform(S_wc, transform(T_cw, points_w[..., None, :]))[..., 0, :]
    R_wc = S_wc[..., :3, :3] @ T_cw[..., :3, :3]
    normals = (sim3_scale(S_cw)[..., None, None] * R_wc @ normals_w[..., None])[..., 0]
    return moved_w, R_wc @ covariances_w @ R_wc.mT, normals


def with_unit(T: Tensor, unit: Tensor) -> Tensor:
    """Rigid transforms (..., 4, 4) in a unit of length that is (...) times as long."""
    return rigid(T[..., :3, :3], T[..., :3, 3] / unit[..., None])


def without_scale(S_cw: Tensor) -> Tensor:
    """The pose (..., 4, 4) of the camera of a similarity: its rotation and its centre, in the unit of the world."""
    scale = sim3_scale(S_cw)
    return rigid(S_cw[..., :3, :3] / scale[..., None, None], S_cw[..., :3, 3] / scale[..., None])


def covariances_with_unit(covariances: Tensor, unit: Tensor) -> Tensor:
    """Covariances (..., 6, 6) of poses, translation first, in a unit of length that is (...) times as long."""
    units = torch.ones_like(covariances[..., 0])
    units[..., :3] = 1 / unit[..., None]
    return units[..., :, None] * covariances * units[..., None, :]
