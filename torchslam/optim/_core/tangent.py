"""Left perturbations of SE(3) and Sim(3), and Gaussian priors in them.

A perturbation is xi = (v, omega), translation first, with the log scale last for a similarity. A prior costs half of
e^T information e, with e = (t, log R) of T_cw @ T_prior^-1 for a pose.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.func import jvp, vmap

from torchslam.geometry.lie import se3_inverse, sim3_exp, skew, so3_left_jacobian, so3_log
from torchslam.utils.by_value import ByValue


def retract(T: Float[Tensor, "*#batch 4 4"], xi: Float[Tensor, "*#batch 6"]) -> Float[Tensor, "*batch 4 4"]:
    """T moved along xi: [C(omega), v; 0, 1] @ T with Cayley's map C.

    C is that of `geometry.lie.cayley_rotation`, applied without forming the matrix. It agrees with the exponential to
    second order, is a rotation to rounding for any omega, and is rational: no trigonometry, no special case at zero.
    """
    half, columns = 0.5 * xi[..., 3:, None], T[..., :3, :]
    twice = 2 / (1 + half.square().sum((-2, -1), keepdim=True))
    once = torch.linalg.cross(half.expand_as(columns), columns, dim=-2)
    rotated = columns + twice * (once + torch.linalg.cross(half.expand_as(columns), once, dim=-2))
    moved = torch.cat((rotated[..., :3], rotated[..., 3:] + xi[..., :3, None]), dim=-1)
    return torch.cat((moved, T[..., 3:, :]), dim=-2)


def pull_back(
    T: Float[Tensor, "*#batch 4 4"], grad_T: Float[Tensor, "*#batch 4 4"]
) -> Float[Tensor, "*batch 6"]:
    """The gradient with respect to xi, at zero, of a loss with gradient `grad_T` at T moved along xi.

    The last row of `grad_T` has no effect.
    """
    columns, grads = T[..., :3, :], grad_T[..., :3, :]
    rotation = torch.linalg.cross(columns, grads, dim=-2).sum(-1)
    return torch.cat((grads[..., 3], rotation), dim=-1)


def push(T: Float[Tensor, "*#batch 4 4"], xi: Float[Tensor, "*#batch D"]) -> Float[Tensor, "*batch 4 4"]:
    """The change of T, to first order, when it moves along xi, with D = 6 or for a similarity 7."""
    columns = T[..., :3, :]
    rotated = torch.linalg.cross(xi[..., 3:6, None].expand_as(columns), columns, dim=-2)
    if xi.shape[-1] == 7:
        rotated = rotated + xi[..., 6:, None] * columns
    changed = torch.cat((rotated[..., :3], rotated[..., 3:] + xi[..., :3, None]), dim=-1)
    return torch.nn.functional.pad(changed, (0, 0, 0, 1))


def rotated(
    R: Float[Tensor, "*#batch 3 3"], values: Float[Tensor, "*#batch 6 n"]
) -> Float[Tensor, "*batch 6 n"]:
    """Both halves of tangent vectors (..., 6, n) turned by R (..., 3, 3)."""
    return (R[..., None, :, :] @ values.unflatten(-2, (2, 3))).flatten(-3, -2)


def cross_entries(u: Tensor | Sequence[Tensor], columns: Tensor | Sequence[Tensor]) -> list[Tensor]:
    """The three entries of u x columns, of the three of either, each of any shape that broadcasts."""
    pairs = ((1, 2), (2, 0), (0, 1))
    return [(u[i] * columns[j]).addcmul(u[j], columns[i], value=-1) for i, j in pairs]


def move(points_c: Float[Tensor, "*#batch 3"], xi: Float[Tensor, "*#batch 6"]) -> Float[Tensor, "*batch 3"]:
    """The velocity of points in the camera frame when the pose moves along xi: v + omega x p."""
    return xi[..., :3] + torch.linalg.cross(xi[..., 3:].expand_as(points_c), points_c)


def point_jacobian(points_c: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 6"]:
    """d p / d xi at zero: [I, -p^]."""
    eye = torch.eye(3, dtype=points_c.dtype, device=points_c.device)
    return torch.cat((eye.expand(*points_c.shape, 3), -skew(points_c)), dim=-1)


def retract_sim3(
    S: Float[Tensor, "*#batch 4 4"], xi: Float[Tensor, "*#batch D"]
) -> Float[Tensor, "*batch 4 4"]:
    """exp(xi) @ S, the scale kept where xi has no seventh number."""
    return sim3_exp(torch.nn.functional.pad(xi, (0, 7 - xi.shape[-1]))) @ S


def pull_back_sim3(
    S: Float[Tensor, "*#batch 4 4"], grad_S: Float[Tensor, "*#batch 4 4"]
) -> Float[Tensor, "*batch 7"]:
    """As `pull_back`, for similarities."""
    scale = (S[..., :3, :] * grad_S[..., :3, :]).sum((-2, -1))
    return torch.cat((pull_back(S, grad_S), scale[..., None]), dim=-1)


@dataclass(frozen=True, eq=False)
class PosePrior(ByValue):
    """Gaussian prior on poses.

    Attributes:
        T_cw: mean, world to camera.
        information: inverse covariance of the left perturbation (translation, rotation), symmetric.
    """

    T_cw: Float[Tensor, "*#batch 4 4"]
    information: Float[Tensor, "*#batch 6 6"]


@dataclass(frozen=True, eq=False)
class CameraPrior(ByValue):
    """Gaussian prior on the parameters of one or several cameras.

    Attributes:
        params: mean, as `Camera.params`.
        information: inverse covariance, symmetric.
    """

    params: Float[Tensor, "*#batch P"]
    information: Float[Tensor, "*#batch P P"]


def prior_error(
    prior: PosePrior, T_cw: Float[Tensor, "*batch 4 4"]
) -> tuple[Float[Tensor, "*batch 6"], Float[Tensor, "*batch 6 6"]]:
    """e = (t, log R) of T_cw @ T_prior^-1, and d e / d xi."""
    E = T_cw @ se3_inverse(prior.T_cw)
    translation, rotation = E[..., :3, 3], so3_log(E[..., :3, :3])
    J_rotation = torch.linalg.inv(so3_left_jacobian(rotation))
    top = torch.cat(
        (torch.eye(3, dtype=E.dtype, device=E.device).expand_as(J_rotation), -skew(translation)), dim=-1
    )
    bottom = torch.cat((torch.zeros_like(J_rotation), J_rotation), dim=-1)
    return torch.cat((translation, rotation), dim=-1), torch.cat((top, bottom), dim=-2)


def prior_expansion(
    prior: PosePrior, T_cw: Float[Tensor, "*batch 4 4"]
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 6"], Float[Tensor, "*batch 6 6"]]:
    """Cost (...), gradient (..., 6) and Gauss-Newton Hessian (..., 6, 6) at poses (..., 4, 4)."""
    error, J = prior_error(prior, T_cw)
    pulled = J.mT @ prior.information
    gradient = (pulled @ error[..., None]).squeeze(-1)
    return 0.5 * torch.einsum("...i,...ij,...j->...", error, prior.information, error), gradient, pulled @ J


def prior_hessian(prior: PosePrior, T_cw: Float[Tensor, "B 4 4"]) -> Float[Tensor, "B 6 6"]:
    """The exact Hessian of the prior's cost in xi."""
    T_cw, target, information = T_cw.detach(), prior.T_cw.detach(), prior.information.detach()
    with torch.enable_grad():
        # One copy of every pose per row of the Hessian.
        xi = T_cw.new_zeros(6 * T_cw.shape[0], 6).requires_grad_()
        moved = retract(T_cw.repeat(6, 1, 1), xi)
        cost, _, _ = prior_expansion(PosePrior(target.repeat(6, 1, 1), information.repeat(6, 1, 1)), moved)
        (gradient,) = torch.autograd.grad(cost.sum(), xi, create_graph=True)
        (rows,) = torch.autograd.grad(gradient.unflatten(0, (6, -1)).movedim(-1, 0).diagonal().sum(), xi)
    return rows.unflatten(0, (6, -1)).movedim(0, -2)


def row_jacobian(
    function: Callable[[Tensor], Tensor], zero: Float[Tensor, "B n"]
) -> Float[Tensor, "B *value n"]:
    """Derivatives at zero of each row of a function in its own n numbers."""
    size = zero.shape[1]
    basis = torch.eye(size, dtype=zero.dtype, device=zero.device)[:, None].expand(size, *zero.shape)
    return vmap(lambda step: jvp(function, (zero,), (step,))[1], out_dims=-1)(basis)
