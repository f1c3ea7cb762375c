"""Dense symmetric systems that may be singular: solved where they are definite, flagged where not."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class DefiniteFactor:
    """Cholesky factors of symmetric matrices that were scaled to a unit diagonal.

    scale:    (..., D) such that scale * matrix * scale has a unit diagonal
    factor:   (..., D, D) lower triangular
    definite: (...) bool, the matrix is positive definite, whatever its units
    """

    scale: Tensor
    factor: Tensor
    definite: Tensor

    def solve(self, right: Tensor) -> Tensor:
        """matrix^-1 right, zero where the matrix is not definite. (..., D, K) -> (..., D, K)."""
        scale = self.scale[..., None]
        solution = scale * torch.cholesky_solve(scale * right, self.factor)
        return torch.where(self.definite[..., None, None], solution, 0.0)

    def inverse_root(self) -> Tensor:
        """Q with Q^T Q = matrix^-1, zero where the matrix is not definite. -> (..., D, D)."""
        root = torch.linalg.solve_triangular(self.factor, torch.diag_embed(self.scale), upper=False)
        return torch.where(self.definite[..., None, None], root, 0.0)


def factorize(matrix: Tensor, strict: bool = True) -> DefiniteFactor:
    """Cholesky factorisation of symmetric (..., D, D) matrices that never raises.

    strict: count a matrix as definite only if it is clearly so, beyond rounding.
    """
    diagonal = matrix.diagonal(dim1=-2, dim2=-1)
    scale = torch.where(diagonal > 0, diagonal, 1.0).rsqrt()
    scaled = scale[..., :, None] * matrix * scale[..., None, :]
    factor, info = torch.linalg.cholesky_ex(scaled)
    definite = info == 0
    if strict:
        smallest = torch.finfo(matrix.dtype).eps ** 0.4
        definite = definite & (factor.diagonal(dim1=-2, dim2=-1) > smallest).all(-1)
    if not definite.all():  # unit matrices instead: what follows stays finite, its gradient included
        unit = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
        factor, _ = torch.linalg.cholesky_ex(torch.where(definite[..., None, None], scaled, unit))
    return DefiniteFactor(scale, factor, definite)
