"""Motion between cameras, as one speaks of it."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchslam.geometry.lie import rigid, se3_inverse


def apart(T_cw: Tensor, T_kw: Tensor, depth: Tensor | float) -> tuple[Tensor, Tensor]:
    """(k,), (k,) how far cameras T_kw (k, 4, 4) are from T_cw (4, 4): shares of a depth, and degrees."""
    T_ck = T_cw @ se3_inverse(T_kw)
    translation = torch.linalg.vector_norm(T_ck[:, :3, 3], dim=-1) / depth
    return translation, torch.rad2deg(rotation_angle(T_ck[:, :3, :3]))


def rotation_angle(R: Tensor) -> Tensor:
    """Angles of rotation matrices, to decide by: without a gradient at 0 and pi. (..., 3, 3) -> (...) radians."""
    sine = torch.linalg.vector_norm(R - R.mT, dim=(-2, -1)) / math.sqrt(8)
    cosine = (R.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    return torch.atan2(sine, cosine)


def reorthonormalized(T: Tensor) -> Tensor:
    """Rigid transforms (..., 4, 4) whose rotations are so to rounding, of such that are so nearly.

    Where a pose is predicted from those before it, with transposes for inverses, what they lack of a rotation grows by
    1 + sqrt(2) from frame to frame. One step of Newton's iteration for the polar decomposition (Higham, 1986).
    """
    R = T[..., :3, :3]
    return rigid(1.5 * R - 0.5 * R @ (R.mT @ R), T[..., :3, 3])
