"""The network that weighs matches, and the refinement it is trained through."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from experiments.match_weights.problems import Problems
from torchslam.geometry import transform
from torchslam.solvers import RefinedPose, refine_pose
from torchslam.solvers.robust import Kernel

NUM_FEATURES = 17
KERNEL: Kernel = "geman_mcclure"
SCALE = 2.0
ITERATIONS = 15
TOLERANCE = 1e-8


def refine(
    problems: Problems, weights: Tensor | None = None, kernel: Kernel = KERNEL, scale: float = SCALE
) -> RefinedPose:
    """Poses from the start that RANSAC found, with weights (P, N) in px^-2, one if None."""
    return refine_pose(
        problems.T_start,
        problems.points,
        problems.pixels,
        problems.camera,
        weights,
        problems.mask,
        kernel,
        scale,
        iterations=ITERATIONS,
        tolerance=TOLERANCE,
    )


def refine_learned(network: MatchWeights, problems: Problems) -> RefinedPose:
    """Poses with learned weights, with gradients to the network."""
    weights = network(describe(problems), propagated_variances(problems), problems.mask)
    return refine(problems, weights)


class MatchWeights(nn.Module):
    """Weights from features, each match seen beside the mean of its problem.

    The network corrects the inverse of a variance that is known; it starts with no correction at all.
    """

    def __init__(self, width: int = 32, seed: int = 0) -> None:
        super().__init__()
        self.local = nn.Linear(NUM_FEATURES, width, dtype=torch.float64)
        self.mixed = nn.Linear(2 * width, width, dtype=torch.float64)
        self.last = nn.Linear(width, 1, dtype=torch.float64)
        generator = torch.Generator().manual_seed(seed)
        for layer in (self.local, self.mixed):
            nn.init.xavier_uniform_(layer.weight, generator=generator)
            nn.init.zeros_(layer.bias)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)

    def forward(self, features: Tensor, variances: Tensor, mask: Tensor) -> Tensor:
        """(P, N, NUM_FEATURES), (P, N) px^2, (P, N) -> (P, N) weights in px^-2, zero outside the mask."""
        hidden = nn.functional.silu(self.local(features))
        rows = mask[..., None].to(hidden.dtype)
        context = (hidden * rows).sum(1, keepdim=True) / rows.sum(1, keepdim=True).clamp_min(1)
        hidden = nn.functional.silu(self.mixed(torch.cat([hidden, context.expand_as(hidden)], -1)))
        logarithm = 6 * torch.tanh(self.last(hidden)[..., 0] / 6)  # between e^-6 and e^6
        return torch.where(mask, logarithm.exp() / variances, 0.0)


def describe(problems: Problems) -> Tensor:
    """What the network knows of each match, free of units and of about unit size: (P, N, NUM_FEATURES).

    Residuals, depths and propagated variances are those at the pose that RANSAC found.
    """
    cues, mask = problems.cues, problems.mask
    points_q = transform(problems.T_start, problems.points)
    projected, valid = problems.camera.project(points_q)
    residuals = (projected - problems.pixels).norm(dim=-1) / cues.scales_query
    residuals = torch.where(valid, residuals, 100.0)
    inliers = (residuals < 3.0) & mask
    noise = _median(residuals, inliers).nan_to_num(3.0).clamp_min(0.1)
    depths_q, depths_b = points_q[..., 2].clamp_min(1e-3), problems.points[..., 2]
    growth = (cues.scales_query * depths_q / (cues.scales_base * depths_b)).log()
    turn = cues.turns - _median(cues.turns, mask)
    matches = mask.sum(-1, keepdim=True)
    columns = [
        cues.distances / 32 - 1,
        4 * (cues.distances / cues.seconds.clamp_min(1)) - 3,
        2 * cues.scales_query.log() - 1,
        2 * cues.scales_base.log() - 1,
        4 * growth.abs().clamp_max(1) - 1,
        2 * turn.sin().square() + (1 - turn.cos()),
        (residuals + 0.05).log(),
        (residuals / noise + 0.05).log(),
        noise.log(),
        (cues.parallaxes / 0.03).log(),
        cues.views - 2.5,
        cues.errors - 0.5,
        (depths_q / _median(depths_q, mask)).log(),
        propagated_variances(problems).log() / 2,
        crowding(problems),
        4 * inliers.sum(-1, keepdim=True) / matches - 3,
        (matches / 100).log(),
    ]
    features = torch.stack([column.expand_as(depths_q) for column in columns], dim=-1)
    return torch.where(mask[..., None], features, 0.0).clamp(-6, 6)


def propagated_variances(problems: Problems) -> Tensor:
    """(P, N) px^2, mean of x and y: of a keypoint by its level, plus what its point's covariance adds."""
    points_q = transform(problems.T_start, problems.points)
    J = problems.camera.project_with_point_jacobians(points_q)[2] @ problems.T_start[:, None, :3, :3]
    added = 0.5 * (J @ problems.covariances @ J.mT).diagonal(dim1=-2, dim2=-1).sum(-1)
    return problems.cues.scales_query.square() + added


def crowding(problems: Problems, radius: float = 0.06) -> Tensor:
    """(P, N) logarithm of the number of matches within a radius, in focal lengths, over its mean.

    Errors of neighbours are alike: their points were made from the same frames, and move with the same objects.
    """
    x = problems.pixels / problems.focals[:, None, None]
    near = (torch.cdist(x, x) < radius) & problems.mask[:, None, :]
    count = near.sum(-1).clamp_min(1).to(x.dtype)
    rows = problems.mask.to(x.dtype)
    return (count * rows.sum(-1, keepdim=True) / (count * rows).sum(-1, keepdim=True)).log()


def _median(values: Tensor, mask: Tensor) -> Tensor:
    """(P, 1) median of the masked entries of (P, N), NaN where there are none."""
    return values.masked_fill(~mask, torch.nan).nanmedian(-1, keepdim=True).values
