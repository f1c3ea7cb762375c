"""Changes of rigid transforms: distances, corrections, conventions of other programs."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kornia.geometry.liegroup import Se3
from torch import Tensor
from torch.autograd import gradcheck

from torchslam.geometry import (
    Camera,
    rigid,
    se3_exp,
    se3_inverse,
    sim3_exp,
    sim3_inverse,
    sim3_scale,
    so3_exp,
    so3_log,
    transform,
)
from torchslam.geometry.transforms import (
    carry_points,
    corner_camera,
    corner_pixels,
    covariances_with_unit,
    from_kornia_camera,
    opengl,
    pose_distance,
    quaternion_wxyz,
    reorthonormalized,
    rotation_angle,
    to_kornia_camera,
    upright_rotation,
    with_unit,
    without_scale,
)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 1.0, math.pi / 2, 3.0, math.pi - 1e-6, math.pi])
def test_the_angle_of_a_rotation(angle: float) -> None:
    axis = torch.tensor([2.0, -1.0, 2.0], dtype=torch.float64) / 3
    assert float(rotation_angle(so3_exp(angle * axis))) == pytest.approx(angle, abs=1e-7, rel=1e-7)


@given(st.lists(st.floats(-1.7, 1.7), min_size=6, max_size=6))
def test_the_angle_is_the_norm_of_the_logarithm(values: list[float]) -> None:
    R = so3_exp(torch.tensor(values, dtype=torch.float64).view(2, 3))
    torch.testing.assert_close(rotation_angle(R), so3_log(R).norm(dim=-1), rtol=1e-6, atol=1e-7)


def test_the_distance_between_cameras() -> None:
    T_kw = se3_exp(torch.tensor([[0.3, -0.1, 0.5, 0.1, 0.2, -0.3]], dtype=torch.float64))
    away = torch.eye(4, dtype=torch.float64)
    away[:3, :3] = so3_exp(torch.tensor([0.0, 0.2, 0.0], dtype=torch.float64))
    away[:3, 3] = torch.tensor([0.0, 0.3, 0.4])
    translation, rotation = pose_distance(away @ T_kw[0], T_kw, 2.0)
    assert translation.tolist() == pytest.approx([0.25])
    assert rotation.tolist() == pytest.approx([math.degrees(0.2)])


def test_a_nearly_orthonormal_matrix_is_projected_to_a_rotation() -> None:
    xi = torch.linspace(-1, 1, 12, dtype=torch.float64).view(2, 6)
    T = se3_exp(xi)
    bent = T.clone()
    bent[:, :3, :3] += 1e-6 * torch.linspace(-1, 1, 18, dtype=torch.float64).view(2, 3, 3)
    R = reorthonormalized(bent)[:, :3, :3]
    torch.testing.assert_close(R @ R.mT, torch.eye(3).double().expand(2, 3, 3), rtol=0, atol=1e-11)
    torch.testing.assert_close(R, T[:, :3, :3], rtol=0, atol=2e-6)
    torch.testing.assert_close(reorthonormalized(T), T, rtol=0, atol=1e-15)


def test_repeated_prediction_stays_a_rotation() -> None:
    """Without it the error grows by 2.4 from frame to frame: 1e-16 is 1e-3 after 34 of them."""
    step = se3_exp(torch.tensor([0.1, 0, 0, 0.01, 0.02, 0.03], dtype=torch.float64))
    last = torch.eye(4, dtype=torch.float64)
    last[0, 0] += 1e-15
    now = step @ last
    for _ in range(60):
        last, now = now, reorthonormalized(now @ se3_inverse(last) @ now)
    R = now[:3, :3]
    torch.testing.assert_close(R @ R.mT, torch.eye(3).double(), rtol=0, atol=1e-14)


def problem(count: int = 5) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Points (n, 3), covariances, unit normals, poses T_cw (n, 4, 4) and similarities S_cw near them."""
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    A = normal(count, 3, 3)
    T_cw = se3_exp(0.5 * normal(count, 6))
    normals_w = torch.nn.functional.normalize(normal(count, 3), dim=-1)
    return normal(count, 3), A @ A.mT, normals_w, T_cw, sim3_exp(0.3 * normal(count, 7)) @ T_cw


