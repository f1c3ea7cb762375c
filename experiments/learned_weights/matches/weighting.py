"""The network that weighs matches, and the refinement it is trained through."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from experiments.learned_weights.matches.problems import Problems
from torchslam.geometry import innovation_covariances, mahalanobis_squared, transform
from torchslam.geometry.robust import Kernel
from torchslam.optim import POSE_OPTIONS, RefinedPose, solve_pose

NUM_FEATURES = 21
ROUNDS = 2
KERNEL: Kernel = "cauchy"
SCALE = 1.0
ITERATIONS = 10
TOLERANCE = 1e-7
NEIGHBORHOOD = 0.06  # radius in focal lengths


class InContext(nn.Module):
    """A score of each match from its cues and the mean over its problem; initially zero."""

    def __init__(self, num_cues: int, width: int, seed: int) -> None:
        super().__init__()
        self.local = nn.Linear(num_cues, width, dtype=torch.float64)
        self.mixed = nn.Linear(2 * width, width, dtype=torch.float64)
        self.last = nn.Linear(width, 1, dtype=torch.float64)
        generator = torch.Generator().manual_seed(seed)
        for layer in (self.local, self.mixed):
            nn.init.xavier_uniform_(layer.weight, generator=generator)
            nn.init.zeros_(layer.bias)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)

    def numbers(self, cues: Tensor, mask: Tensor) -> Tensor:
        """(P, N, C), (P, N) -> (P, N), of any size; what is masked counts for no other match."""
        hidden = nn.functional.silu(self.local(cues))
        rows = mask[..., None].to(hidden.dtype)
        context = (hidden * rows).sum(1, keepdim=True) / rows.sum(1, keepdim=True).clamp_min(1)
        hidden = nn.functional.silu(self.mixed(torch.cat([hidden, context.expand_as(hidden)], -1)))
        return self.last(hidden)[..., 0]


def masked_median(values: Tensor, mask: Tensor) -> Tensor:
    """(P, 1) median of the masked entries of (P, N), NaN where there are none."""
    return values.masked_fill(~mask, torch.nan).nanmedian(-1, keepdim=True).values


def crowd_and_support(
    positions: Tensor, radius: Tensor | float, inliers: Tensor, mask: Tensor
) -> tuple[Tensor, Tensor]:
    """(P, N) logarithm of the number of matches nearby over its mean, and the share of inliers among the others.

    Errors of neighbors are alike: their points were made from the same frames, and move with the same objects.

    positions: (P, N, 2); radius: of what is nearby in their units, one or (P, 1, 1); inliers, mask: (P, N) bool
    """
    near = ((torch.cdist(positions, positions) < radius) & mask[:, None, :]).to(positions.dtype)
    count = near.sum(-1).clamp_min(1)
    rows = mask.to(positions.dtype)
    crowd = (count * rows.sum(-1, keepdim=True) / (count * rows).sum(-1, keepdim=True).clamp_min(1)).log()
    agree = (near @ inliers[..., None].to(positions.dtype))[..., 0] - inliers.to(positions.dtype)
    return crowd, (agree + 0.5) / count


def refine(
    problems: Problems,
    weights: Tensor | None = None,
    kernel: Kernel = KERNEL,
    scale: float = SCALE,
    start: Tensor | None = None,
) -> RefinedPose:
    """Poses from a start (P, 4, 4), RANSAC's if None, with weights (P, N) in px^-2, one if None."""
    return solve_pose(
        problems.points,
        problems.pixels,
        T_cw=problems.T_start if start is None else start,
        camera=problems.camera,
        weights=weights,
        mask=problems.mask,
        options=POSE_OPTIONS.replace(kernel=kernel, scale=scale, iterations=ITERATIONS, tolerance=TOLERANCE),
    )


def refine_learned(network: MatchWeights, problems: Problems) -> list[RefinedPose]:
    """Poses with learned weights after every round, with gradients to the weights of that round."""
    T = problems.T_start
    rounds = []
    for head in network.heads:
        weights = head(describe(problems, T), propagated_variances(problems, T), problems.mask)
        rounds.append(refine(problems, weights, start=T))
        T = rounds[-1].T_cw.detach()
    return rounds


