"""Symmetric 2x2 matrices, as informations and covariances of pixels are, written out: faster than general ones, and
fit for `torch.func`."""

from __future__ import annotations

import torch
from torch import Tensor


def triangle(A: Tensor) -> Tensor:
    """(..., 3) xx, xy, yy of matrices (..., 2, 2), of which the symmetric part counts."""
    return torch.stack((A[..., 0, 0], 0.5 * (A[..., 0, 1] + A[..., 1, 0]), A[..., 1, 1]), dim=-1)


def from_triangle(values: Tensor) -> Tensor:
    """(..., 2, 2) symmetric matrices of xx, xy, yy (..., 3)."""
    xx, xy, yy = values.unbind(-1)
    return torch.stack((xx, xy, xy, yy), dim=-1).unflatten(-1, (2, 2))


def is_definite(A: Tensor) -> Tensor:
    """(...) whether matrices (..., 2, 2) are positive definite; false for what is not finite."""
    xx, xy, yy = triangle(A).unbind(-1)
    return (xx > 0) & (xx * yy - xy * xy > 0)


def inverse_2x2(A: Tensor) -> Tensor:
    """(..., 2, 2) inverses of definite matrices."""
    xx, xy, yy = triangle(A).unbind(-1)
    return from_triangle(torch.stack((yy, -xy, xx), dim=-1)) / (xx * yy - xy * xy)[..., None, None]


def whitening(A: Tensor) -> Tensor:
    """W (..., 2, 2), upper triangular, with W^T W = A; zero, with gradient zero, where A is not positive definite."""
    xx, xy, yy = torch.where(is_definite(A)[..., None], triangle(A), A.new_tensor((1.0, 0.0, 1.0))).unbind(-1)
    p = xx.sqrt()
    q = xy / p
    W = torch.stack((p, q, torch.zeros_like(p), (yy - q * q).sqrt()), dim=-1).unflatten(-1, (2, 2))
    return torch.where(is_definite(A)[..., None, None], W, 0.0)


def times(weights: Tensor, factors: Tensor) -> Tensor:
    """Weights (..., N) or (..., N, 2, 2) times factors (..., N)."""
    return weights * factors.view(*factors.shape, *(1,) * (weights.ndim - factors.ndim))
