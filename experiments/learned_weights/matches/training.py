"""Training through the pose solver."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from experiments.learned_weights.matches.evaluation import UNIFORM
from experiments.learned_weights.matches.problems import Problems
from experiments.learned_weights.matches.weighting import MatchWeights, refine, refine_learned
from torchslam.learning import Training, pose_errors

_CHUNK = 64


@dataclass(frozen=True)
class Settings:
    """steps and batch (problems of a step) of the training; matches: kept of a problem, resampled in every step."""

    steps: int = 800
    batch: int = 32
    matches: int = 128
    learning_rate: float = 1e-2
    weight_decay: float = 1e-3
    seed: int = 0


def losses(network: MatchWeights, problems: Problems, units: Tensor) -> Tensor:
    """(P,) how large the errors of position and rotation are in units (P, 2) of meters and radians.

    Grows like a logarithm, so that the problems in the middle count, not the hopeless ones; zero on failure.
    """
    total = torch.zeros_like(units[:, 0])
    for refined in refine_learned(network, problems):
        errors = pose_errors(T_cw=refined.T_cw, T_cw_groundtruth=problems.T_true)
        total = total + torch.where(refined.success, (errors / units).log1p().sum(-1), 0.0)
    return total


@torch.no_grad()
def expected_errors(problems: Problems) -> Tensor:
    """(P, 2) standard deviations of position (meters) and rotation (radians) by the covariance of equal weights."""
    parts = [problems[start : start + _CHUNK] for start in range(0, len(problems), _CHUNK)]
    refined = [refine(part, None, UNIFORM.kernel, UNIFORM.scale) for part in parts]
    variances = torch.cat([result.covariance.diagonal(dim1=-2, dim2=-1) for result in refined])
    return variances.unflatten(-1, (2, 3)).sum(-1).clamp_min(1e-12).sqrt()


def train(network: MatchWeights, parts: list[Problems], settings: Settings) -> list[float]:
    """Fit the network in place, drawing every part equally often; returns the mean loss of every step."""
    problems, sizes = Problems.cat(parts), torch.tensor([len(part) for part in parts])
    first = sizes.cumsum(0) - sizes
    units = expected_errors(problems)
    optimizer = torch.optim.AdamW(
        network.parameters(), settings.learning_rate, weight_decay=settings.weight_decay
    )
    training = Training(network, optimizer, settings.steps, settings.seed)
    for _ in training:
        part = torch.randint(len(parts), (settings.batch,), generator=training.generator)
        rows = first[part] + (torch.rand(settings.batch, generator=training.generator) * sizes[part]).long()
        keys = torch.rand(settings.batch, problems.mask.shape[1], generator=training.generator)
        batch = problems[rows].thinned(keys, settings.matches)
        training.descend(losses(network, batch, units[rows]).mean())
    return training.losses
