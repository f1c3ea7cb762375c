"""Calibration through the solution of a graph: derivatives, known cameras, and a run with a wrong camera."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from experiments.self_calibration.calibration import (
    calibrate,
    keyframes_of,
    least_cost,
    parameters,
    with_parameters,
)
from experiments.self_calibration.rounds import Remembered, rounds
from experiments.self_calibration.run import PosesOnly, misjudged
from tests.walks import Walk, arc
from torchslam.config import load_config
from torchslam.front_end import simulated_extractor
from torchslam.geometry import Camera, se3_exp, transform
from torchslam.run import true_poses
from torchslam.solvers.graph import ObservationGraph

TRUTH = Camera.radial_tangential(400.0, 404.0, 320.0, 240.0, -0.28, 0.07, 1e-3, -1e-3, size=(640, 480))


def simulated(noise: float = 0.0, frames: int = 8, points: int = 80) -> ObservationGraph:
    """A graph of keyframes around a cloud of points, seen by `TRUTH`, and started at the truth."""
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    twists = 0.1 * normal(frames, 6)
    twists[:, 0] += torch.linspace(-1.5, 1.5, frames, dtype=torch.float64)
    twists[:, 4] += torch.linspace(0.3, -0.3, frames, dtype=torch.float64)
    T_cw = se3_exp(twists)
    points_w = torch.stack((1.5 * normal(points), normal(points), 5 + normal(points).clamp(-2, 2)), -1)
    frame_index, point_index = torch.ones(frames, points).nonzero().unbind(-1)
    pixels, valid = TRUTH.project(transform(T_cw[frame_index], points_w[point_index][:, None]))
    seen = (valid & TRUTH.in_image(pixels))[:, 0]
    return ObservationGraph(
        torch.arange(frames, dtype=torch.float64),
        T_cw,
        points_w,
        frame_index[seen],
        point_index[seen],
        pixels[seen, 0] + noise * normal(int(seen.sum()), 2),
        torch.ones(int(seen.sum()), dtype=torch.float64),
        TRUTH,
        torch.ones(frames, dtype=torch.bool),
    )


def test_parameters_come_back() -> None:
    theta = parameters(TRUTH, 2)
    torch.testing.assert_close(theta[1:], TRUTH.params[4:6])
    torch.testing.assert_close(with_parameters(TRUTH, theta).params, TRUTH.params)
    longer = with_parameters(TRUTH, theta + torch.tensor([math.log(2.0), 0.0, 0.0], dtype=torch.float64))
    torch.testing.assert_close(longer.params[:2], 2 * TRUTH.params[:2])
    torch.testing.assert_close(longer.params[2:], TRUTH.params[2:])


def test_derivatives_of_the_least_cost() -> None:
    """Central differences of the solved cost and of its gradient: poses and points follow the camera."""
    graph = keyframes_of(simulated(noise=0.3))
    theta = parameters(TRUTH, 2) + torch.tensor([0.01, 0.005, -0.005], dtype=torch.float64)
    here = least_cost(graph, theta)
    for row in range(3):
        step = torch.zeros(3, dtype=torch.float64)
        step[row] = 1e-5
        ahead, behind = least_cost(here.graph, theta + step), least_cost(here.graph, theta - step)
        slope, bend = (ahead.value - behind.value) / 2e-5, (ahead.gradient - behind.gradient) / 2e-5
        torch.testing.assert_close(here.gradient[row], slope, rtol=1e-4, atol=1e-4)
        torch.testing.assert_close(
            here.hessian[row], bend, rtol=1e-3, atol=1e-3 * float(here.hessian.abs().max())
        )


@pytest.mark.parametrize("factor", [0.8, 1.2])
def test_the_camera_of_exact_pixels_is_found(factor: float) -> None:
    found = calibrate(replace(simulated(), camera=misjudged(TRUTH, factor, 2)), num_radial=2).graph.camera
    torch.testing.assert_close(found.params, TRUTH.params, rtol=1e-4, atol=0)


def test_standard_errors_tell_the_error() -> None:
    cost = calibrate(simulated(noise=0.5), num_radial=2)
    off = (parameters(cost.graph.camera, 2) - parameters(TRUTH, 2)).abs()
    assert (off < 4 * cost.standard_errors).all()
    assert float(cost.variance) == pytest.approx(0.25, rel=0.15)


def test_a_run_with_a_wrong_camera_ends_with_the_right_one() -> None:
    config = load_config(
        None, ["features.kind=simulated", "features.num_keypoints=300", "simulated.points_per_view=120"]
    )
    camera = Camera.pinhole(200.0, 200.0, 159.5, 119.5, size=(320, 240))
    walk = PosesOnly(Walk(arc(30)), camera)
    extractor = Remembered(simulated_extractor(config, camera, true_poses(walk)))
    done = list(rounds(walk, misjudged(camera, 0.8, 0), config, extractor))
    assert float(done[-1].calibrated.focal) == pytest.approx(200.0, rel=1e-3)
    assert done[-1].posed == 30
    assert done[-1].ate_m < 0.1 * done[0].ate_m
