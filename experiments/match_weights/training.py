"""Training through the solver, on one process or several with the same result to the last bit.

A step's batch is always cut into the same shards. Every process does its share of them, all receive all gradients,
and everybody adds them in the order of the shards: the sum does not depend on who did what.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn

from experiments.match_weights.evaluation import UNIFORM
from experiments.match_weights.problems import Problems
from experiments.match_weights.weighting import refine, refine_learned
from torchslam.learning.losses import pose_errors
from torchslam.learning.training import Training
from torchslam.optim import RefinedPose

SHARDS = 2  # of a batch; the number of processes divides it
_CHUNK = 64
RefinedBy = Callable[[Any, Problems], list[RefinedPose]]


@dataclass(frozen=True)
class Settings:
    """steps and batch (problems of a step) of the training; matches: kept of a problem, drawn anew every time."""

    steps: int = 800
    batch: int = 32
    matches: int = 128
    learning_rate: float = 1e-2
    weight_decay: float = 1e-3
    seed: int = 0


def losses(
    network: nn.Module, problems: Problems, units: Tensor, refined_by: RefinedBy = refine_learned
) -> Tensor:
    """(P,) how large the errors of position and rotation are in units (P, 2) of metres and radians.

    Grows like a logarithm, so that the problems in the middle count, not the hopeless ones; zero on failure.
    """
    total = torch.zeros_like(units[:, 0])
    for refined in refined_by(network, problems):
        errors = pose_errors(refined.T_cw, problems.T_true)
        total = total + torch.where(refined.success, (errors / units).log1p().sum(-1), 0.0)
    return total


@torch.no_grad()
def expected_errors(problems: Problems) -> Tensor:
    """(P, 2) standard deviations of position (metres) and rotation (radians) by the covariance of equal weights."""
    parts = [problems[start : start + _CHUNK] for start in range(0, len(problems), _CHUNK)]
    refined = [refine(part, None, UNIFORM.kernel, UNIFORM.scale) for part in parts]
    variances = torch.cat([result.covariance.diagonal(dim1=-2, dim2=-1) for result in refined])
    return variances.unflatten(-1, (2, 3)).sum(-1).clamp_min(1e-12).sqrt()


def train(
    network: nn.Module, parts: list[Problems], settings: Settings, refined_by: RefinedBy = refine_learned
) -> list[float]:
    """Fit the network in place, every part being drawn as often as any other.

    refined_by: poses of problems by the network's weights, as often as they count in the loss

    Returns the mean loss of every step, the same on every process.
    """
    rank, ranks = (dist.get_rank(), dist.get_world_size()) if dist.is_initialized() else (0, 1)
    if SHARDS % ranks or settings.batch % SHARDS:
        raise ValueError(
            f"a batch of {settings.batch} in {SHARDS} shards does not divide among {ranks} processes"
        )
    problems, sizes = Problems.cat(parts), torch.tensor([len(part) for part in parts])
    first = sizes.cumsum(0) - sizes
    units = expected_errors(problems)
    parameters = list(network.parameters())
    optimizer = torch.optim.AdamW(parameters, settings.learning_rate, weight_decay=settings.weight_decay)
    training = Training(network, optimizer, settings.steps, settings.seed)
    generator = training.generator
    for _ in training:
        part = torch.randint(len(parts), (settings.batch,), generator=generator)
        rows = first[part] + (torch.rand(settings.batch, generator=generator) * sizes[part]).long()
        keys = torch.rand(settings.batch, problems.mask.shape[1], generator=generator)
        shards = list(zip(rows.chunk(SHARDS), keys.chunk(SHARDS), strict=True))
        mine = [
            _gradient(
                network,
                problems[some].thinned(key.to(problems.mask.device), settings.matches),
                units[some],
                refined_by,
            )
            for some, key in shards[rank * SHARDS // ranks : (rank + 1) * SHARDS // ranks]
        ]
        mean = _gathered(torch.stack(mine), ranks).sum(0) / settings.batch
        numbers = [parameter.numel() for parameter in parameters]
        for parameter, gradient in zip(parameters, mean[:-1].split(numbers), strict=True):
            parameter.grad = gradient.view_as(parameter).clone()
        training.update(float(mean[-1]))
    return training.losses


def _gradient(network: nn.Module, problems: Problems, units: Tensor, refined_by: RefinedBy) -> Tensor:
    """The gradient of the summed loss, flat, and the sum itself at the end."""
    total = losses(network, problems, units, refined_by).sum()
    gradients = torch.autograd.grad(total, list(network.parameters()))
    return torch.cat([*(gradient.flatten() for gradient in gradients), total.detach()[None]])


def _gathered(mine: Tensor, ranks: int) -> Tensor:
    """The rows (shards / ranks, D) of all processes, in order: (shards, D)."""
    if ranks == 1:
        return mine
    rows = [torch.empty_like(mine, device="cpu") for _ in range(ranks)]
    dist.all_gather(rows, mine.cpu())
    return torch.cat(rows).to(mine.device)
