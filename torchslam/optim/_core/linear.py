"""Dense symmetric systems that may be singular: solved where they are definite, flagged where not."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

LOWER_3X3 = ((0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2))
"""The entries of a symmetric 3x3 block that are stored, in the order of `inverse_root_3x3`."""


def diagonal_floor(dtype: torch.dtype) -> float:
    """What a diagonal entry grows by to stay solvable without observations; its step is then zero."""
    return torch.finfo(dtype).tiny ** 0.5


def smallest_pivot(dtype: torch.dtype) -> float:
    """The pivot, of a matrix scaled to a unit diagonal, above which it is positive beyond rounding."""
    return torch.finfo(dtype).eps ** 0.4


@dataclass(frozen=True)
class DefiniteFactor:
    """Cholesky factors of symmetric matrices that were scaled to a unit diagonal.

    Attributes:
        scale: such that scale * matrix * scale has a unit diagonal
        factor: lower triangular
        definite: the matrix is positive definite, whatever its units
    """

    scale: Float[Tensor, "*batch D"]
    factor: Float[Tensor, "*batch D D"]
    definite: Bool[Tensor, "*batch"]

    def solve(self, right: Float[Tensor, "*#batch D n"]) -> Float[Tensor, "*#batch D n"]:
        """matrix^-1 right, zero where the matrix is not definite."""
        scale = self.scale[..., None]
        solution = scale * torch.cholesky_solve(scale * right, self.factor)
        return torch.where(self.definite[..., None, None], solution, 0.0)

    def inverse_root(self) -> Float[Tensor, "*batch D D"]:
        """Q with Q^T Q = matrix^-1, zero where the matrix is not definite."""
        root = torch.linalg.solve_triangular(self.factor, torch.diag_embed(self.scale), upper=False)
        return torch.where(self.definite[..., None, None], root, 0.0)


def factorize(matrix: Float[Tensor, "*batch D D"], strict: bool = True) -> DefiniteFactor:
    """Cholesky factorization of symmetric (..., D, D) matrices that never raises.

    Args:
        strict: count a matrix as definite only if it is clearly so, beyond rounding.
    """
    diagonal = matrix.diagonal(dim1=-2, dim2=-1)
    scale = torch.where(diagonal > 0, diagonal, 1.0).rsqrt()
    scaled = scale[..., :, None] * matrix * scale[..., None, :]
    factor, info = torch.linalg.cholesky_ex(scaled)
    definite = info == 0
    if strict:
        pivots = factor.diagonal(dim1=-2, dim2=-1)
        definite = definite & (pivots > smallest_pivot(matrix.dtype)).all(-1)
    if not definite.all():  # unit matrices instead: what follows stays finite, its gradient included
        unit = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
        factor, _ = torch.linalg.cholesky_ex(torch.where(definite[..., None, None], scaled, unit))
    return DefiniteFactor(scale, factor, definite)


def inverse_root_3x3(lower: Iterable[Any], mask: Any = True, smallest: float = 0.0) -> list[Any]:
    """Lower triangular Q with Q^T Q = block^-1 of many symmetric 3x3 blocks, by a written-out Cholesky factorization.

    Args:
        lower: six tensors or NumPy arrays of one shape, the entries `LOWER_3X3` of the blocks.
        mask: bool of that shape, which blocks to invert.
        smallest: a block counts as definite where the pivots of the block scaled to a unit diagonal exceed this.

    Returns:
        The same entries of Q, zero where a block is not definite or not in the mask.
    """
    b00, b10, b11, b20, b21, b22 = lower
    xp: Any = np if isinstance(b00, np.ndarray) else torch

    def inverse_sqrt(pivot: Any, is_definite: Any) -> Any:
        return 1 / xp.sqrt(xp.where(is_definite, pivot, 1.0))

    is_definite = (b00 > 0) & (b11 > 0) & (b22 > 0) & mask
    s0, s1, s2 = (inverse_sqrt(pivot, is_definite) for pivot in (b00, b11, b22))
    l10, l20 = b10 * s1 * s0, b20 * s2 * s0
    pivot = 1 - l10 * l10
    is_definite = is_definite & (pivot > smallest)
    i1 = inverse_sqrt(pivot, is_definite)
    l21 = (b21 * s2 * s1 - l20 * l10) * i1
    pivot = 1 - l20 * l20 - l21 * l21
    is_definite = is_definite & (pivot > smallest)
    i2 = inverse_sqrt(pivot, is_definite)
    q10, q20 = -l10 * s0 * i1, -(l20 - l21 * l10 * i1) * s0 * i2
    root = s0, q10, s1 * i1, q20, -l21 * s1 * i1 * i2, s2 * i2
    return [xp.where(is_definite, entry, 0.0) for entry in root]
