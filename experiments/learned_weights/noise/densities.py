"""How likely residuals are: densities, the most likely variance of a recording, intervals of means over keyframes."""

from __future__ import annotations

import math
from copy import deepcopy

import torch
from torch import Tensor

from experiments.common import interval_of
from experiments.learned_weights.noise.model import NoiseModel
from experiments.learned_weights.noise.training import BEND, Residuals, losses
from torchslam.geometry.robust import robustify

ITERATIONS = 50
FREEDOM = 4  # degrees, of Student's t: few, for heavy tails
DRAWS = 2000
LOG_NORMALIZER = math.log(2 * math.pi * (1 + math.exp(-(BEND**2) / 2) / BEND**2))
"""Of the density exp(-rho / 2) over the plane, with Huber's rho."""


@torch.no_grad()
def variance_of(model: NoiseModel, found: Residuals) -> Tensor:
    """The most likely variance of residuals in x and in y, in units of what an isotropic model states."""
    squared = model.log_factor(found.values).exp() * found.errors.square().sum(-1)
    variance = squared.mean() / 2
    for _ in range(ITERATIONS):
        whitened = squared / variance
        weight = robustify(whitened, "huber", squared.new_tensor(BEND)).weight
        variance = variance * (weight * whitened).mean() / 2
    return variance


@torch.no_grad()
def at_number(model: NoiseModel, found: Residuals) -> NoiseModel:
    """The model times the number that the residuals of a recording give, without any truth."""
    moved = deepcopy(model)
    moved.level.sub_(variance_of(model, found).log())
    return moved


@torch.no_grad()
def log_likelihoods(model: NoiseModel, found: Residuals) -> Tensor:
    """(n,) nats of each error in scales, by the density whose logarithm is the kernel of `solve_graph`."""
    return -losses(model, found) - LOG_NORMALIZER


def log_likelihoods_by_t(found: Residuals) -> Tensor:
    """(n,) nats of each error in scales, by Student's t in the plane with the most likely scale."""
    squared = found.errors.square().sum(-1)
    variance = squared.mean() / 2
    for _ in range(ITERATIONS):
        variance = ((FREEDOM + 2) / (FREEDOM + squared / variance) * squared).mean() / 2
    return -(2 * math.pi * variance).log() - (FREEDOM / 2 + 1) * torch.log1p(squared / (FREEDOM * variance))


def interval(gains: Tensor, frames: Tensor) -> tuple[float, float]:
    """95 % interval of the mean of gains (n,), by drawing the keyframes (n,) that they are in."""
    sums = gains.new_zeros(int(frames.max()) + 1, 2)
    sums.index_add_(0, frames, torch.stack((gains, torch.ones_like(gains)), dim=-1))
    sums = sums[sums[:, 1] > 0]
    rows = torch.randint(len(sums), (DRAWS, len(sums)), generator=torch.Generator().manual_seed(0))
    total, count = sums[rows].sum(1).unbind(-1)
    return interval_of(total / count)
