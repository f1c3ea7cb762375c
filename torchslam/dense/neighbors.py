"""Which views a view is compared with: those that see the same points from another direction."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

BEST_ANGLE_DEG = 5.0
"""Parallax that is sought: less makes depth imprecise, more makes windows look different (MVSNet, Yao 2018)."""
BELOW_DEG, ABOVE_DEG = 1.0, 10.0
"""Standard deviations of the weight below and above the best angle, as there."""
LEAST_SHARED = 5
"""Points that two views must share: with fewer, their overlap is a guess."""


def neighbor_scores(
    points_w: Float[Tensor, "*batch N 3"],
    is_shared: Bool[Tensor, "*batch K N"],
    center_w: Float[Tensor, "*batch 3"],
    centers_w: Float[Tensor, "K 3"],
) -> Float[Tensor, "*batch K"]:
    """Score candidates by the points they share with a view and their parallax at each of them.

    Args:
        points_w: points that the view observes.
        is_shared: whether a candidate observes them too.
        center_w: camera center of the view.
        centers_w: camera centers of the candidates.

    Returns:
        Sum over the shared points of a weight of their parallax, 0 for candidates that share too few.
    """
    to_view = torch.nn.functional.normalize(center_w[..., None, :] - points_w, dim=-1)
    to_candidate = torch.nn.functional.normalize(centers_w[:, None] - points_w[..., None, :, :], dim=-1)
    cosine = (to_view[..., None, :, :] * to_candidate).sum(-1).clamp(-1, 1)
    angle = torch.rad2deg(torch.acos(cosine))
    sigma = torch.where(angle < BEST_ANGLE_DEG, BELOW_DEG, ABOVE_DEG).float()
    weight = torch.exp(-0.5 * ((angle - BEST_ANGLE_DEG) / sigma) ** 2)
    is_enough = is_shared.sum(-1) >= LEAST_SHARED
    return torch.where(is_enough, torch.where(is_shared, weight, 0.0).sum(-1), 0.0)


def choose_neighbors(
    scores: Float[Tensor, "*batch K"], count: int
) -> tuple[Int[Tensor, "*batch V"], Bool[Tensor, "*batch V"]]:
    """Choose the candidates of the highest scores, of equal ones the first.

    Returns:
        Their indices, best first, and whether there is such a candidate: its score is positive.
    """
    order = torch.sort(scores, dim=-1, descending=True, stable=True)
    return order.indices[..., :count], order.values[..., :count] > 0
