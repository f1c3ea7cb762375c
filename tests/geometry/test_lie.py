import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.autograd import gradcheck

from torchslam import geometry as g
from torchslam.geometry.lie import se3_exp_transform

ANGLES = (0.0, 1e-9, 1e-5, 1e-3, 0.4999, 0.5001, 1.0, 2.0, 3.0, math.pi - 1e-4)


def axis_angle(angle: float, seed: int = 0, count: int = 4) -> Tensor:
    axis = torch.randn(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return angle * axis / axis.norm(dim=-1, keepdim=True)


def tangent(angle: float, size: int, seed: int = 1) -> Tensor:
    xi = torch.randn(4, size, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return torch.cat((xi[:, :3], axis_angle(angle), 0.5 * xi[:, 6:]), dim=-1)


def algebra(xi: Tensor) -> Tensor:
    """The matrix whose matrix exponential is the group element."""
    X = torch.zeros(4, 4, dtype=xi.dtype)
    X[:3, :3] = g.skew(xi[3:6]) + (xi[6] * torch.eye(3, dtype=xi.dtype) if len(xi) == 7 else 0)
    X[:3, 3] = xi[:3]
    return X


@pytest.mark.parametrize("angle", ANGLES)
def test_so3_exp_agrees_with_scipy(angle: float) -> None:
    omega = axis_angle(angle)
    expected = torch.from_numpy(Rotation.from_rotvec(omega.numpy()).as_matrix())
    torch.testing.assert_close(g.so3_exp(omega), expected, atol=1e-14, rtol=0)


@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize(("exp", "log", "size"), [(g.se3_exp, g.se3_log, 6), (g.sim3_exp, g.sim3_log, 7)])
def test_exp_agrees_with_matrix_exponential_and_log_inverts_it(exp, log, size: int, angle: float) -> None:
    xi = tangent(angle, size)
    T = exp(xi)
    for row, matrix in zip(xi, T, strict=True):
        expected = torch.from_numpy(expm(algebra(row).numpy()))
        torch.testing.assert_close(matrix, expected, atol=1e-11, rtol=1e-11)
    torch.testing.assert_close(log(T), xi, atol=1e-9, rtol=0)


@pytest.mark.parametrize("angle", ANGLES)
def test_points_move_under_exp_as_under_its_matrix(angle: float) -> None:
    xi, points = tangent(angle, 6), axis_angle(3.0, seed=5)
    expected = g.transform(g.se3_exp(xi), points[:, None])[:, 0]
    torch.testing.assert_close(se3_exp_transform(xi, points), expected, atol=1e-13, rtol=0)
    assert gradcheck(se3_exp_transform, (xi.requires_grad_(), points.requires_grad_()))


@pytest.mark.parametrize("angle", [*ANGLES, math.pi])
def test_so3_log_stays_within_pi(angle: float) -> None:
    R = g.so3_exp(axis_angle(angle))
    omega = g.so3_log(R)
    assert (omega.norm(dim=-1) <= math.pi + 1e-12).all()
    torch.testing.assert_close(g.so3_exp(omega), R, atol=1e-12, rtol=0)


@pytest.mark.parametrize("angle", ANGLES)
def test_gradients(angle: float) -> None:
    for exp, log, size in ((g.se3_exp, g.se3_log, 6), (g.sim3_exp, g.sim3_log, 7)):
        xi = tangent(angle, size)[:2]
        assert gradcheck(exp, (xi.clone().requires_grad_(),))
        assert gradcheck(lambda x, exp=exp, log=log: log(exp(x)), (xi.clone().requires_grad_(),))
    omega = axis_angle(angle)[:2]
    assert gradcheck(g.so3_left_jacobian, (omega.clone().requires_grad_(),))
    R = g.so3_exp(omega).requires_grad_()
    assert gradcheck(g.so3_log, (R,))
    assert gradcheck(g.quaternion_from_matrix, (R,))
    assert gradcheck(g.matrix_from_quaternion, (torch.randn(2, 4, dtype=torch.float64, requires_grad=True),))


@pytest.mark.parametrize("angle", [0.0, 1e-4, math.pi])
def test_gradients_stay_finite_in_float32(angle: float) -> None:
    T = g.se3_exp(tangent(angle, 6).float()).requires_grad_()
    S = g.sim3_exp(tangent(angle, 7).float()).requires_grad_()
    (g.se3_log(T).sum() + g.sim3_log(S).sum() + g.se3_interpolate(T, T, 0.5).sum()).backward()
    assert torch.isfinite(T.grad).all()
    assert torch.isfinite(S.grad).all()


@pytest.mark.parametrize("angle", [0.0, 0.3, 2.0])
def test_left_jacobian_is_the_derivative_of_exp(angle: float) -> None:
    omega = axis_angle(angle)[0]
    step = 1e-6
    for i, axis in enumerate(torch.eye(3, dtype=torch.float64)):
        moved = g.so3_exp(omega + step * axis) @ g.so3_exp(omega - step * axis).mT
        torch.testing.assert_close(
            g.so3_log(moved) / (2 * step), g.so3_left_jacobian(omega)[:, i], atol=1e-8, rtol=0
        )


def test_adjoints_move_tangents_across() -> None:
    for exp, adjoint, size in ((g.se3_exp, g.se3_adjoint, 6), (g.sim3_exp, g.sim3_adjoint, 7)):
        T, xi = exp(tangent(0.7, size)), tangent(0.2, size, seed=5)
        moved = exp((adjoint(T) @ xi[..., None]).squeeze(-1))
        torch.testing.assert_close(T @ exp(xi), moved @ T)


def test_inverses() -> None:
    eye = torch.eye(4, dtype=torch.float64).expand(4, 4, 4)
    T, S = g.se3_exp(tangent(1.0, 6)), g.sim3_exp(tangent(1.0, 7))
    torch.testing.assert_close(T @ g.se3_inverse(T), eye)
    torch.testing.assert_close(S @ g.sim3_inverse(S), eye)
    torch.testing.assert_close(g.sim3_scale(S), tangent(1.0, 7)[:, 6].exp())


def test_interpolation_has_its_ends_and_is_a_screw_motion() -> None:
    T_0, T_1 = g.se3_exp(tangent(0.5, 6)), g.se3_exp(tangent(1.5, 6, seed=3))
    torch.testing.assert_close(g.se3_interpolate(T_0, T_1, 0.0), T_0)
    torch.testing.assert_close(g.se3_interpolate(T_0, T_1, 1.0), T_1)
    fraction = torch.tensor((0.1, 0.2, 0.5, 0.9), dtype=torch.float64)
    between = g.se3_interpolate(T_0, T_1, fraction)
    inverse = g.se3_interpolate(g.se3_inverse(T_0), g.se3_inverse(T_1), fraction)
    torch.testing.assert_close(inverse, g.se3_inverse(between))


@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: math.hypot(*q) > 1e-3))
@settings(max_examples=50, deadline=None)
def test_quaternions_agree_with_scipy_and_round_trip(q: list[float]) -> None:
    quaternion = torch.tensor(q, dtype=torch.float64)
    R = g.matrix_from_quaternion(quaternion)
    torch.testing.assert_close(R, torch.from_numpy(Rotation.from_quat(q).as_matrix()), atol=1e-12, rtol=0)
    back = g.quaternion_from_matrix(R)
    unit = quaternion / quaternion.norm()
    assert back[3] >= 0
    torch.testing.assert_close(back * torch.sign(back @ unit), unit, atol=1e-12, rtol=0)
