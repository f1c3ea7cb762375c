"""Rotations of views that agree with the relative ones between them, near the given ones: robust least squares.

Source: Chatterjee and Govindu, "Efficient and robust large-scale rotation averaging", 2013; here with the given
rotations as measurements of their own, as certain as they agree with the relative ones.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchslam.geometry import so3_exp, so3_log

ITERATIONS = 20
RELATIVE_STD = math.radians(0.3)  # of a rotation between two views by their matches
MAD = 1.4826 / 1.54  # from the median of the length of three errors to the deviation of each, about


def average_rotations(R_cw: Tensor, first: Tensor, second: Tensor, R_21: Tensor) -> Tensor:
    """(K, 3, 3) rotations near R_cw (K, 3, 3) for which R_21 (E, 3, 3) lead from views first (E,) to second (E,).

    The errors of the given rotations are taken to be as large as they disagree with the relative ones.
    """
    if len(first) == 0:
        return R_cw
    given, count = R_cw, len(R_cw)
    residuals = so3_log(R_21 @ R_cw[first] @ R_cw[second].mT)
    given_std = max(RELATIVE_STD, MAD * float(residuals.norm(dim=-1).median()) / math.sqrt(2))
    eye = torch.eye(3, dtype=R_cw.dtype, device=R_cw.device)
    for _ in range(ITERATIONS):
        residuals = so3_log(R_21 @ R_cw[first] @ R_cw[second].mT)
        from_given = so3_log(given @ R_cw.mT)
        weights = _cauchy(residuals, 2 * RELATIVE_STD) / RELATIVE_STD**2
        own = _cauchy(from_given, 3 * given_std) / given_std**2
        # The residual of an edge changes by R_21 w_1 - w_2, that of a given rotation by -w.
        A = R_cw.new_zeros(count, count, 3, 3)
        W = weights[:, None, None]
        diagonal = A.new_zeros(count, 3, 3)
        diagonal.index_add_(0, first, W * eye).index_add_(0, second, W * eye)
        diagonal += own[:, None, None] * eye
        A[range(count), range(count)] = diagonal
        A.index_put_((first, second), -W * R_21.mT, accumulate=True)
        A.index_put_((second, first), -W * R_21, accumulate=True)
        b = own[:, None] * from_given
        b.index_add_(0, first, -weights[:, None] * (R_21.mT @ residuals[..., None])[..., 0])
        b.index_add_(0, second, weights[:, None] * residuals)
        step = torch.linalg.solve(A.transpose(1, 2).reshape(3 * count, 3 * count), b.flatten()).view(count, 3)
        R_cw = so3_exp(step) @ R_cw
        if float(step.abs().max()) < 1e-8:
            break
    return R_cw


def _cauchy(residuals: Tensor, scale: float) -> Tensor:
    """(n,) weights of residuals (n, 3)."""
    return 1 / (1 + residuals.square().sum(-1) / scale**2)
