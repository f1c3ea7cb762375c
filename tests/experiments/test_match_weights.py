"""Match weights: training through the solver lowers the errors of poses."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

from experiments.learned_weights.matches import weighting
from experiments.learned_weights.matches.evaluation import (
    FixedKernel,
    Learned,
    Oracle,
    Ransac,
    choose,
    median_error,
)
from experiments.learned_weights.matches.problems import Cues, Problems, with_ransac
from experiments.learned_weights.matches.report import PartResult, error_table
from experiments.learned_weights.matches.training import Settings, losses, train
from experiments.learned_weights.matches.weighting import MatchWeights, describe, propagated_variances
from torchslam.geometry import Camera, se3_exp, transform

FOCAL = 500.0
SETTINGS = Settings(steps=20, batch=8, matches=40, learning_rate=1e-2)


def simulated(count: int = 24, matches: int = 60, seed: int = 0) -> Problems:
    """Problems in which the distance of descriptors tells how noisy a match is, and nothing else does."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    rays = normal(count, matches, 2).clamp(-2, 2) * 0.25
    depths = 2 + 4 * torch.rand(count, matches, 1, generator=generator, dtype=torch.float64)
    points = torch.cat([rays * depths, depths], -1)
    T_true = se3_exp(0.05 * normal(count, 6))
    camera = Camera.pinhole(FOCAL, FOCAL, 0.0, 0.0, size=(640, 480))
    pixels, _ = camera.project(transform(T_true, points))
    is_noisy = torch.rand(count, matches, generator=generator) < 0.6
    pixels = pixels + torch.where(is_noisy[..., None], 2.5, 0.1) * normal(count, matches, 2)
    one = torch.ones(count, matches, dtype=torch.float64)
    cues = Cues(
        distances=torch.where(is_noisy, 60.0, 10.0).double(),
        seconds_query=80 * one,
        seconds_base=80 * one,
        scales_query=one,
        scales_base=one,
        scores_query=0 * one,
        scores_base=0 * one,
        turns=0 * one,
        parallaxes=0.05 * one,
        views=3 * one,
        errors=0.5 * one,
    )
    problems = Problems(
        points=points,
        covariances=1e-8 * torch.eye(3, dtype=torch.float64).expand(count, matches, 3, 3),
        pixels=pixels,
        mask=torch.arange(matches).expand(count, matches) < matches - torch.arange(count)[:, None] % 7,
        cues=cues,
        focals=torch.full((count,), FOCAL, dtype=torch.float64),
        T_true=T_true,
        T_given=T_true,
        spans=torch.arange(count)[:, None] + torch.tensor([0.0, 2.0], dtype=torch.float64),
        T_ransac=torch.empty(count, 0, 4, 4, dtype=torch.float64),
    )
    return with_ransac(problems)


@pytest.fixture(scope="module")
def problems() -> Problems:
    return simulated()


def test_training_lowers_the_loss_and_the_error_on_unseen_problems(problems: Problems) -> None:
    network, unseen = MatchWeights(width=8), simulated(seed=1)
    before = median_error(Learned(network), unseen)
    history = train(network, [problems], SETTINGS)
    assert sum(history[-5:]) < sum(history[:5])
    assert median_error(Learned(network), unseen) < 0.8 * before


def test_the_gradient_of_the_loss_agrees_with_finite_differences(
    problems: Problems, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(weighting, "ITERATIONS", 50)
    monkeypatch.setattr(weighting, "TOLERANCE", 1e-14)
    network, few = MatchWeights(width=4), problems[:3]
    last = network.heads[-1].last
    units = torch.full((3, 2), 1e-3, dtype=torch.float64)
    (gradient,) = torch.autograd.grad(losses(network, few, units).sum(), last.weight)
    step = 1e-3
    for column in range(4):
        values = []
        for sign in (1, -1):
            with torch.no_grad():
                last.weight[0, column] += sign * step
                values.append(float(losses(network, few, units).sum()))
                last.weight[0, column] -= sign * step
        assert math.isclose(
            gradient[0, column], (values[0] - values[1]) / (2 * step), rel_tol=1e-2, abs_tol=1e-3
        )


def test_padding_changes_nothing(problems: Problems) -> None:
    network = MatchWeights(width=4)
    head = network.heads[0]
    torch.nn.init.normal_(head.last.weight, generator=torch.Generator().manual_seed(0))
    one = problems[1:2]
    count = int(one.mask.sum())
    short = one.thinned(torch.arange(one.mask.shape[1])[None].float(), count)
    assert not one.mask.all()
    assert short.mask.all()
    weights = [head(describe(x, x.T_start), propagated_variances(x, x.T_start), x.mask) for x in (one, short)]
    torch.testing.assert_close(weights[0][:, :count], weights[1])
    assert (weights[0][:, count:] == 0).all()


def test_the_best_setting_is_chosen(problems: Problems) -> None:
    options = [Ransac(1.5), FixedKernel("truncated", 0.01), FixedKernel("cauchy", 0.5)]
    chosen = choose(options, [problems])
    scores = [median_error(option, problems) for option in options]
    assert chosen == options[int(torch.stack(scores).argmin())]


def test_the_oracle_beats_ransac(problems: Problems) -> None:
    assert median_error(Oracle(), problems) < median_error(Ransac(6.0), problems)


def test_the_table_shows_the_gain_over_the_best_competitor(problems: Problems) -> None:
    def at(centimeters: float) -> Tensor:
        T = problems.T_true.clone()
        T[:, 0, 3] += centimeters / 100
        return T

    poses = {
        "uniform weights": [at(2)],
        "best kernel": [at(1)],
        "RANSAC": [at(3)],
        "learned": [at(0.8), at(0.8)],
    }
    text = error_table({"all": PartResult.of(problems, poses, problems.T_true)})
    assert "-20.0 ± 0.0 % (-20 to -20)" in text
    assert "0.80 cm, 0.000°" in text


def test_problems_round_trip_through_a_file(problems: Problems, tmp_path: Path) -> None:
    problems.save(tmp_path / "folder" / "problems.pt")
    loaded = Problems.load(tmp_path / "folder" / "problems.pt")
    assert torch.equal(loaded.points, problems.points)
    assert torch.equal(loaded.cues.distances, problems.cues.distances)
