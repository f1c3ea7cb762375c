"""Fits of the three models of two views, all by truncated least squares over many candidates at once.

A problem holds B pairs of views. Residuals are in units of the threshold: to first order, the distance by which the
match would have to move in both images together.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchslam.geometry.camera import Camera
from torchslam.geometry.essential import decompose_essential, essential_from_pose, five_point
from torchslam.geometry.homography import homography_from_matches, rotation_from_matches, transfer_errors
from torchslam.geometry.least_squares import State, minimize, small_rotation
from torchslam.geometry.lie import skew
from torchslam.geometry.ransac import gather_rows, pad_groups, sample_minimal, truncated_score

_CANDIDATES = 4  # hypotheses of each round that are optimised
_ITERATIONS = 4  # of their local optimisation


@dataclass(frozen=True)
class TwoViews:
    """Matches of B pairs of views.

    x_1, x_2: (B, N, 2) undistorted image coordinates; scale_1, scale_2: (B, N) thresholds per unit of them
    mask:     (B, N)
    """

    x_1: Tensor
    x_2: Tensor
    scale_1: Tensor
    scale_2: Tensor
    mask: Tensor

    @staticmethod
    def of(
        pixels_1: Tensor, pixels_2: Tensor, camera_1: Camera, camera_2: Camera, threshold: float, mask: Tensor
    ) -> TwoViews:
        x_1, x_2 = camera_1.normalize(pixels_1), camera_2.normalize(pixels_2)
        scale_1, scale_2 = camera_1.pixel_scale(x_1) / threshold, camera_2.pixel_scale(x_2) / threshold
        return TwoViews(x_1, x_2, scale_1.expand_as(mask), scale_2.expand_as(mask), mask)

    def select(self, rows: Tensor) -> TwoViews:
        """Some of the problems."""
        if len(rows) == len(self.mask):
            return self
        return TwoViews(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))

    @property
    def h_1(self) -> Tensor:
        """(B, N, 3) homogeneous x_1."""
        return torch.cat((self.x_1, torch.ones_like(self.x_1[..., :1])), dim=-1)

    @property
    def h_2(self) -> Tensor:
        """(B, N, 3) homogeneous x_2."""
        return torch.cat((self.x_2, torch.ones_like(self.x_2[..., :1])), dim=-1)

    @property
    def transfer_weight(self) -> Tensor:
        """(B, N) thresholds per unit of a difference H(x_1) - x_2, which has the noise of both images.

        Two-dimensional errors get a threshold 1.5 times that of one-dimensional ones, which then is as probable.
        """
        return (self.scale_1.square().reciprocal() + self.scale_2.square().reciprocal()).rsqrt() / 1.5


def _truncated(squared: Tensor, mask: Tensor, width: float) -> tuple[Tensor, Tensor]:
    """Which rows count, and the truncated cost, of squared residuals (B, K, N) with a mask (B, N)."""
    squared = squared.nan_to_num(torch.inf)
    cost = torch.where(mask[:, None], squared.clamp_max(width * width), 0.0).sum(-1)
    return (squared < width * width) & mask[:, None], cost


def best_of(state: State, cost: Tensor) -> tuple[State, Tensor]:
    """The candidate of least cost of each problem. (B, K, ...), (B, K) -> (B, ...), (B,)."""
    cost, best = cost.nan_to_num(torch.inf).min(dim=1)
    index = torch.arange(len(best), device=best.device)
    return tuple(x[index, best] for x in state), cost


# --- essential matrix ---


def essential_residuals(views: TwoViews, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Sampson errors (B, K, N) in thresholds of poses (B, K), and their Jacobians (B, K, N, 5).

    Local parameters: rotation from the left, then the two directions of `tangent_basis`.
    """
    E = essential_from_pose(R, t)
    h_1, h_2 = views.h_1[:, None], views.h_2[:, None]
    line_2, line_1 = h_1 @ E.mT, h_2 @ E
    constraint = (h_2 * line_2).sum(-1, keepdim=True)
    # each line's gradient, with the variance of its image in units of the threshold
    m_2 = line_2[..., :2] * views.scale_2.square().reciprocal()[:, None, :, None]
    m_1 = line_1[..., :2] * views.scale_1.square().reciprocal()[:, None, :, None]
    squared = (m_2 * line_2[..., :2]).sum(-1, keepdim=True) + (m_1 * line_1[..., :2]).sum(-1, keepdim=True)
    inverse = squared.clamp_min(torch.finfo(R.dtype).tiny).rsqrt()
    residual = constraint * inverse
    pull = residual * inverse * inverse
    left = h_2 * inverse - torch.nn.functional.pad(pull * m_2, (0, 1))
    right = torch.nn.functional.pad(pull * m_1, (0, 1))
    J_E = left[..., :, None] * h_1[..., None, :] - h_2[..., :, None] * right[..., None, :]
    return residual.squeeze(-1), J_E.flatten(-2) @ _essential_tangent(R, t)


