"""The camera of a graph: known cameras, errors that tell the truth, motions that leave it open."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from torchslam.calibration import estimate_intrinsics
from torchslam.calibration.find_camera import contradiction
from torchslam.calibration.intrinsics import adjust_with_camera, frames_of, problem_of
from torchslam.geometry import Camera
from torchslam.geometry.camera_measurement import FOCAL, K1
from torchslam.optim.run_graph import ObservationGraph

Make = Callable[..., ObservationGraph]


def straight(camera: Camera, factor: float = 1.0) -> Camera:
    """`factor` times the focal length, no distortion."""
    return Camera.pinhole(factor * camera.fx, factor * camera.fy, camera.cx, camera.cy, camera.size)


@pytest.mark.parametrize("factor", [0.8, 1.25])
def test_exact_pixels_recover_the_camera(simulated: Make, truth: Camera, factor: float) -> None:
    """Focal length and both coefficients from none, the ratio of fx to fy and the rest as they are."""
    params = torch.cat([factor * truth.params[:2], truth.params[2:4], torch.zeros(2), truth.params[6:]])
    start = truth.with_params(params.double())
    estimate = estimate_intrinsics(replace(simulated(), camera=start), start, radial=2)
    assert estimate.num_radial == 2
    torch.testing.assert_close(estimate.camera.params, truth.params, rtol=1e-3, atol=1e-5)
    assert estimate.cost < 1e-3 * estimate.initial_cost


def test_a_correct_camera_converges_at_once(simulated: Make, truth: Camera) -> None:
    """Started at the answer, where all that is left of the cost is rounding."""
    problem = problem_of(simulated())
    for which in ([], [FOCAL], [FOCAL, K1]):
        fit = adjust_with_camera(problem, which)
        assert int(fit.convergence.iterations) <= 2
        assert fit.convergence.converged
        assert fit.success
        torch.testing.assert_close(fit.camera.params, truth.params, rtol=1e-9, atol=1e-9)
    noisy = adjust_with_camera(
        problem_of(simulated(noise=1e-6)), [FOCAL]
    )  # far below a pixel, far above rounding
    assert int(noisy.convergence.iterations) > 2
    assert float(noisy.cost) < 0.9 * float(noisy.convergence.initial_cost)
    estimate = estimate_intrinsics(simulated())
    assert contradiction(truth, estimate) == ""


def test_distortion_is_estimated_only_where_residuals_need_it(simulated: Make, truth: Camera) -> None:
    pinhole = straight(truth)
    estimate = estimate_intrinsics(
        replace(simulated(pinhole, noise=0.5), camera=straight(truth, 0.9)), pinhole, radial=2
    )
    assert estimate.num_radial == 0
    assert estimate.camera.model == "pinhole"
    assert float(estimate.camera.focal) == pytest.approx(float(truth.focal), rel=5e-3)
    torch.testing.assert_close(estimate.camera.params[2:], pinhole.params[2:])
    params = torch.tensor([400.0, 404.0, 320.0, 240.0, -0.3, 0.4, 0, 0, 0], dtype=torch.float64)
    bent = simulated(truth.with_params(params), noise=0.1)
    assert estimate_intrinsics(bent, pinhole, radial=2).num_radial == 2
    assert estimate_intrinsics(bent, pinhole, radial=1).num_radial == 1


def test_fixed_distortion_is_kept(simulated: Make, truth: Camera) -> None:
    estimate = estimate_intrinsics(simulated(noise=0.3))
    torch.testing.assert_close(estimate.camera.params[2:], truth.params[2:])
    assert estimate.focal_std == pytest.approx(estimate.conditional_focal_std)


@pytest.mark.parametrize("frames", [8, 24])
def test_formal_errors_agree_with_monte_carlo(simulated: Make, truth: Camera, frames: int) -> None:
    """Where the noise is what the error assumes it is about right, and in a short way on the safe side."""
    off, stds = [], []
    for seed in range(12):
        estimate = estimate_intrinsics(simulated(straight(truth), noise=0.5, frames=frames, seed=seed))
        off.append(math.log(float(estimate.camera.focal / truth.focal)))
        stds.append(estimate.conditional_focal_std)
    rms = math.sqrt(sum(x * x for x in off) / len(off))
    assert 0.2 < rms / (sum(stds) / len(stds)) < 1.5


def test_a_guessed_center_moves_within_its_prior(simulated: Make, truth: Camera) -> None:
    """To the true one where the pixels are good, hardly at all where they say nothing, and the error knows."""
    off = straight(truth).params + torch.tensor([0, 0, 6.0, -5.0], dtype=torch.float64)
    guess = Camera.pinhole(*off.tolist(), size=truth.size)
    stds = []
    for noise, near in ((0.02, 0.6), (4.0, 8.0)):
        graph = replace(simulated(straight(truth), noise=noise, frames=24), camera=guess)
        estimate = estimate_intrinsics(graph, guess, radial=2, principal_point=True)
        away = (estimate.camera.params[2:4] - truth.params[2:4]).abs()
        assert (away < near).all()
        assert (estimate.camera.params[2:4] - off[2:4]).norm() < 9
        assert abs(math.log(float(estimate.camera.focal / truth.focal))) < 3 * estimate.focal_std
        assert estimate.focal_std >= estimate.conditional_focal_std
        stds.append(estimate.focal_std)
    assert stds[0] < 0.2 * stds[1]
    held = estimate_intrinsics(graph, guess, radial=2)
    torch.testing.assert_close(held.camera.params[2:4], off[2:4])


def test_disagreeing_parts_of_the_path_increase_the_uncertainty(simulated: Make, truth: Camera) -> None:
    graph = simulated(straight(truth), noise=0.2, frames=24)
    principal_point = straight(truth).params[2:4]
    later = (graph.frame_index >= 12)[:, None]
    zoomed = torch.where(later, principal_point + 1.05 * (graph.pixels - principal_point), graph.pixels)
    assert (
        estimate_intrinsics(replace(graph, pixels=zoomed)).conditional_focal_std
        > 4 * estimate_intrinsics(graph).conditional_focal_std
    )


def test_a_straight_path_does_not_determine_the_camera(simulated: Make, truth: Camera) -> None:
    twists = torch.zeros(16, 6, dtype=torch.float64)
    twists[:, 2] = torch.linspace(0, 1.5, 16)
    graph = simulated(straight(truth), noise=0.5, twists=twists, frames=16)
    estimate = estimate_intrinsics(
        replace(graph, camera=straight(truth, 0.9)), straight(truth), radial=2, principal_point=True
    )
    assert not estimate.is_determined
    turning = estimate_intrinsics(simulated(straight(truth), noise=0.5, frames=16), straight(truth), radial=2)
    assert turning.is_determined


def test_a_frontal_plane_does_not_determine_the_camera(simulated: Make, truth: Camera) -> None:
    """Along a wall and towards it, with the turns that a hand makes; turned to its sides, it tells the focal length."""
    way = torch.linspace(0, 1, 12, dtype=torch.float64)
    twists = 1e-2 * torch.randn(12, 6, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    twists[:, 0] += 3 * way - 1.5
    twists[:, 1] += 0.4 * torch.sin(7 * way)
    twists[:, 2] += 0.8 * torch.sin(4 * way)
    off, pinhole = straight(truth, 0.9), straight(truth)
    wall = simulated(pinhole, noise=0.5, twists=twists, frames=12, depth=0.0)
    estimate = estimate_intrinsics(replace(wall, camera=off), off, radial=2, principal_point=True)
    assert not estimate.is_determined
    twists[:, 4] += 0.5 * torch.cos(5 * way)
    twists[:, 3] += 0.3 * torch.sin(5 * way)
    tilted = simulated(pinhole, noise=0.5, twists=twists, frames=12, depth=0.0)
    estimate = estimate_intrinsics(replace(tilted, camera=off), off)
    assert estimate.is_determined
    assert abs(math.log(float(estimate.camera.focal / truth.focal))) < 3 * estimate.focal_std


def test_few_keyframes_are_complemented_by_frames(simulated: Make, truth: Camera) -> None:
    graph = simulated(straight(truth), frames=40)
    few = replace(graph, is_keyframe=torch.arange(40) % 13 == 0)
    frames = frames_of(few)
    assert set(range(0, 40, 13)) <= set(frames.tolist())
    assert 20 <= len(frames) <= 24
    assert frames.tolist() == sorted(frames.tolist())
    many = replace(graph, is_keyframe=torch.arange(40) < 30)
    assert frames_of(many).tolist() == list(range(30))


def test_the_largest_submap_is_used(simulated: Make, truth: Camera) -> None:
    graph = simulated(straight(truth), frames=40)
    submaps = replace(graph, submap=(torch.arange(40) >= 10).long())
    assert frames_of(submaps).tolist() == list(range(10, 40))
