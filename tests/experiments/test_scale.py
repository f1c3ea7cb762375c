"""The height over the ground: found on a rendered plane, and a drift of scale undone by true heights."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from experiments.learning.scale.ground import COARSE, ground_normals, measure_heights, scaled_by_heights
from experiments.learning.scale.run import (
    MOST,
    SPREAD,
    HandMade,
    is_clear,
    smooth_log_scale,
    with_drift,
    without_scale,
)
from torchslam import Camera, Trajectory, evaluate
from torchslam.geometry import rigid, se3_exp, se3_inverse, so3_exp

CAMERA = Camera.pinhole(120.0, 120.0, 79.5, 49.5, size=(160, 120))
HEIGHT = 0.3


def drive(count: int, step: float) -> Tensor:
    """(K, 4, 4) T_cw of a camera that moves ahead along the ground, in a slight bend; y is down."""
    angle = 0.01 * torch.arange(count, dtype=torch.float64)
    zero = torch.zeros_like(angle)
    steps = step * torch.stack((torch.sin(angle), zero, torch.cos(angle)), -1)
    return se3_inverse(rigid(so3_exp(torch.stack((zero, angle, zero), -1)), steps.cumsum(0)))


def view(T_cw: Tensor) -> Tensor:
    """Image of a textured plane `HEIGHT` below the origin."""
    y, x = torch.meshgrid(torch.arange(120.0), torch.arange(160.0), indexing="ij")
    rays = CAMERA.unproject(torch.stack((x, y), -1).reshape(-1, 2)).double() @ T_cw[:3, :3]
    center = se3_inverse(T_cw)[:3, 3]
    depth = (HEIGHT - center[1]) / rays[:, 1].clamp(min=1e-6)
    at = (center + depth[:, None] * rays)[:, [0, 2]] / HEIGHT
    waves = torch.randn(2, 30, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 5
    gray = 0.5 + 0.05 * torch.cos(at @ waves + torch.arange(30)).sum(-1)
    return torch.where(rays[:, 1] > 0.05, gray, 0.5).reshape(1, 1, 120, 160).float()


def test_the_height_over_a_rendered_plane_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("experiments.learning.scale.ground.COARSE", COARSE[60:80])  # the height is among them
    T_cw = drive(5, 0.3 * HEIGHT)
    assert torch.allclose(ground_normals(T_cw), T_cw.new_tensor([0.0, 1.0, 0.0]), atol=1e-9)
    heights = measure_heights([view(T) for T in T_cw], CAMERA, T_cw)
    clear = is_clear(heights)
    assert clear.double().mean() > MOST
    assert HandMade().information(heights)[clear].min() > SPREAD**-2
    nearest = COARSE[(COARSE - math.log(HEIGHT)).abs().argmin()]
    assert torch.allclose(heights.log_height + nearest, T_cw.new_tensor(math.log(HEIGHT)), atol=0.015)


def test_true_heights_undo_a_drift_of_scale() -> None:
    T_cw = se3_exp(torch.tensor([0, 0, 0, 0.1, 0.2, 0], dtype=torch.float64)) @ drive(30, 0.5)
    drift = 0.01 * torch.arange(30, dtype=torch.float64)
    drifted = with_drift(T_cw, drift)
    truth = Trajectory(torch.arange(30.0).double(), se3_inverse(T_cw))

    def ate(poses: Tensor) -> float:
        return evaluate(Trajectory(truth.timestamps, se3_inverse(poses)), truth).ate_m

    sure, unsure = torch.full_like(drift, 1e6), torch.zeros_like(drift)
    solution = scaled_by_heights(drifted, drift, sure, 0.1)
    assert solution.success
    assert ate(without_scale(solution.S_cw[1:])) < 0.02 * ate(drifted)
    kept = scaled_by_heights(drifted, drift, unsure, 0.1)
    assert torch.allclose(without_scale(kept.S_cw[1:]), drifted, atol=1e-6)


def test_the_true_scale_of_a_drift_is_measured() -> None:
    T_cw = drive(30, 0.5)
    drift = 0.01 * torch.arange(30, dtype=torch.float64)
    found = smooth_log_scale(*(se3_inverse(each)[:, :3, 3] for each in (with_drift(T_cw, drift), T_cw)))
    assert torch.allclose(found[4:-4], -drift[4:-4], atol=0.006)


def test_the_variance_gets_a_gradient_through_the_pose_graph() -> None:
    T_cw, drift = drive(8, 0.5), 0.02 * torch.arange(8, dtype=torch.float64)
    information = torch.full_like(drift, 400.0).requires_grad_()
    edge_std = torch.tensor(0.01, dtype=torch.float64, requires_grad=True)

    def end(information: Tensor, edge_std: Tensor) -> Tensor:
        solution = scaled_by_heights(T_cw, drift, information, edge_std)
        return solution.S_cw[-1]

    assert torch.autograd.gradcheck(end, (information, edge_std), eps=1e-4, atol=1e-5, rtol=1e-3)
