"""The groups that the nodes of a pose graph may be from: what its edges need to know of them.

A perturbation xi moves a node S to exp(xi) S. Rotations are the similarities without translation and scale: were they
optimized as such, every step would cost (6 / 3)^3 times as much for the same result.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchslam.geometry.lie import (
    sim3_adjoint,
    sim3_inverse,
    sim3_left_jacobian_inverse,
    sim3_log,
    skew,
    so3_exp,
    so3_left_jacobian_inverse,
    so3_log,
)
from torchslam.optim._core.tangent import pull_back_sim3, push_sim3, retract_sim3


@dataclass(frozen=True)
class Similarities:
    """Sim(3), or with six dimensions its elements of fixed scale; matrices (..., n, n), tangent vectors (..., D)."""

    dims: int

    def inverse(self, S: Tensor) -> Tensor:
        return sim3_inverse(S)

    def log(self, S: Tensor) -> Tensor:
        """D numbers that are an edge's error, and then those that stay as they are."""
        return sim3_log(S)

    def left_jacobian_inverse(self, log: Tensor) -> Tensor:
        """(..., D, D) the derivative of log(exp(xi) S) in xi at zero."""
        return sim3_left_jacobian_inverse(log)[..., : self.dims, : self.dims]

    def adjoint(self, S: Tensor) -> Tensor:
        """(..., D, D) Ad with S exp(xi) = exp(Ad xi) S."""
        return sim3_adjoint(S)[..., : self.dims, : self.dims]

    def bracket(self, force: Tensor) -> Tensor:
        """(..., D, D) half of force . [a, b] as a bilinear form a^T M b of tangent vectors."""
        v, omega = skew(force[..., :3]), skew(force[..., 3:6])
        M = torch.cat((torch.cat((torch.zeros_like(v), -v), -1), torch.cat((-v, -omega), -1)), dim=-2)
        if self.dims == 7:
            M = torch.nn.functional.pad(M, (0, 1, 0, 1))
            M[..., 6, :3], M[..., :3, 6] = force[..., :3], -force[..., :3]
        return 0.5 * M

    def retract(self, S: Tensor, xi: Tensor) -> Tensor:
        """exp(xi) S."""
        return retract_sim3(S, xi)

    def push(self, S: Tensor, xi: Tensor) -> Tensor:
        """The change of S, to first order, when it moves along xi."""
        return push_sim3(S, xi)

    def pull_back(self, S: Tensor, grad_S: Tensor) -> Tensor:
        """The gradient in xi, at zero, of a loss with gradient `grad_S` at exp(xi) S."""
        return pull_back_sim3(S, grad_S)[..., : self.dims]


@dataclass(frozen=True)
class Rotations:
    """SO(3), with the operations of `Similarities`."""

    dims: int = 3

    def inverse(self, S: Tensor) -> Tensor:
        return S.mT

    def log(self, S: Tensor) -> Tensor:
        return so3_log(S)

    def left_jacobian_inverse(self, log: Tensor) -> Tensor:
        return so3_left_jacobian_inverse(log)

    def adjoint(self, S: Tensor) -> Tensor:
        return S

    def bracket(self, force: Tensor) -> Tensor:
        return -0.5 * skew(force)

    def retract(self, S: Tensor, xi: Tensor) -> Tensor:
        return so3_exp(xi) @ S

    def push(self, S: Tensor, xi: Tensor) -> Tensor:
        return skew(xi) @ S

    def pull_back(self, S: Tensor, grad_S: Tensor) -> Tensor:
        return torch.linalg.cross(S, grad_S, dim=-2).sum(-1)


Group = Similarities | Rotations


def group_of(dims: int) -> Group:
    """The group whose tangent vectors have this number of dimensions: 3, 6 or 7."""
    return Rotations() if dims == 3 else Similarities(dims)
