"""Likelihood of residuals by noise models, and consistency of keyframes, on simulated graphs."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from experiments.learned_weights.noise.consistency import (
    aligned_covariance,
    inverse_information,
    nees,
    reduced_information,
)
from experiments.learned_weights.noise.densities import (
    at_number,
    interval,
    log_likelihoods,
    log_likelihoods_by_t,
    variance_of,
)
from experiments.learned_weights.noise.likelihood import Recording, fitted
from experiments.learned_weights.noise.model import constant
from experiments.learned_weights.noise.training import BEND, Residuals, solved
from tests.experiments.test_noise_model import normal, simulated


def residuals_of(errors: Tensor, values: Tensor) -> Residuals:
    directions = torch.eye(2, dtype=torch.float64).expand(len(errors), 2, 2)
    return Residuals(
        errors, values, directions, torch.ones(len(errors)).double(), torch.arange(len(errors)) // 50
    )


def varying(seed: int, level: float) -> Residuals:
    """Errors of deviation level exp(-x / 2), x the first of two cues."""
    values = normal(seed, 4000, 2)
    return residuals_of(level * torch.exp(-values[:, :1] / 2) * normal(seed + 1, 4000, 2), values)


def test_the_density_integrates_to_one() -> None:
    side = torch.linspace(-6, 6, 601, dtype=torch.float64)
    grid = torch.cartesian_prod(side, side)
    density = log_likelihoods(constant(4.0), residuals_of(grid, grid)).exp()
    assert float(density.sum()) * 0.02**2 == pytest.approx(1.0, abs=1e-3)


def test_student_t_has_known_values() -> None:
    # Two errors of squares 1 and 3: the most likely variance v solves 1 = 1.5 / (4 v + 1) + 4.5 / (4 v + 3).
    found = residuals_of(torch.tensor([[1.0, 0.0], [0.0, 3.0**0.5]]).double(), torch.zeros(2, 2).double())
    logs = log_likelihoods_by_t(found)
    v = (1 + 7**0.5) / 4
    wanted = [-math.log(2 * math.pi * v) - 3 * math.log(1 + square / (4 * v)) for square in (1.0, 3.0)]
    assert logs.tolist() == pytest.approx(wanted, rel=1e-6)


@pytest.mark.parametrize("deviation", [0.2, 0.7])
def test_the_number_of_a_recording_is_its_variance_and_the_most_likely(deviation: float) -> None:
    found = residuals_of(deviation * normal(0, 20000, 2), torch.zeros(20000, 2).double())
    assert float(variance_of(constant(1.0), found)) == pytest.approx(deviation**2, rel=0.05)
    number = at_number(constant(1.0), found)
    assert float(variance_of(number, found)) == pytest.approx(1.0, abs=1e-6)
    best = float(log_likelihoods(number, found).mean())
    for factor in (0.8, 1.25):
        other = constant(factor * float(number.level.detach().exp()))
        assert float(log_likelihoods(other, found).mean()) < best


def test_student_t_is_likelier_for_heavy_tails_alone() -> None:
    mixed = normal(5, 20000, 2) * (1 + 3 * (torch.arange(20000) % 5 == 0).double()[:, None])
    found = {tails: residuals_of(errors, errors) for tails, errors in ((0, normal(0, 20000, 2)), (1, mixed))}
    for tails, each in found.items():
        number = at_number(constant(1.0), each)
        gain = float((log_likelihoods_by_t(each) - log_likelihoods(number, each)).mean())
        assert (gain > 0.02) == bool(tails)


def test_a_function_of_cues_is_found_across_recordings_of_other_noise() -> None:
    model, unseen = fitted([varying(10, 0.2), varying(20, 0.9)], seed=0), varying(30, 0.4)
    gains = log_likelihoods(at_number(model, unseen), unseen) - log_likelihoods(
        at_number(constant(1.0), unseen), unseen
    )
    low, high = interval(gains, unseen.frames)
    assert 0.1 < low < float(gains.mean()) < high
    flat = replace(unseen, values=torch.zeros_like(unseen.values))  # cues that tell nothing
    assert float(log_likelihoods(at_number(model, flat), flat).mean()) == pytest.approx(
        float(log_likelihoods(at_number(constant(1.0), unseen), unseen).mean())
    )


def test_nees_is_one_where_the_stated_noise_is_the_true_one() -> None:
    found = []
    for seed in range(0, 400, 10):
        example = simulated(seed, sigma=0.3)
        weights = torch.full_like(example.graph.weights, 0.3**-2)
        example = solved(replace(example, graph=replace(example.graph, weights=weights)))
        found.append(nees(example.graph, example.T_cw, example.known, BEND))
    assert sum(found) / len(found) == pytest.approx(1.0, abs=0.2)
    doubled = replace(example.graph, weights=example.graph.weights / 4)  # twice the deviation
    without_bend = [nees(graph, example.T_cw, example.known, 1e6) for graph in (example.graph, doubled)]
    assert without_bend[1] == pytest.approx(without_bend[0] / 4, rel=1e-6)


def test_aligned_covariances_have_no_variance_along_a_similarity() -> None:
    example = solved(simulated(3))
    of_poses = inverse_information(reduced_information(example.graph, BEND))
    covariance = aligned_covariance(example.graph.T_cw, example.known, of_poses)
    count = len(example.known)
    shift = torch.eye(3, dtype=torch.float64).repeat(count, 1)
    assert float((covariance @ shift).abs().max()) < 1e-9 * float(covariance.diagonal().max())


def test_a_recording_knows_the_row_of_each_keypoint() -> None:
    example = simulated(4)
    recording = Recording.of(example)
    rows = example.graph.pixels[:, 1] / example.graph.camera.height
    torch.testing.assert_close(recording.example.values[:, -1], rows - rows.mean())
    assert recording.seeing((0, 10)).found.values.shape[-1] == 2
