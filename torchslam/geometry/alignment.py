"""Alignment of corresponding points by a similarity or a rigid transform."""

from __future__ import annotations

import torch
from torch import Tensor

from torchslam.geometry.estimate_gradients import first_order, needs_gradient
from torchslam.geometry.lie import so3_exp, vee
from torchslam.geometry.precision import full_precision


@full_precision
def umeyama(
    source: Tensor,
    target: Tensor,
    weights: Tensor | None = None,
    with_scale: bool = True,
) -> tuple[Tensor, Tensor, Tensor]:
    """The similarity that minimises sum_i w_i |target_i - (s R source_i + t)|^2.

    source, target: (..., N, 3); weights: (..., N) non-negative weights or a boolean mask; rows of weight zero
    may hold anything. Returns scale (...), R (..., 3, 3), t (..., 3).

    Differentiable (once; a second time raises RuntimeError) in points and weights, on exact data and at repeated
    singular values too: the rotation's gradient comes from the optimality condition, not from the singular vectors.
    With fewer than three points, or collinear ones, the result is finite and one of many minimisers, and its gradient
    leaves out the free direction.
    Source: Umeyama, "Least-squares estimation of transformation parameters between two point patterns", 1991.
    """
    w = torch.ones_like(source[..., 0]) if weights is None else weights.to(source.dtype)
    used = (w > 0)[..., None]
    source, target = torch.where(used, source, 0.0), torch.where(used, target, 0.0)
    w = (w / w.sum(-1, keepdim=True).clamp_min(torch.finfo(w.dtype).tiny))[..., None]
    mean_source, mean_target = (w * source).sum(-2), (w * target).sum(-2)
    x, y = source - mean_source[..., None, :], target - mean_target[..., None, :]
    covariance = (w * y).mT @ x
    R = _nearest_rotation(covariance)
    if with_scale:
        variance = (w * x * x).sum((-2, -1))
        spread = variance > torch.finfo(w.dtype).tiny
        scale = (R * covariance).sum((-2, -1)) / torch.where(spread, variance, 1.0)
        scale = torch.where(spread, scale, 1.0)
    else:
        scale = torch.ones_like(mean_source[..., 0])
    t = mean_target - scale[..., None] * (R @ mean_source[..., None]).squeeze(-1)
    return scale, R, t


def _nearest_rotation(M: Tensor) -> Tensor:
    """The rotation that maximises tr(R^T M), with a finite first-order gradient. (..., 3, 3) -> (..., 3, 3).

    At the maximum S = M R^T is symmetric; for a change of M the rotation moves by exp(omega) with
    (tr(S) I - S) omega = vee(2 antisymmetric part of dM R^T).
    """
    fixed = M.detach()
    U, singular, Vh = torch.linalg.svd(fixed)
    sign = torch.ones_like(singular)
    sign[..., 2] = torch.where(torch.linalg.det(U @ Vh) < 0, -1.0, 1.0)
    R = (U * sign[..., None, :]) @ Vh
    if not needs_gradient(M):
        return R
    # In the basis U, S is diag(singular * sign) and the system is diagonal.
    s = singular * sign
    stiffness = torch.stack((s[..., 1] + s[..., 2], s[..., 0] + s[..., 2], s[..., 0] + s[..., 1]), dim=-1)
    free = stiffness <= 1e-12 * singular[..., :1] + torch.finfo(M.dtype).tiny
    residual = 2 * vee(M @ R.mT)
    in_basis = (U.mT @ residual[..., None]).squeeze(-1)
    omega = torch.where(free, 0.0, in_basis / torch.where(free, 1.0, stiffness))
    omega = (U @ omega[..., None]).squeeze(-1)
    return so3_exp(first_order(omega - omega.detach())) @ R
