from __future__ import annotations

import math

import pytest
import torch

from torchslam.geometry import Camera, rigid, so3_exp, transform
from torchslam.geometry.conventions import (
    corner_camera,
    corner_pixels,
    opengl,
    quaternion_wxyz,
    upright_rotation,
)


def looking(*rotations: tuple[float, float, float]) -> torch.Tensor:
    R_wc = so3_exp(torch.tensor(rotations, dtype=torch.float64))
    return rigid(R_wc, torch.ones(len(rotations), 3, dtype=torch.float64))


def test_a_camera_in_opengl_axes_sees_along_minus_z_with_y_up() -> None:
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


def test_quaternions_begin_with_their_real_part() -> None:
    quarter = so3_exp(torch.tensor((0.0, 0.0, math.pi / 2), dtype=torch.float64))
    half = math.sqrt(0.5)
    expected = torch.tensor((half, 0.0, 0.0, half), dtype=torch.float64)
    torch.testing.assert_close(quaternion_wxyz(quarter), expected)


def test_a_world_whose_y_points_down_is_stood_upright() -> None:
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


def test_up_along_the_worlds_x() -> None:
    T_wc = torch.tensor([[[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]], dtype=torch.float64)
    expected = torch.tensor(((0, 0, 1), (0, -1, 0), (1, 0, 0)), dtype=torch.float64)
    torch.testing.assert_close(upright_rotation(T_wc), expected)


def test_without_an_up_direction_y_points_down() -> None:
    opposed = looking((0.0, 0.0, 0.0), (0.0, 0.0, math.pi))
    upright = upright_rotation(looking((0.0, 0.0, 0.0)))
    torch.testing.assert_close(upright_rotation(opposed), upright)
    torch.testing.assert_close(upright_rotation(opposed[:0]), upright)
