"""Homographies and pure rotations of two views: samples, scores and truncated least squares over many candidates."""

from __future__ import annotations

import torch
from torch import Tensor

from torchslam.geometry.homography import homography_from_matches, rotation_from_matches, transfer_errors
from torchslam.geometry.local_optimization import State, in_parts
from torchslam.geometry.projections import (
    fit_projections,
    homography_tangent,
    rotation_tangent,
    score_projections,
)
from torchslam.geometry.ransac import gather_rows, sample_minimal
from torchslam.geometry.two_view import TwoViews

_CANDIDATES = 2  # of all samples, that are worth a fit


def transfer_squared(views: TwoViews, H: Tensor) -> Tensor:
    """Squared transfer errors in thresholds of homographies or rotations. (B, K, 3, 3) -> (B, K, N)."""
    difference = transfer_errors(H, views.x_1[:, None], views.x_2[:, None])
    return difference.square().sum(-1) * views.transfer_scale[:, None].square()


def fit_homography(views: TwoViews, H: Tensor, iterations: int, width: float = 1.0) -> tuple[State, Tensor]:
    """Optimises homographies (B, K, 3, 3) with H_33 = 1; also returns their truncated costs (B, K)."""
    tangent = homography_tangent(H.dtype, H.device)
    H, cost = fit_projections(H, tangent, *_transfer(views), iterations, width)
    return (H,), cost


def fit_rotation(views: TwoViews, R: Tensor, iterations: int, width: float = 1.0) -> tuple[State, Tensor]:
    """Optimises pure rotations (B, K, 3, 3); also returns their truncated costs (B, K)."""
    tangent = rotation_tangent(R.dtype, R.device)
    R, cost = fit_projections(R, tangent, *_transfer(views), iterations, width)
    return (R,), cost


def _transfer(views: TwoViews) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The matches as a problem for `fit_projections`."""
    return views.h_1.mT, views.x_2, views.transfer_scale[..., None], views.mask


def score_mappings(views: TwoViews, H: Tensor) -> Tensor:
    """Truncated scores of homographies or rotations, in float32. (B, M, 3, 3) -> (B, M)."""
    h_1, x_2, scale, mask = _transfer(views)

    def score(*part: Tensor) -> tuple[Tensor]:
        return (score_projections(*part),)

    (scores,) = in_parts(
        score, 3 * H.shape[1] * mask.shape[1], H.float(), h_1.float(), x_2.float(), scale, mask
    )
    return scores


def propose_homography(views: TwoViews, count: int, generator: torch.Generator) -> Tensor:
    """The best homographies (B, K, 3, 3) of `count` samples of four matches."""
    sample = sample_minimal(views.mask, 4, count, generator)
    H = homography_from_matches(gather_rows(views.x_1, sample), gather_rows(views.x_2, sample))
    best = score_mappings(views, H).topk(_CANDIDATES, dim=1).indices
    return gather_rows(H.flatten(2), best).unflatten(-1, (3, 3))


def propose_rotation(views: TwoViews, count: int, generator: torch.Generator) -> Tensor:
    """The best pure rotations (B, K, 3, 3) of `count` samples of two matches."""
    sample = sample_minimal(views.mask, 2, count, generator)
    R = rotation_from_matches(gather_rows(views.h_1, sample), gather_rows(views.h_2, sample))
    regular = torch.isfinite(R).all((-2, -1))[..., None, None]
    R = torch.where(regular, R, torch.eye(3, dtype=R.dtype, device=R.device))
    best = score_mappings(views, R).topk(_CANDIDATES, dim=1).indices
    return gather_rows(R.flatten(2), best).unflatten(-1, (3, 3))
