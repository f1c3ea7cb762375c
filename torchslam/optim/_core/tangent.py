"""Left perturbations of SE(3), xi = (v, omega), translation first, and of Sim(3), with the log scale last."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchslam.geometry.lie import sim3_exp, skew


def retract(T: Tensor, xi: Tensor) -> Tensor:
    """T moved along xi: [C(omega), v; 0, 1] @ T with Cayley's map C. (..., 4, 4), (..., 6) -> (..., 4, 4).

    C agrees with the exponential to second order, is a rotation to rounding for any omega, and is rational: no
    trigonometry, no special case at zero, a fraction of the operations.
    """
    half, columns = 0.5 * xi[..., 3:, None], T[..., :3, :]
    twice = 2 / (1 + half.square().sum((-2, -1), keepdim=True))
    once = torch.linalg.cross(half.expand_as(columns), columns, dim=-2)
    rotated = columns + twice * (once + torch.linalg.cross(half.expand_as(columns), once, dim=-2))
    moved = torch.cat((rotated[..., :3], rotated[..., 3:] + xi[..., :3, None]), dim=-1)
    return torch.cat((moved, T[..., 3:, :]), dim=-2)


def pull_back(T: Tensor, grad_T: Tensor) -> Tensor:
    """The gradient with respect to xi, at zero, of a loss with gradient `grad_T` at T moved along xi.

    (..., 4, 4) twice -> (..., 6). The last row of `grad_T` has no effect.
    """
    columns, grads = T[..., :3, :], grad_T[..., :3, :]
    rotation = torch.linalg.cross(columns, grads, dim=-2).sum(-1)
    return torch.cat((grads[..., 3], rotation), dim=-1)


def push(T: Tensor, xi: Tensor) -> Tensor:
    """The change of T, to first order, when it moves along xi. (..., 4, 4), (..., 6) -> (..., 4, 4)."""
    columns = T[..., :3, :]
    rotated = torch.linalg.cross(xi[..., 3:, None].expand_as(columns), columns, dim=-2)
    changed = torch.cat((rotated[..., :3], rotated[..., 3:] + xi[..., :3, None]), dim=-1)
    return torch.nn.functional.pad(changed, (0, 0, 0, 1))


def rotated(R: Tensor, values: Tensor) -> Tensor:
    """Both halves of tangent vectors (..., 6, n) turned by R (..., 3, 3)."""
    return (R[..., None, :, :] @ values.unflatten(-2, (2, 3))).flatten(-3, -2)


def cross_entries(u: Tensor | Sequence[Tensor], columns: Tensor | Sequence[Tensor]) -> list[Tensor]:
    """The three entries of u x columns, of the three of either, each of any shape that broadcasts."""
    pairs = ((1, 2), (2, 0), (0, 1))
    return [(u[i] * columns[j]).addcmul(u[j], columns[i], value=-1) for i, j in pairs]


def move(points_c: Tensor, xi: Tensor) -> Tensor:
    """The velocity of points in the camera frame when the pose moves along xi: v + omega x p.

    (..., 3), (..., 6) -> (..., 3).
    """
    return xi[..., :3] + torch.linalg.cross(xi[..., 3:].expand_as(points_c), points_c)


def point_jacobian(points_c: Tensor) -> Tensor:
    """d p / d xi at zero: [I, -p^]. (..., 3) -> (..., 3, 6)."""
    eye = torch.eye(3, dtype=points_c.dtype, device=points_c.device)
    return torch.cat((eye.expand(*points_c.shape, 3), -skew(points_c)), dim=-1)


def retract_sim3(S: Tensor, xi: Tensor) -> Tensor:
    """exp(xi) @ S, the scale kept where xi has no seventh number. (..., 4, 4), (..., 6 or 7) -> (..., 4, 4)."""
    return sim3_exp(torch.nn.functional.pad(xi, (0, 7 - xi.shape[-1]))) @ S


def pull_back_sim3(S: Tensor, grad_S: Tensor) -> Tensor:
    """The gradient with respect to xi (..., 7), at zero, of a loss with gradient `grad_S` at exp(xi) @ S."""
    columns, grads = S[..., :3, :], grad_S[..., :3, :]
    rotation = torch.linalg.cross(columns, grads, dim=-2).sum(-1)
    return torch.cat((grads[..., 3], rotation, (columns * grads).sum((-2, -1))[..., None]), dim=-1)


def push_sim3(S: Tensor, xi: Tensor) -> Tensor:
    """The change of S, to first order, when it moves along xi. (..., 4, 4), (..., 6 or 7) -> (..., 4, 4)."""
    columns = S[..., :3, :]
    rotated = torch.linalg.cross(xi[..., 3:6, None].expand_as(columns), columns, dim=-2)
    if xi.shape[-1] == 7:
        rotated = rotated + xi[..., 6:, None] * columns
    changed = torch.cat((rotated[..., :3], rotated[..., 3:] + xi[..., :3, None]), dim=-1)
    return torch.nn.functional.pad(changed, (0, 0, 0, 1))
