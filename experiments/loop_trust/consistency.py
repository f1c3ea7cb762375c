"""How well loops agree with the odometry, and with one another, to first order.

A loop L from node i to node j, seen from where odometry has the nodes, says that the world has drifted between them by
E = S_j^-1 L S_i. Its logarithm is the sum of the errors of the steps between, brought to the world, plus its own, so
what two loops have in common cancels in E_a E_b^-1, which is the cycle of pairwise consistency, seen from the world.
Source of the latter: Mangelson, Dominic, Eustice and Vasudevan, "Pairwise consistent measurement set maximization for
robust multi-robot map merging", 2018.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchslam.geometry import sim3_adjoint, sim3_inverse, sim3_log

_DIMS = 7
_RELATIVE_FLOOR = 1e-12  # of a covariance's diagonal: what differences of sums leave of rounding


@dataclass(frozen=True)
class Consistency:
    """Of loops (N) in graphs (G).

    own:      (G, N) squared Mahalanobis distance of a loop from the odometry; in_parts: (G, N, 3) of its translation,
              rotation and log scale alone, at the later node
    pairwise: (G, N, N) of two loops from each other
    surprise: (G, N, N) half the log determinant by which knowing one loop narrows the other: what agreement is worth
    way:      (G, N, N) half the log determinant that odometry adds to the noise of the two: what agreement rests on
    """

    own: Tensor
    in_parts: Tensor
    pairwise: Tensor
    surprise: Tensor
    way: Tensor


def consistency(
    S_cw: Tensor, odometry_sigmas: Tensor, pairs: Tensor, loops: Tensor, loop_sigmas: Tensor
) -> Consistency:
    """S_cw: (G, K, 4, 4) by odometry; odometry_sigmas: (G, K - 1, 7); pairs: (G, N, 2), i < j; loops: (G, N, 4, 4) from
    i to j; loop_sigmas: (G, N, 7).
    """
    rows = torch.arange(len(S_cw))[:, None]
    i, j = pairs.unbind(-1)
    to_world = sim3_adjoint(sim3_inverse(S_cw))
    steps = to_world[:, 1:] * odometry_sigmas[..., None, :]
    until = torch.nn.functional.pad((steps @ steps.mT).cumsum(1), (0, 0, 0, 0, 1, 0))
    own_noise = to_world[rows, j] * loop_sigmas[..., None, :]
    alone = own_noise @ own_noise.mT
    covariance = until[rows, j] - until[rows, i] + alone

    E = sim3_inverse(S_cw[rows, j]) @ loops @ S_cw[rows, i]
    at_j = sim3_adjoint(S_cw[rows, j])
    error = (at_j @ sim3_log(E)[..., None]).squeeze(-1)
    at_node = at_j @ covariance @ at_j.mT
    parts = [_mahalanobis(error[..., part], at_node[..., part, part]) for part in _PARTS]

    first, last = torch.maximum(i[:, :, None], i[:, None]), torch.minimum(j[:, :, None], j[:, None])
    common = until[rows[..., None], torch.maximum(first, last)] - until[rows[..., None], first]
    together = covariance[:, :, None] + covariance[:, None]
    apart = sim3_log(E[:, :, None] @ sim3_inverse(E)[:, None])
    difference = together - 2 * common
    spread = _log_determinant(difference)
    return Consistency(
        _mahalanobis(error, at_node),
        torch.stack(parts, -1),
        _mahalanobis(apart, difference),
        0.5 * (_log_determinant(together) - spread),
        0.5 * (spread - _log_determinant(alone[:, :, None] + alone[:, None])),
    )


_PARTS = (slice(0, 3), slice(3, 6), slice(6, 7))


def _factor(covariance: Tensor) -> tuple[Tensor, Tensor]:
    """Scales (..., D) and the Cholesky factor of the covariance with these taken out."""
    scale = covariance.diagonal(dim1=-2, dim2=-1).clamp_min(torch.finfo(covariance.dtype).tiny).rsqrt()
    unit = scale[..., :, None] * covariance * scale[..., None, :]
    floor = _RELATIVE_FLOOR * torch.eye(covariance.shape[-1], dtype=covariance.dtype)
    return scale, torch.linalg.cholesky_ex(unit + floor)[0]


def _mahalanobis(error: Tensor, covariance: Tensor) -> Tensor:
    """(...) error^T covariance^-1 error."""
    scale, lower = _factor(covariance)
    white = torch.linalg.solve_triangular(lower, (scale * error)[..., None], upper=False)
    return white.square().sum((-2, -1))


def _log_determinant(covariance: Tensor) -> Tensor:
    scale, lower = _factor(covariance)
    return 2 * (lower.diagonal(dim1=-2, dim2=-1).log() - scale.log()).sum(-1)
