"""Small dense symmetric systems that may be singular: solved where possible, flagged where not."""

from __future__ import annotations

import torch
from torch import Tensor


def solve_definite(matrix: Tensor, right: Tensor) -> tuple[Tensor, Tensor]:
    """Solve symmetric positive definite systems. (..., D, D), (..., D, K) -> solution (..., D, K), definite (...).

    Scaled to a unit diagonal first, so that "definite" does not depend on units. The solution is zero where the matrix
    is not definite, or only so by rounding.
    """
    diagonal = matrix.diagonal(dim1=-2, dim2=-1)
    scale = torch.where(diagonal > 0, diagonal, 1.0).rsqrt()
    scaled = scale[..., :, None] * matrix * scale[..., None, :]
    factor, info = torch.linalg.cholesky_ex(scaled)
    pivots = factor.diagonal(dim1=-2, dim2=-1)
    definite = (info == 0) & (pivots > torch.finfo(matrix.dtype).eps ** 0.4).all(-1)
    solution = scale[..., None] * torch.cholesky_solve(scale[..., None] * right, factor)
    return torch.where(definite[..., None, None], solution, 0.0), definite
