"""Noise models of keypoints: cues, information, likelihood, gradients through graphs."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from experiments.learned_weights.noise.cues import NAMES, describe, structure_tensors
from experiments.learned_weights.noise.graphs import Example, keyframes_of
from experiments.learned_weights.noise.model import Informed, NoiseModel, constant, load, powers, save
from experiments.learned_weights.noise.report import HAND, SHAPE, Outcome, geometric_mean, run_table
from experiments.learned_weights.noise.training import (
    Residuals,
    Settings,
    at_level,
    fit_likelihood,
    fit_trajectories,
    negative_log_likelihood,
    position_error,
    residuals,
    solved,
    weighed,
)
from torchslam import ORB, Camera
from torchslam.geometry import se3_exp, transform
from torchslam.optim.run_graph import ObservationGraph, solve_graph

FRAMES, POINTS = 10, 150
SMALL = Settings(rounds=3, likelihood_steps=120, likelihood_rate=0.05, trajectory_steps=3)


def normal(seed: int, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def simulated(seed: int, slope: float = 0.0, sigma: float = 0.3) -> Example:
    """A camera that goes sideways past points; noise is sigma exp(-slope x / 2), x the first of the cues."""
    twists = 0.02 * normal(seed, FRAMES, 6)
    twists[:, 0] += -0.15 * torch.arange(FRAMES)
    T_cw = se3_exp(twists)
    T_cw[0] = torch.eye(4)
    points_w = normal(seed + 1, POINTS, 3) * torch.tensor([1.0, 0.8, 0.5]) + torch.tensor([0.6, 0.0, 4.0])
    frame_index = torch.arange(FRAMES).repeat_interleave(POINTS)
    point_index = torch.arange(POINTS).repeat(FRAMES)
    camera = Camera.pinhole(500, 500, 320, 240, (640, 480))
    pixels, valid = camera.project(transform(T_cw, points_w))
    assert valid.all()
    values = normal(seed + 2, len(frame_index), len(NAMES))
    errors = sigma * torch.exp(-slope * values[:, :1] / 2) * normal(seed + 3, len(frame_index), 2)
    graph = ObservationGraph(
        torch.arange(FRAMES, dtype=torch.float64),
        T_cw,
        points_w,
        frame_index,
        point_index,
        pixels.flatten(0, 1) + errors,
        torch.ones(len(frame_index), dtype=torch.float64),
        camera,
        torch.ones(FRAMES, dtype=torch.bool),
    )
    directions = torch.eye(2, dtype=torch.float64).repeat(len(frame_index), 1, 1)
    return Example(graph, values, directions, T_cw.clone(), torch.ones(FRAMES, dtype=torch.bool), 1.0)


@pytest.fixture(scope="module")
def image() -> Tensor:
    """Random blobs of several sizes."""
    sizes = [(240 // k, 320 // k) for k in (4, 8, 20)]
    generator = torch.Generator().manual_seed(0)
    rough = [F.interpolate(torch.rand(1, 1, *size, generator=generator), size=(240, 320)) for size in sizes]
    return torch.stack(rough).mean(0)


def test_cues_are_finite_and_named(image: Tensor) -> None:
    orb = ORB(300)
    features = orb(image)
    cues = describe(orb, image, features)
    assert cues.values.shape == (1, 300, len(NAMES))
    assert bool(cues.values.isfinite().all() & cues.directions.isfinite().all())
    torch.testing.assert_close(cues.values[..., 0], features.scales.log())
    # The score that ORB ranks by is the one that is computed from the patch.
    response = cues.values[..., NAMES.index("response")].exp() - 1
    assert float((response - features.scores.floor()).abs().median()) < 1.0
    assert float(cues.values[..., NAMES.index("offset")].max()) <= math.sqrt(0.5) + 1e-4
    torch.testing.assert_close(cues.directions.diagonal(dim1=-2, dim2=-1).sum(-1), torch.full((1, 300), 2.0))
    blurred = F.avg_pool2d(image, 5, 1, 2)
    sharpness = NAMES.index("sharpness")
    assert float(describe(orb, blurred, orb(blurred)).values[0, 0, sharpness]) < float(
        cues.values[0, 0, sharpness]
    )


def test_structure_tensors_of_a_slope_have_known_values() -> None:
    x, y = torch.meshgrid(torch.arange(9.0), torch.arange(9.0), indexing="xy")
    torch.testing.assert_close(
        structure_tensors((3 * x - 2 * y)[None])[0], torch.tensor([[9.0, -6.0], [-6.0, 4.0]])
    )


def test_matrix_powers_have_determinant_one_and_follow_the_gradient() -> None:
    A = torch.diag(torch.tensor([4.0, 1.0], dtype=torch.float64))
    for exponent in (0.0, 0.5, 2.0):
        found = powers(A, torch.tensor(exponent, dtype=torch.float64))
        torch.testing.assert_close(found, torch.diag(A.new_tensor([2.0**exponent, 2.0**-exponent])))
    turned = torch.tensor([[2.0, 1.0], [1.0, 2.0]], dtype=torch.float64)
    one = powers(turned, torch.tensor(1.0, dtype=torch.float64))
    torch.testing.assert_close(one, turned / math.sqrt(3))
    round_ = powers(torch.eye(2, dtype=torch.float64), torch.tensor(1.0, dtype=torch.float64))
    torch.testing.assert_close(round_, torch.eye(2, dtype=torch.float64))


def test_the_likelihood_is_highest_at_the_true_noise() -> None:
    errors = 0.25 * normal(0, 20000, 2)
    found = Residuals(
        errors,
        torch.zeros(20000, len(NAMES)).double(),
        torch.eye(2).double().expand(20000, 2, 2),
        errors[:, 0] * 0 + 1,
        torch.zeros(20000, dtype=torch.int64),
    )
    with torch.no_grad():
        low, right, high = (float(negative_log_likelihood(constant(s**-2), found)) for s in (0.2, 0.25, 0.31))
    assert right < min(low, high)


def test_residuals_are_corrected_for_fitted_points() -> None:
    example = solved(simulated(1, sigma=0.3))
    found = residuals(example, example)
    assert float(found.errors.square().mean().sqrt()) == pytest.approx(0.3, rel=0.03)


def test_a_dependence_on_cues_is_learned_and_improves_the_graph() -> None:
    model = fit_likelihood([simulated(seed, slope=1.0) for seed in (10, 20)], "isotropic", SMALL)
    values = torch.zeros(2, len(NAMES), dtype=torch.float64)
    values[1, 0] = 1.0
    low, high = model.log_factor(values).detach().tolist()
    assert high - low == pytest.approx(1.0, abs=0.25)
    assert low == pytest.approx(-2 * math.log(0.3), abs=0.4)
    better = 0
    for seed in (30, 40, 50):
        example = simulated(seed, slope=1.0)
        with torch.no_grad():
            plain, weighted = solve_graph(example.graph), solve_graph(weighed(example, model).graph)
        better += float(position_error(example, weighted)) < float(position_error(example, plain))
    assert better >= 2


def test_training_on_trajectories_lowers_the_loss() -> None:
    examples = [simulated(seed, slope=1.0) for seed in (60, 70)]
    start = NoiseModel("isotropic")
    torch.nn.init.constant_(start.level, math.log(8.0))
    moved = fit_trajectories(start, examples, SMALL)
    assert float(start.line.detach().abs().max()) == 0.0

    @torch.no_grad()
    def loss(model: NoiseModel) -> float:
        return sum(
            float(position_error(each, solve_graph(weighed(each, model).graph)).log()) for each in examples
        )

    assert loss(moved) < loss(start)


def test_trajectories_without_ground_truth_are_an_error() -> None:
    example = simulated(0)
    untold = replace(example, known=torch.arange(FRAMES) < 3)
    with pytest.raises(ValueError, match="3 keyframes with true poses"):
        fit_trajectories(NoiseModel("isotropic"), [example, untold], SMALL)


def test_keyframes_of_the_largest_submap_are_extracted() -> None:
    graph = simulated(5).graph
    is_keyframe = torch.arange(FRAMES) % 2 == 0
    submap = (torch.arange(FRAMES) >= 8).to(torch.int64)
    part, frames, rows = keyframes_of(replace(graph, is_keyframe=is_keyframe, submap=submap))
    assert frames.tolist() == [0, 2, 4, 6]
    torch.testing.assert_close(part.pixels, graph.pixels[rows])
    torch.testing.assert_close(part.points_w[part.point_index], graph.points_w[graph.point_index[rows]])
    assert solve_graph(part).success.all()


@pytest.mark.parametrize("kind", ["constant", "isotropic", "directed"])
def test_the_feature_extractor_carries_the_models_information(
    image: Tensor, tmp_path: Path, kind: str
) -> None:
    model = NoiseModel(kind, seed=3)
    torch.nn.init.constant_(model.level, math.log(8.0))
    torch.nn.init.constant_(model.line, 0.1)
    torch.nn.init.constant_(model.power, 0.5)
    save(model, tmp_path / "model.safetensors")
    features = Informed(200, str(tmp_path / "model.safetensors"))(image)
    assert features.information is not None
    again = load(tmp_path / "model.safetensors")
    cues = describe(ORB(200), image, features)
    squared, of = features.scales[0].double().square(), torch.zeros(200, dtype=torch.int64)
    wanted = again(cues.values[0].double(), cues.directions[0].double(), squared, of)
    torch.testing.assert_close(features.information[0], wanted.detach().float())


def test_every_image_has_the_given_noise_level() -> None:
    model = NoiseModel("isotropic")
    torch.nn.init.constant_(model.line, 0.3)
    values, of = normal(7, 90, len(NAMES)), torch.arange(90) // 30
    directions = torch.eye(2, dtype=torch.float64).expand(90, 2, 2)
    ones = torch.ones(90, dtype=torch.float64)
    values[30:60] += 1.0
    plain = model(values, directions, ones, of).detach().log()
    found = at_level(model, 4.0)(values, directions, ones, of).detach().log()
    for image in range(3):
        rows = of == image
        assert float(found[rows].mean()) == pytest.approx(math.log(4.0))
        torch.testing.assert_close(found[rows] - found[rows].mean(), plain[rows] - plain[rows].mean())


def test_intervals_are_those_of_students_t() -> None:
    assert geometric_mean([0.0, 0.0, 0.0]) == "1.000 (1.000 to 1.000)"
    assert geometric_mean([math.log(0.9), math.log(1.1)]).startswith("0.995 (0.278 to ")


def test_runs_are_compared_by_the_seeds_that_both_posed() -> None:
    def outcome(ate_m: float, posed: int) -> Outcome:
        return Outcome(ate_m, posed, 100, 0)

    hand = {0: outcome(0.1, 100), 1: outcome(0.2, 100)}
    lost, half = outcome(0.001, 30), outcome(0.1, 100)
    lines = run_table({"one": {HAND: hand, SHAPE: {0: lost, 1: half}}}).splitlines()
    assert lines[3] == "| one | shape | 1, 100 | 0.500 | 30, 100 of 100 | 0, 0 |"
    assert lines[-1] == "| **all** | shape |  | 0.500 |  |  |"
