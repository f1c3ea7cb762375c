"""Scores and fits of what maps homogeneous points to image coordinates: poses, homographies, pure rotations.

All map homogeneous (B, D, N) points by P (3, D) to x (B, N, 2): D = 4 for scene points, D = 3 for image points.
Errors are in thresholds, of which `scale` (B, N) go into one unit of x; rows outside `mask` (B, N) do not count.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchslam.geometry.least_squares import State, minimize
from torchslam.geometry.ransac import truncated_rows, truncated_score


def score_projections(P: Tensor, homogeneous: Tensor, x: Tensor, scale: Tensor, mask: Tensor) -> Tensor:
    """Truncated scores of many mappings, in the dtype of P. (B, M, 3, D) -> (B, M).

    A negative depth counts as an outlier.
    """
    M = P.shape[1]
    u, v, w = (P.transpose(1, 2).flatten(1, 2) @ homogeneous).unflatten(1, (3, M)).unbind(1)
    du = torch.addcmul(u, x[:, None, :, 0], w, value=-1)
    dv = torch.addcmul(v, x[:, None, :, 1], w, value=-1)
    # Behind the camera the denominator vanishes and the error becomes huge.
    factor = (scale[:, None].to(w.dtype) / w.clamp_min_(1e-6)).square_()
    return truncated_score(du.square_().addcmul_(dv, dv).mul_(factor), mask)


def fit_projections(
    P: Tensor,
    homogeneous: Tensor,
    x: Tensor,
    scale: Tensor,
    mask: Tensor,
    tangent: Callable[[Tensor], Tensor],
    retract: Callable[[Tensor, Tensor], Tensor],
    iterations: int,
    width: float = 1.0,
) -> tuple[Tensor, Tensor]:
    """Mappings (B, K, 3, D) of least truncated squared error near the given ones, and their costs (B, K).

    tangent: P -> (B, K, T, 3, D), derivatives by the T local parameters; retract: P, step (B, K, T) -> P; width: in
    thresholds, where the error is truncated.
    """
    scale, x_u, x_v = scale[:, None, None], x[:, None, None, :, 0], x[:, None, None, :, 1]
    K = P.shape[1]

    def evaluate(P: Tensor) -> tuple[Tensor, Tensor]:
        rows = torch.cat((P[:, :, None], tangent(P)), dim=2)  # the mapping, then its derivatives
        u, v, w = (rows.transpose(2, 3).flatten(1, 3) @ homogeneous).unflatten(1, (K, 3, -1)).unbind(2)
        inverse = w[:, :, :1].clamp_min(1e-9).reciprocal()
        image_u, image_v = u[:, :, :1] * inverse, v[:, :, :1] * inverse
        # d(u / w) = (du - (u / w) dw) / w; the row of the mapping itself becomes the residual
        inverse = inverse * scale
        J_u = torch.addcmul(u, image_u, w, value=-1)[:, :, 1:] * inverse
        J_v = torch.addcmul(v, image_v, w, value=-1)[:, :, 1:] * inverse
        r_u, r_v = (image_u - x_u) * scale, (image_v - x_v) * scale
        used, cost = truncated_rows((r_u * r_u + r_v * r_v).squeeze(2), mask, width)
        rows = torch.cat((torch.cat((J_u, r_u), dim=2), torch.cat((J_v, r_v), dim=2)), dim=-1)
        rows = rows * used.repeat(1, 1, 2)[:, :, None]
        return rows @ rows.mT, cost

    def move(state: State, step: Tensor) -> State:
        return (retract(state[0], step),)

    (P,), cost = minimize((P,), evaluate, move, iterations)
    return P, cost