def test_a_correction_has_the_known_value() -> None:
    """The camera goes from the origin to x = 10, turns by half a turn about y, and its unit is doubled."""
    T_cw = torch.eye(4, dtype=torch.float64)
    R = so3_exp(torch.tensor([0.0, torch.pi, 0.0], dtype=torch.float64))
    S_cw = sim3_inverse(torch.block_diag(2 * R.mT, torch.ones(1, 1, dtype=torch.float64)))
    S_cw = S_cw @ rigid(torch.eye(3, dtype=torch.float64), torch.tensor([-10.0, 0.0, 0.0]).double())
    point, normal = torch.tensor([1.0, 2.0, 3.0]).double(), torch.tensor([0.0, 0.0, -1.0]).double()
    covariance = torch.diag(torch.tensor([1.0, 2.0, 3.0])).double()
    moved, spread, direction = carry_points(point, covariance, normal, T_cw, S_cw)
    torch.testing.assert_close(moved, torch.tensor([8.0, 4.0, -6.0]).double())
    torch.testing.assert_close(spread, 4 * covariance)
    torch.testing.assert_close(direction, -normal)
    torch.testing.assert_close(
        without_scale(S_cw), se3_inverse(rigid(R.mT, torch.tensor([10.0, 0, 0]).double()))
    )


def test_transferred_points_project_as_before_in_the_new_scale() -> None:
    points_w, covariances_w, normals_w, T_cw, S_cw = problem()
    moved_w, spread_w, turned_w = carry_points(points_w, covariances_w, normals_w, T_cw, S_cw)
    scale, new = sim3_scale(S_cw), without_scale(S_cw)
    before, after = (transform(T, p[:, None])[:, 0] for T, p in ((T_cw, points_w), (new, moved_w)))
    torch.testing.assert_close(after * scale[:, None], before)
    R, R_new = T_cw[:, :3, :3], new[:, :3, :3]
    torch.testing.assert_close(
        R_new @ spread_w @ R_new.mT * scale[:, None, None] ** 2, R @ covariances_w @ R.mT
    )
    torch.testing.assert_close(R_new @ turned_w[..., None], R @ normals_w[..., None])
    torch.testing.assert_close(turned_w.norm(dim=-1), torch.ones(5, dtype=torch.float64))


def test_the_pose_of_a_similarity_is_rigid_and_keeps_the_center() -> None:
    S_cw = problem()[4]
    T_cw = without_scale(S_cw)
    gram = T_cw[:, :3, :3] @ T_cw[:, :3, :3].mT
    torch.testing.assert_close(gram, torch.eye(3, dtype=torch.float64).expand(5, 3, 3))
    torch.testing.assert_close(se3_inverse(T_cw)[:, :3, 3], sim3_inverse(S_cw)[:, :3, 3])


def test_poses_are_rescaled_to_another_unit_of_length() -> None:
    _, _, _, T, _ = problem()
    unit = torch.tensor([2.0, 1.0, 0.5, 4.0, 8.0], dtype=torch.float64)
    shorter = with_unit(T, unit)
    torch.testing.assert_close(shorter[:, :3, 3] * unit[:, None], T[:, :3, 3])
    assert torch.equal(shorter[:, :3, :3], T[:, :3, :3])
    covariances = torch.ones(5, 6, 6, dtype=torch.float64)
    rescaled = covariances_with_unit(covariances, unit)
    torch.testing.assert_close(rescaled[0, 0], torch.tensor([1, 1, 1, 2, 2, 2]).double() / 4)
    torch.testing.assert_close(rescaled[0, 5], torch.tensor([1, 1, 1, 2, 2, 2]).double() / 2)
    assert torch.equal(rescaled[1], covariances[1])


