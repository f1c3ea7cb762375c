"""How far apart cameras are, the angle of a rotation, and rotations that stay so."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchslam.geometry import se3_exp, se3_inverse, so3_exp, so3_log
from torchslam.geometry.motion import apart, reorthonormalized, rotation_angle


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 1.0, math.pi / 2, 3.0, math.pi - 1e-6, math.pi])
def test_the_angle_of_a_rotation(angle: float) -> None:
    axis = torch.tensor([2.0, -1.0, 2.0], dtype=torch.float64) / 3
    assert float(rotation_angle(so3_exp(angle * axis))) == pytest.approx(angle, abs=1e-7, rel=1e-7)


@given(st.lists(st.floats(-1.7, 1.7), min_size=6, max_size=6))
def test_it_is_the_length_of_the_logarithm(values: list[float]) -> None:
    R = so3_exp(torch.tensor(values, dtype=torch.float64).view(2, 3))
    torch.testing.assert_close(rotation_angle(R), so3_log(R).norm(dim=-1), rtol=1e-6, atol=1e-7)


def test_how_far_cameras_are_apart() -> None:
    T_kw = se3_exp(torch.tensor([[0.3, -0.1, 0.5, 0.1, 0.2, -0.3]], dtype=torch.float64))
    away = torch.eye(4, dtype=torch.float64)
    away[:3, :3] = so3_exp(torch.tensor([0.0, 0.2, 0.0], dtype=torch.float64))
    away[:3, 3] = torch.tensor([0.0, 0.3, 0.4])
    translation, rotation = apart(away @ T_kw[0], T_kw, 2.0)
    assert translation.tolist() == pytest.approx([0.25])
    assert rotation.tolist() == pytest.approx([math.degrees(0.2)])


def test_a_rotation_that_nearly_is_one_becomes_one() -> None:
    xi = torch.linspace(-1, 1, 12, dtype=torch.float64).view(2, 6)
    T = se3_exp(xi)
    bent = T.clone()
    bent[:, :3, :3] += 1e-6 * torch.linspace(-1, 1, 18, dtype=torch.float64).view(2, 3, 3)
    R = reorthonormalized(bent)[:, :3, :3]
    torch.testing.assert_close(R @ R.mT, torch.eye(3).double().expand(2, 3, 3), rtol=0, atol=1e-11)
    torch.testing.assert_close(R, T[:, :3, :3], rtol=0, atol=2e-6)
    torch.testing.assert_close(reorthonormalized(T), T, rtol=0, atol=1e-15)


def test_predicting_from_predictions_stays_a_rotation() -> None:
    """Without it the error grows by 2.4 from frame to frame: 1e-16 is 1e-3 after 34 of them."""
    step = se3_exp(torch.tensor([0.1, 0, 0, 0.01, 0.02, 0.03], dtype=torch.float64))
    last = torch.eye(4, dtype=torch.float64)
    last[0, 0] += 1e-15
    now = step @ last
    for _ in range(60):
        last, now = now, reorthonormalized(now @ se3_inverse(last) @ now)
    R = now[:3, :3]
    torch.testing.assert_close(R @ R.mT, torch.eye(3).double(), rtol=0, atol=1e-14)
