"""Poses by time."""

from __future__ import annotations

import hypothesis.strategies as st
import torch
from hypothesis import given

from torchslam.data.trajectories import interpolate_poses, nearest
from torchslam.geometry.lie import se3_exp
from torchslam.types import Trajectory

TIMES = st.lists(st.floats(-100, 100), min_size=1, max_size=20, unique=True).map(sorted)


@given(TIMES, TIMES)
def test_nearest_equals_brute_force(times: list[float], reference: list[float]) -> None:
    a, b = torch.tensor(times, dtype=torch.float64), torch.tensor(reference, dtype=torch.float64)
    indices, distances = nearest(a, b)
    expected = (a[:, None] - b).abs().min(dim=1).values
    assert torch.equal(distances, expected)
    assert torch.equal((a - b[indices]).abs(), expected)


def _turning(count: int) -> Trajectory:
    """Constant motion: half a meter along x and 0.3 rad about z a second."""
    times = torch.arange(count, dtype=torch.float64)
    xi = times[:, None] * torch.tensor([0.5, 0, 0, 0, 0, 0.3], dtype=torch.float64)
    return Trajectory(times, se3_exp(xi))


def test_constant_motion_is_interpolated_exactly() -> None:
    times = torch.tensor([0.0, 0.25, 1.5, 2.9, 4.0], dtype=torch.float64)
    T_wc, valid = interpolate_poses(_turning(5), times, tolerance=0.5)
    xi = times[:, None] * torch.tensor([0.5, 0, 0, 0, 0, 0.3], dtype=torch.float64)
    assert valid.all()
    torch.testing.assert_close(T_wc, se3_exp(xi), atol=1e-12, rtol=0)


def test_interpolation_at_the_samples_returns_them_exactly() -> None:
    trajectory = _turning(9)
    T_wc, valid = interpolate_poses(trajectory, trajectory.timestamps, tolerance=0.0)
    assert valid.all()
    assert torch.equal(T_wc, trajectory.T_wc)


def test_far_times_are_invalid_and_finite() -> None:
    trajectory = _turning(3)
    times = torch.tensor([-0.01, -1.0, 0.5, 2.01, 99.0], dtype=torch.float64)
    T_wc, valid = interpolate_poses(trajectory, times, tolerance=0.02)
    assert valid.tolist() == [True, False, False, True, False]
    assert T_wc.isfinite().all()
    assert torch.equal(T_wc[-1], trajectory.T_wc[-1])


def test_a_single_pose() -> None:
    T_wc, valid = interpolate_poses(_turning(1), torch.tensor([0.0, 3.0], dtype=torch.float64), tolerance=0.1)
    assert valid.tolist() == [True, False]
    assert T_wc.isfinite().all()