class MatchWeights(nn.Module):
    """Weights in rounds: the inputs of a round are computed at the pose of the round before."""

    def __init__(self, width: int = 32, seed: int = 0) -> None:
        super().__init__()
        self.heads = nn.ModuleList(_Head(width, ROUNDS * seed + number) for number in range(ROUNDS))


class _Head(InContext):
    """Weights from features: the network corrects the inverse of a variance that is known, at first not at all."""

    def __init__(self, width: int, seed: int) -> None:
        super().__init__(NUM_FEATURES, width, seed)

    def forward(self, features: Tensor, variances: Tensor, mask: Tensor) -> Tensor:
        """(P, N, NUM_FEATURES), (P, N) px^2, (P, N) -> (P, N) weights in px^-2, zero outside the mask."""
        logarithm = 6 * torch.tanh(self.numbers(features, mask) / 6)  # between e^-6 and e^6
        return torch.where(mask, logarithm.exp() / variances, 0.0)


def describe(problems: Problems, T: Tensor) -> Tensor:
    """Inputs of the network for each match, without unit and of about unit size: (P, N, NUM_FEATURES).

    Residuals, depths and propagated variances are those at the poses T (P, 4, 4).
    """
    cues, mask = problems.cues, problems.mask
    points_q = transform(T, problems.points)
    projected, valid = problems.camera.project(points_q)
    errors = projected - problems.pixels
    residuals = torch.where(valid, errors.norm(dim=-1) / cues.scales_query, 100.0)
    inliers = (residuals < 3.0) & mask
    noise = masked_median(residuals, inliers).nan_to_num(3.0).clamp_min(0.1)
    surprise = mahalanobis_squared(errors, _covariances(problems, T)).clamp_min(0)
    depths_q, depths_b = points_q[..., 2].clamp_min(1e-3), problems.points[..., 2]
    growth = (cues.scales_query * depths_q / (cues.scales_base * depths_b)).log()
    turn = cues.turns - masked_median(cues.turns, mask)
    x = problems.pixels / problems.focals[:, None, None]
    crowd, support = crowd_and_support(x, NEIGHBORHOOD, inliers, mask)
    columns = [
        cues.distances / 32 - 1,
        4 * (cues.distances / cues.seconds_query.clamp_min(1)) - 3,
        4 * (cues.distances / cues.seconds_base.clamp_min(1)) - 3,
        2 * cues.scales_query.log() - 1,
        2 * cues.scales_base.log() - 1,
        4 * cues.scores_query,
        4 * cues.scores_base,
        4 * growth.abs().clamp_max(1) - 1,
        2 * turn.sin().square() + (1 - turn.cos()),
        (residuals + 0.05).log(),
        (residuals / noise + 0.05).log(),
        (surprise + 0.01).log() / 2,
        noise.log(),
        (cues.parallaxes / 0.03).log(),
        cues.views - 2.5,
        cues.errors - 0.5,
        (depths_q / masked_median(depths_q, mask)).log(),
        propagated_variances(problems, T).log() / 2,
        crowd,
        4 * support - 3,
        4 * inliers.sum(-1, keepdim=True) / mask.sum(-1, keepdim=True) - 3,
    ]
    features = torch.stack([column.expand_as(depths_q) for column in columns], dim=-1)
    return torch.where(mask[..., None], features, 0.0).clamp(-6, 6)


def _covariances(problems: Problems, T: Tensor) -> Tensor:
    """(P, N, 2, 2) px^2 at poses T: of a keypoint by its level, plus what its point's covariance adds."""
    J = problems.camera.project_with_point_jacobians(transform(T, problems.points))[2] @ T[:, None, :3, :3]
    return innovation_covariances(J, problems.covariances, problems.cues.scales_query)


def propagated_variances(problems: Problems, T: Tensor) -> Tensor:
    """(P, N) px^2, mean of x and y, at poses T."""
    return 0.5 * _covariances(problems, T).diagonal(dim1=-2, dim2=-1).sum(-1)