def test_gradients_and_batches() -> None:
    inputs = [tensor.requires_grad_() for tensor in problem(2)]
    assert gradcheck(carry_points, inputs)
    unit = torch.tensor([2.0, 0.5], dtype=torch.float64, requires_grad=True)
    assert gradcheck(with_unit, (inputs[3], unit))
    assert gradcheck(without_scale, (inputs[4],))
    assert gradcheck(covariances_with_unit, (torch.ones(2, 6, 6, dtype=torch.float64), unit))
    whole = carry_points(*problem())
    for row in range(5):
        for one, all_of_them in zip(carry_points(*(x[row] for x in problem())), whole, strict=True):
            torch.testing.assert_close(one, all_of_them[row])


def test_device_and_dtype_are_those_of_the_input(device: torch.device, dtype: torch.dtype) -> None:
    moved = carry_points(*(tensor.to(device, dtype) for tensor in problem()))
    for one, expected in zip(moved, carry_points(*problem()), strict=True):
        assert one.dtype == dtype
        torch.testing.assert_close(one.cpu().double(), expected, atol=1e-4, rtol=1e-4)


def looking(*rotations: tuple[float, float, float]) -> torch.Tensor:
    R_wc = so3_exp(torch.tensor(rotations, dtype=torch.float64))
    return rigid(R_wc, torch.ones(len(rotations), 3, dtype=torch.float64))


def test_opengl_cameras_look_along_minus_z_with_y_up() -> None:
    T_wc = looking((0.3, -0.2, 0.1))
    point_c = torch.tensor([[0.2, 0.4, 3.0]], dtype=torch.float64)
    in_opengl = torch.tensor([[0.2, -0.4, -3.0]], dtype=torch.float64)
    torch.testing.assert_close(transform(opengl(T_wc), in_opengl[None]), transform(T_wc, point_c[None]))
    assert torch.linalg.det(opengl(T_wc)[:, :3, :3]).item() == pytest.approx(1.0)


def test_pixels_and_camera_move_by_half_a_pixel_together(generator: torch.Generator) -> None:
    camera = Camera.radial_tangential(100.0, 90.0, 79.5, 59.5, -0.1, 0.01, 0.001, 0.002, size=(160, 120))
    points_c = torch.rand(9, 3, generator=generator, dtype=torch.float64) + torch.tensor((-0.5, -0.5, 2.0))
    moved, here = corner_camera(camera).project(points_c)[0], camera.project(points_c)[0]
    torch.testing.assert_close(moved, corner_pixels(here))
    torch.testing.assert_close(moved - here, torch.full_like(here, 0.5))
    assert camera.cx == 79.5


def test_quaternions_are_wxyz() -> None:
    quarter = so3_exp(torch.tensor((0.0, 0.0, math.pi / 2), dtype=torch.float64))
    half = math.sqrt(0.5)
    expected = torch.tensor((half, 0.0, 0.0, half), dtype=torch.float64)
    torch.testing.assert_close(quaternion_wxyz(quarter), expected)


def test_a_map_with_y_down_is_rotated_upright() -> None:
    R = upright_rotation(looking((0.0, 0.5, 0.0), (0.0, -0.4, 0.0)))
    expected = torch.tensor(((1, 0, 0), (0, 0, 1), (0, -1, 0)), dtype=torch.float64)
    torch.testing.assert_close(R, expected)


