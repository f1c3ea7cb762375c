"""A pose from matches of which many are wrong."""

from __future__ import annotations

import pytest
import torch

from tests.geometry.geometry_scenes import CAMERA, points_and_pixels, rotation_error
from torchslam.geometry import (
    Camera,
    UndistortedKeypoints,
    estimate_absolute_pose,
    se3_inverse,
    se3_log,
    start_pose,
)

DISTORTED = Camera.radial_tangential(
    458.0, 457.0, 367.0, 248.0, -0.28, 0.07, 2e-4, 2e-5, size=(752, 480)
)  # as of machine_hall
FISHEYE = Camera.fisheye(300.0, 305.0, 320.0, 240.0, 0.02, -0.01, 0.003, -0.001, size=(640, 480))


@pytest.mark.parametrize("camera", [CAMERA, DISTORTED], ids=["pinhole", "distorted"])
@pytest.mark.parametrize("outliers", [0.0, 0.4, 0.75])
def test_it_is_near_the_truth_however_many_are_wrong(camera: Camera, outliers: float) -> None:
    for seed in range(5):
        points_w, pixels, truth = points_and_pixels(seed, 200, outliers, 0.5, camera)
        undistorted = UndistortedKeypoints.of(pixels[0], camera)
        T_cw = start_pose(points_w[0], undistorted, camera.size, 3.0, seed)
        assert T_cw is not None
        assert rotation_error(T_cw[:3, :3], truth[0, :3, :3]) < 0.5
        assert (se3_inverse(T_cw)[:3, 3] - se3_inverse(truth[0])[:3, 3]).norm() < 0.05
        torch.testing.assert_close(T_cw[:3, :3] @ T_cw[:3, :3].mT, torch.eye(3).double(), atol=1e-9, rtol=0)
        again = start_pose(points_w[0], undistorted, camera.size, 3.0, seed)
        assert again is not None
        assert torch.equal(T_cw, again)


def test_it_explains_as_much_as_the_long_way() -> None:
    counts = []
    for seed in range(5):
        points_w, pixels, _ = points_and_pixels(seed, 150, 0.5)
        wanted = estimate_absolute_pose(points_w, pixels, CAMERA, 3.0)
        T_cw = start_pose(points_w[0], UndistortedKeypoints.of(pixels[0], CAMERA), CAMERA.size, 3.0)
        assert T_cw is not None
        projected, valid = CAMERA.project(points_w[0] @ T_cw[:3, :3].mT + T_cw[:3, 3])
        agrees = ((projected - pixels[0]).norm(dim=1) < 3.0) & valid
        counts.append(int(agrees.sum()) / int(wanted.inliers.sum()))
    assert min(counts) > 0.97


@pytest.mark.parametrize("camera", [DISTORTED, FISHEYE], ids=["distorted", "fisheye"])
def test_it_is_exact_on_exact_data_and_a_start_on_noisy_ones(camera: Camera) -> None:
    """With noise near the pose of least error, but not it: the error is that of undistorted coordinates."""
    apart = []
    for noise in (0.0, 1.0):
        points_w, pixels, truth = points_and_pixels(0, 150, 0.2, noise, camera)
        T_cw = start_pose(points_w[0], UndistortedKeypoints.of(pixels[0], camera), camera.size, 2.0)
        assert T_cw is not None
        best = estimate_absolute_pose(points_w, pixels, camera).T_cw[0] if noise else truth[0]
        apart.append(float(se3_log(T_cw @ se3_inverse(best)).norm()))
    assert apart[0] < 1e-8
    assert 1e-6 < apart[1] < 0.01


def test_wrong_matches_alone_give_no_pose() -> None:
    points_w, pixels, _ = points_and_pixels(0, 100, 1.0)
    assert start_pose(points_w[0], UndistortedKeypoints.of(pixels[0], CAMERA), CAMERA.size, 3.0) is None


@pytest.mark.parametrize("count", [0, 3])
def test_too_few_matches_give_no_pose(count: int) -> None:
    points_w, pixels, _ = points_and_pixels(0, 10, 0.0)
    undistorted = UndistortedKeypoints.of(pixels[0, :count], CAMERA)
    assert start_pose(points_w[0, :count], undistorted, CAMERA.size, 3.0) is None


def test_points_on_a_line_give_no_pose() -> None:
    along = torch.linspace(-1, 1, 60, dtype=torch.float64)[:, None]
    points_w = torch.tensor([[0.0, 0.0, 4.0]]).double() + along * torch.tensor([[1.0, 0.2, 0.3]]).double()
    pixels = CAMERA.project(points_w)[0]
    assert start_pose(points_w, UndistortedKeypoints.of(pixels, CAMERA), CAMERA.size, 3.0) is None
