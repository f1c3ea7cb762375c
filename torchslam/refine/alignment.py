"""The frame and the unit of the given poses: what adjusted poses have lost, and get back."""

from __future__ import annotations

import torch
from torch import Tensor

from torchslam.geometry import se3_inverse

MAX_OUTLIER_RATIO = 4.0  # times the median: a given position so far off does not count


def align_to_input(T_cw: Tensor, given_cw: Tensor) -> Tensor:
    """S (4, 4) that leads from the world of poses T_cw (N, 4, 4) to that of the given ones (N, 4, 4).

    Centres and orientations count alike: centres on a line say nothing of the turn about it, and orientations nothing
    of the rest. Where the centres have no extent, the unit stays.
    """
    T_wc, given = se3_inverse(T_cw), se3_inverse(given_cw)
    counts = torch.ones(len(T_wc), dtype=torch.bool, device=T_wc.device)
    for _ in range(3):
        S = _similarity(T_wc[counts], given[counts])
        moved = T_wc[:, :3, 3] @ S[:3, :3].mT + S[:3, 3]
        off = torch.linalg.vector_norm(moved - given[:, :3, 3], dim=-1)
        counts = off <= MAX_OUTLIER_RATIO * off.median().clamp(min=1e-12)
    return S


def _similarity(T_wc: Tensor, given: Tensor) -> Tensor:
    source, target = T_wc[:, :3, 3], given[:, :3, 3]
    x, y = source - source.mean(0), target - target.mean(0)
    extent = (x.square().sum() * y.square().sum()).sqrt()
    M = (given[:, :3, :3] @ T_wc[:, :3, :3].mT).mean(0) + (y.mT @ x) / extent.clamp(min=1e-300)
    U, _, Vh = torch.linalg.svd(M)
    U[:, 2] *= torch.linalg.det(U @ Vh).sign()
    R = U @ Vh
    scale = (y * (x @ R.mT)).sum() / x.square().sum() if float(extent) > 0 else x.new_ones(())
    S = torch.eye(4, dtype=x.dtype, device=x.device)
    S[:3, :3] = scale * R
    S[:3, 3] = target.mean(0) - scale * (R @ source.mean(0))
    return S