@pytest.mark.parametrize(
    "tilt", [(1.2, 0.3, 0.0), (-2.9, 0.0, 0.4), (0.0, 0.0, math.pi / 2), (0.0, 0.0, -1.5)]
)
def test_the_mean_up_direction_becomes_z(tilt: tuple[float, float, float]) -> None:
    T_wc = looking(tilt, (tilt[0] + 0.2, tilt[1], tilt[2] + 0.1))
    R = upright_rotation(T_wc)
    up = -R @ T_wc[:, :3, 1].mean(dim=0)
    torch.testing.assert_close(up / up.norm(), torch.tensor((0.0, 0.0, 1.0), dtype=torch.float64))
    torch.testing.assert_close(R @ R.mT, torch.eye(3, dtype=torch.float64))
    assert torch.linalg.det(R).item() == pytest.approx(1.0)


def test_an_up_direction_along_x_is_handled() -> None:
    T_wc = torch.tensor([[[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]], dtype=torch.float64)
    expected = torch.tensor(((0, 0, 1), (0, -1, 0), (1, 0, 0)), dtype=torch.float64)
    torch.testing.assert_close(upright_rotation(T_wc), expected)


def test_without_an_up_direction_y_points_down() -> None:
    opposed = looking((0.0, 0.0, 0.0), (0.0, 0.0, math.pi))
    upright = upright_rotation(looking((0.0, 0.0, 0.0)))
    torch.testing.assert_close(upright_rotation(opposed), upright)
    torch.testing.assert_close(upright_rotation(opposed[:0]), upright)


@pytest.fixture
def T_cw() -> Tensor:
    return se3_exp(0.3 * torch.randn(3, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0)))


@pytest.fixture
def camera() -> Camera:
    return Camera.pinhole(500.0, 510.0, 319.5, 239.5, size=(640, 480)).to(torch.float64)


def test_kornia_projects_to_the_same_pixels(camera: Camera, T_cw: Tensor) -> None:
    points_w = torch.rand(3, 7, 3, dtype=torch.float64) + torch.tensor((0.0, 0.0, 4.0), dtype=torch.float64)
    ours = camera.project(transform(T_cw, points_w))[0]
    theirs = to_kornia_camera(camera, T_cw)
    for row in range(7):  # theirs takes one point for each camera
        torch.testing.assert_close(theirs.project(points_w[:, row : row + 1])[:, 0], ours[:, row])


def test_cameras_of_kornia_there_and_back(camera: Camera, T_cw: Tensor) -> None:
    found, poses = from_kornia_camera(to_kornia_camera(camera, T_cw))
    torch.testing.assert_close(found.params, camera.params.expand(3, 4))
    assert found.size == camera.size
    torch.testing.assert_close(poses, T_cw)
    torch.testing.assert_close(Se3.from_matrix(T_cw).matrix(), T_cw)


def test_gradients_flow_through_cameras_of_kornia(camera: Camera, T_cw: Tensor) -> None:
    params = camera.params.clone().requires_grad_()
    pose = T_cw.clone().requires_grad_()
    found, poses = from_kornia_camera(to_kornia_camera(camera.with_params(params), pose))
    (found.params.sum() + poses.sum()).backward()
    assert params.grad is not None
    assert pose.grad is not None
    torch.testing.assert_close(params.grad, torch.full((4,), 3.0, dtype=torch.float64))
    torch.testing.assert_close(pose.grad, torch.ones_like(pose))


def test_cameras_that_kornia_cannot_have_are_refused(camera: Camera, T_cw: Tensor) -> None:
    bent = Camera.radial_tangential(500.0, 500.0, 319.5, 239.5, 0.1, 0.0, 0.0, 0.0, size=(640, 480))
    with pytest.raises(ValueError, match="no distortion"):
        to_kornia_camera(bent, T_cw)
    theirs = to_kornia_camera(camera, T_cw)
    theirs.intrinsics[1, 0, 1] = 2.0
    with pytest.raises(ValueError, match="skew"):
        from_kornia_camera(theirs)
    theirs = to_kornia_camera(camera, T_cw)
    theirs.width[0] = 320
    with pytest.raises(ValueError, match="different sizes"):
        from_kornia_camera(theirs)