def tangent_basis(t: Tensor) -> Tensor:
    """Two unit vectors perpendicular to t and to each other. (..., 3) -> (..., 2, 3)."""
    smallest = t.abs().argmin(-1, keepdim=True)
    axis = torch.zeros_like(t).scatter(-1, smallest, 1.0)
    a = torch.linalg.cross(t, axis, dim=-1)
    a = a / a.norm(dim=-1, keepdim=True)
    return torch.stack((a, torch.linalg.cross(t, a, dim=-1)), dim=-2)


def _essential_tangent(R: Tensor, t: Tensor) -> Tensor:
    """d E / d local parameters. (..., 3, 3), (..., 3) -> (..., 9, 5)."""
    generators = skew(torch.eye(3, dtype=t.dtype, device=t.device))
    rotation = skew(t)[..., None, :, :] @ generators
    direction = skew(tangent_basis(t))
    return (torch.cat((rotation, direction), dim=-3) @ R[..., None, :, :]).flatten(-2).mT


def _retract_essential(state: State, step: Tensor) -> State:
    R, t = state
    t = t + (step[..., None, 3:] @ tangent_basis(t)).squeeze(-2)
    return small_rotation(step[..., :3]) @ R, t / t.norm(dim=-1, keepdim=True)


def fit_essential(views: TwoViews, state: State, iterations: int, width: float = 1.0) -> tuple[State, Tensor]:
    """Optimises (R, t) of (B, K) candidates; also returns their truncated costs (B, K)."""

    def evaluate(R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        residual, J = essential_residuals(views, R, t)
        used, cost = _truncated(residual * residual, views.mask, width)
        rows = torch.cat((J, residual[..., None]), dim=-1).masked_fill(~used[..., None], 0.0)
        return rows.mT @ rows, cost

    return minimize(state, evaluate, _retract_essential, iterations)


def score_essential(views: TwoViews, E: Tensor) -> Tensor:
    """Truncated scores of many essential matrices, as two matrix products in float32. (B, M, 3, 3) -> (B, M)."""
    h_1, h_2 = views.h_1, views.h_2
    outer_1, outer_2 = (h[..., :, None] * h[..., None, :] for h in (h_1, h_2))
    matches = (h_2[..., :, None] * h_1[..., None, :]).flatten(2)
    squares = torch.cat(
        (
            outer_1.flatten(2) * views.scale_2.square().reciprocal()[..., None],
            outer_2.flatten(2) * views.scale_1.square().reciprocal()[..., None],
        ),
        dim=-1,
    )
    quadratic = torch.cat((E[..., :2, :].mT @ E[..., :2, :], E[..., :2] @ E[..., :2].mT), dim=-2).flatten(-2)
    constraint = E.flatten(-2).float() @ matches.mT.float()
    variance = quadratic.float() @ squares.mT.float()
    return truncated_score(constraint.square_().div_(variance.clamp_min_(1e-20)), views.mask.float())


def propose_essential(views: TwoViews, count: int, generator: torch.Generator) -> tuple[State, Tensor]:
    """The best (R, t) of `count` samples of five matches, locally optimised, and its score."""
    B = len(views.mask)
    sample = sample_minimal(views.mask, 5, count, generator)
    x_1, x_2 = gather_rows(views.x_1, sample), gather_rows(views.x_2, sample)
    E, row = five_point(x_1.flatten(0, 1), x_2.flatten(0, 1))
    E, valid = pad_groups(E.flatten(1), row // count, B, _CANDIDATES)
    score = torch.where(valid, score_essential(views, E.unflatten(-1, (3, 3))), -1.0)
    best = score.topk(_CANDIDATES, dim=1).indices
    R, t = decompose_essential(gather_rows(E, best).unflatten(-1, (3, 3)))
    # Padding has no pose; start it from the identity.
    R = torch.where(
        valid.gather(1, best)[..., None, None], R[:, :, 0], torch.eye(3, dtype=R.dtype, device=R.device)
    )
    t = torch.where(valid.gather(1, best)[..., None], t, t.new_tensor((0.0, 0.0, 1.0)))
    state, cost = best_of(*fit_essential(views, (R, t), _ITERATIONS))
    return state, views.mask.sum(-1) - cost


# --- homography and pure rotation ---


def homography_residuals(views: TwoViews, H: Tensor) -> Tensor:
    """Transfer errors (B, K, N, 2) in thresholds of homographies (B, K, 3, 3), shared between the two images."""
    return (
        transfer_errors(H, views.x_1[:, None], views.x_2[:, None]) * views.transfer_weight[:, None, :, None]
    )


def _fit_mapped(
    views: TwoViews, state: State, tangent: Any, retract: Any, iterations: int, width: float
) -> tuple[State, Tensor]:
    """Optimises mappings H x_1, whose nine entries depend on local parameters by `tangent(state)` (.., 9, D)."""
    weight = (views.scale_1.square().reciprocal() + views.scale_2.square().reciprocal()).rsqrt()[
        :, None, :, None
    ]
    h_1 = views.h_1[:, None]

    def evaluate(H: Tensor) -> tuple[Tensor, Tensor]:
        mapped = h_1 @ H.mT
        depth = mapped[..., 2:]
        front = depth > 1e-9
        inverse = torch.where(front, 1 / depth, 0.0)
        position = mapped[..., :2] * inverse
        residual = torch.where(front, (position - views.x_2[:, None]) * weight, 1e6)
        used, cost = _truncated(residual.square().sum(-1), views.mask, width)
        side = h_1 * (weight * inverse)
        zero = torch.zeros_like(side)
        J_u = torch.cat((side, zero, -side * position[..., :1]), dim=-1)
        J_v = torch.cat((zero, side, -side * position[..., 1:]), dim=-1)
        J = torch.stack((J_u, J_v), dim=-2) @ tangent(H)[..., None, :, :]
        rows = (
            torch.cat((J, residual[..., None]), dim=-1).masked_fill(~used[..., None, None], 0.0).flatten(2, 3)
        )
        return rows.mT @ rows, cost

    return minimize(state, evaluate, retract, iterations)


def fit_homography(views: TwoViews, H: Tensor, iterations: int, width: float = 1.0) -> tuple[Tensor, Tensor]:
    """Optimises homographies (B, K, 3, 3) with H_33 = 1; also returns their truncated costs (B, K)."""
    entries = torch.eye(9, 8, dtype=H.dtype, device=H.device)

    def retract(state: State, step: Tensor) -> State:
        return (state[0] + torch.nn.functional.pad(step, (0, 1)).unflatten(-1, (3, 3)),)

    state, cost = _fit_mapped(views, (H,), lambda H: entries, retract, iterations, width)
    return state[0], cost


def fit_rotation(views: TwoViews, R: Tensor, iterations: int, width: float = 1.0) -> tuple[Tensor, Tensor]:
    """Optimises pure rotations (B, K, 3, 3); also returns their truncated costs (B, K)."""
    generators = skew(torch.eye(3, dtype=R.dtype, device=R.device))

    def tangent(R: Tensor) -> Tensor:
        return (generators @ R[..., None, :, :]).flatten(-2).mT

    def retract(state: State, step: Tensor) -> State:
        return (small_rotation(step) @ state[0],)

    state, cost = _fit_mapped(views, (R,), tangent, retract, iterations, width)
    return state[0], cost


def score_mappings(views: TwoViews, H: Tensor) -> Tensor:
    """Truncated scores of homographies or rotations. (B, M, 3, 3) -> (B, M)."""
    squared = homography_residuals(views, H).square().sum(-1)
    return truncated_score(squared.float(), views.mask.float())


def propose_homography(views: TwoViews, count: int, generator: torch.Generator) -> tuple[State, Tensor]:
    """The best homography of `count` samples of four matches, locally optimised, and its score."""
    sample = sample_minimal(views.mask, 4, count, generator)
    H = homography_from_matches(gather_rows(views.x_1, sample), gather_rows(views.x_2, sample))
    best = score_mappings(views, H).topk(_CANDIDATES, dim=1).indices
    H = gather_rows(H.flatten(2), best).unflatten(-1, (3, 3))
    H, cost = fit_homography(views, H, _ITERATIONS)
    state, cost = best_of((H,), cost)
    return state, views.mask.sum(-1) - cost


def propose_rotation(views: TwoViews, count: int, generator: torch.Generator) -> tuple[State, Tensor]:
    """The best pure rotation of `count` samples of two matches, locally optimised, and its score."""
    sample = sample_minimal(views.mask, 2, count, generator)
    R = rotation_from_matches(gather_rows(views.h_1, sample), gather_rows(views.h_2, sample))
    R = torch.where(
        torch.isfinite(R).all((-2, -1))[..., None, None], R, torch.eye(3, dtype=R.dtype, device=R.device)
    )
    best = score_mappings(views, R).topk(_CANDIDATES, dim=1).indices
    R = gather_rows(R.flatten(2), best).unflatten(-1, (3, 3))
    R, cost = fit_rotation(views, R, _ITERATIONS)
    state, cost = best_of((R,), cost)
    return state, views.mask.sum(-1) - cost
