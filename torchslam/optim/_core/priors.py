"""Gaussian priors: half of e^T information e; e = (t, log R) of T_cw @ T_prior^-1 for poses."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchslam.geometry.lie import se3_inverse, skew, so3_left_jacobian, so3_log
from torchslam.optim._core.tangent import retract


@dataclass(frozen=True)
class PosePrior:
    """Gaussian prior on poses.

    Attributes:
        T_cw: (B, 4, 4) mean, world to camera.
        information: (B, 6, 6) inverse covariance of the left perturbation (translation, rotation), symmetric.
    """

    T_cw: Tensor
    information: Tensor


@dataclass(frozen=True)
class CameraPrior:
    """Gaussian prior on the parameters of one or several cameras.

    Attributes:
        params: (K,) or (C, K) mean, as `Camera.params`.
        information: (K, K) or (C, K, K) inverse covariance, symmetric.
    """

    params: Tensor
    information: Tensor


def prior_error(prior: PosePrior, T_cw: Tensor) -> tuple[Tensor, Tensor]:
    """e = (t, log R) of T_cw @ T_prior^-1, and d e / d xi. (..., 4, 4) -> (..., 6), (..., 6, 6)."""
    E = T_cw @ se3_inverse(prior.T_cw)
    translation, rotation = E[..., :3, 3], so3_log(E[..., :3, :3])
    J_rotation = torch.linalg.inv(so3_left_jacobian(rotation))
    top = torch.cat(
        (torch.eye(3, dtype=E.dtype, device=E.device).expand_as(J_rotation), -skew(translation)), dim=-1
    )
    bottom = torch.cat((torch.zeros_like(J_rotation), J_rotation), dim=-1)
    return torch.cat((translation, rotation), dim=-1), torch.cat((top, bottom), dim=-2)


def prior_expansion(prior: PosePrior, T_cw: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Cost (...), gradient (..., 6) and Gauss-Newton Hessian (..., 6, 6) at poses (..., 4, 4)."""
    error, J = prior_error(prior, T_cw)
    pulled = J.mT @ prior.information
    gradient = (pulled @ error[..., None]).squeeze(-1)
    return 0.5 * torch.einsum("...i,...ij,...j->...", error, prior.information, error), gradient, pulled @ J


def prior_hessian(prior: PosePrior, T_cw: Tensor) -> Tensor:
    """The exact Hessian of the prior's cost in xi. (B, 4, 4) -> (B, 6, 6)."""
    T_cw, target, information = T_cw.detach(), prior.T_cw.detach(), prior.information.detach()
    with torch.enable_grad():
        # One copy of every pose per row of the Hessian.
        xi = T_cw.new_zeros(6 * T_cw.shape[0], 6).requires_grad_()
        moved = retract(T_cw.repeat(6, 1, 1), xi)
        cost, _, _ = prior_expansion(PosePrior(target.repeat(6, 1, 1), information.repeat(6, 1, 1)), moved)
        (gradient,) = torch.autograd.grad(cost.sum(), xi, create_graph=True)
        (rows,) = torch.autograd.grad(gradient.unflatten(0, (6, -1)).movedim(-1, 0).diagonal().sum(), xi)
    return rows.unflatten(0, (6, -1)).movedim(0, -2)
