"""Cameras and poses to kornia and back: the same pixels, the same gradients."""

from __future__ import annotations

import pytest
import torch
from kornia.geometry.liegroup import Se3

from torchslam.geometry import Camera, se3_exp, transform
from torchslam.geometry.transforms import from_kornia_camera, to_kornia_camera


@pytest.fixture
def T_cw() -> torch.Tensor:
    return se3_exp(0.3 * torch.randn(3, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0)))


@pytest.fixture
def camera() -> Camera:
    return Camera.pinhole(500.0, 510.0, 319.5, 239.5, size=(640, 480)).to(torch.float64)


def test_kornia_projects_to_the_same_pixels(camera: Camera, T_cw: torch.Tensor) -> None:
    points_w = torch.rand(3, 7, 3, dtype=torch.float64) + torch.tensor((0.0, 0.0, 4.0), dtype=torch.float64)
    ours = camera.project(transform(T_cw, points_w))[0]
    theirs = to_kornia_camera(camera, T_cw)
    for row in range(7):  # theirs takes one point for each camera
        torch.testing.assert_close(theirs.project(points_w[:, row : row + 1])[:, 0], ours[:, row])


def test_there_and_back(camera: Camera, T_cw: torch.Tensor) -> None:
    found, poses = from_kornia_camera(to_kornia_camera(camera, T_cw))
    torch.testing.assert_close(found.params, camera.params.expand(3, 4))
    assert found.size == camera.size
    torch.testing.assert_close(poses, T_cw)
    torch.testing.assert_close(Se3.from_matrix(T_cw).matrix(), T_cw)


def test_gradients_flow_through(camera: Camera, T_cw: torch.Tensor) -> None:
    params = camera.params.clone().requires_grad_()
    pose = T_cw.clone().requires_grad_()
    found, poses = from_kornia_camera(to_kornia_camera(camera.with_params(params), pose))
    (found.params.sum() + poses.sum()).backward()
    assert params.grad is not None
    assert pose.grad is not None
    torch.testing.assert_close(params.grad, torch.full((4,), 3.0, dtype=torch.float64))
    torch.testing.assert_close(pose.grad, torch.ones_like(pose))


def test_what_does_not_fit_is_refused(camera: Camera, T_cw: torch.Tensor) -> None:
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
