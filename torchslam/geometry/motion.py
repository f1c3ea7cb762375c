"""Motion between cameras, as one speaks of it."""

from __future__ import annotations

import torch
from torch import Tensor

from torchslam.geometry.lie import se3_inverse, so3_log


def apart(T_cw: Tensor, T_kw: Tensor, depth: Tensor) -> tuple[Tensor, Tensor]:
    """(k,), (k,) how far cameras T_kw (k, 4, 4) are from T_cw (4, 4): shares of a depth (), and degrees."""
    T_ck = T_cw @ se3_inverse(T_kw)
    translation = torch.linalg.vector_norm(T_ck[:, :3, 3], dim=-1) / depth
    return translation, torch.rad2deg(torch.linalg.vector_norm(so3_log(T_ck[:, :3, :3]), dim=-1))
