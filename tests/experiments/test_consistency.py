"""What explains errors of keyframes: a wrong truth, and nothing where it is right."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from experiments.consistency.run import Keyframes, error_of_truth
from tests.optim.test_camera_evidence import OPTIONS, walk
from torchslam import Trajectory
from torchslam.geometry import se3_inverse
from torchslam.optim import solve_bundle
from torchslam.optim.run_graph import ObservationGraph

FRAMES, EVERY_S = 16, 0.1


def keyframes(noise: float = 0.3) -> Keyframes:
    """A walk at its minimum, and the true path."""
    problem = replace(walk(7, noise, FRAMES), fixed_frames=(0,))
    found = solve_bundle(problem, check=False, options=OPTIONS)
    times = EVERY_S * torch.arange(FRAMES, dtype=torch.float64)
    graph = ObservationGraph(
        times,
        found.T_cw,
        found.points_w,
        problem.frame_index,
        problem.point_index,
        problem.pixels,
        torch.full_like(problem.pixels[:, 0], noise**-2),
        problem.camera,
        torch.ones(FRAMES, dtype=torch.bool),
    )
    return Keyframes.of(graph, None, Trajectory(times, se3_inverse(problem.T_cw)))


def test_nees_is_about_one_where_points_err_by_chance() -> None:
    found = keyframes()
    for covariance in (found.formal(), found.by_points()):
        assert 0.3 < float(found.normalized(covariance).mean()) < 2.5


def test_a_lever_arm_of_the_truth_is_found() -> None:
    found = keyframes(noise=0.01)
    T_wc = se3_inverse(found.T_cw)
    T_wc[:, :3, 3] += T_wc[:, :3, :3] @ torch.tensor((0.3, -0.2, 0.1), dtype=torch.float64)
    wrong = replace(found, T_cw=se3_inverse(T_wc), truth=Trajectory(found.graph.timestamps, T_wc))
    assert wrong.unexplained() < 0.01
    assert float(wrong.normalized(wrong.by_points()).mean()) > 100


def test_errors_of_the_truth_are_measured() -> None:
    found = keyframes(noise=0.01)
    T_wc = se3_inverse(found.T_cw)
    generator = torch.Generator().manual_seed(1)
    T_wc[:, :3, 3] += 0.05 * torch.randn(FRAMES, 3, generator=generator, dtype=torch.float64)
    wrong = replace(found, T_cw=se3_inverse(T_wc))
    assert error_of_truth(wrong, wrong.by_points()) == pytest.approx(0.05, rel=0.3)


def test_halves_are_as_far_apart_as_their_points_say() -> None:
    one, other = keyframes().halves(0)
    together = one.by_points() + other.by_points()
    assert 0.3 < float(one.normalized(together).mean()) < 2.5
