"""Absolute poses from matches of which many are wrong."""

from __future__ import annotations

import numpy as np
import poselib
import pytest
import torch

from tests.geometry.geometry_scenes import CAMERA, FISHEYE, RADIAL, points_and_pixels, rotation_error
from torchslam.geometry import (
    Camera,
    UndistortedKeypoints,
    estimate_absolute_pose,
    se3_exp,
    se3_inverse,
    se3_log,
    so3_log,
    start_pose,
    transform,
)


@pytest.mark.parametrize("camera", [CAMERA, RADIAL, FISHEYE], ids=["pinhole", "radial_tangential", "fisheye"])
@pytest.mark.parametrize("outliers", [0.0, 0.3, 0.6])
def test_finds_the_pose_among_wrong_pairs(camera: Camera, outliers: float) -> None:
    for seed in range(5):
        points_w, pixels, T_cw = points_and_pixels(seed, outliers=outliers, camera=camera)
        result = estimate_absolute_pose(points_w, pixels, camera=camera)
        assert result.success.all()
        assert rotation_error(result.T_cw[:, :3, :3], T_cw[:, :3, :3]) < 0.2
        assert float((result.T_cw - T_cw)[:, :3, 3].norm()) < 0.03
        right = torch.arange(150) >= int(outliers * 150)
        assert float((result.inliers[0] == right).double().mean()) > 0.97


def test_the_pose_is_as_accurate_as_that_of_poselib() -> None:
    ours, theirs = [], []
    model = {"model": "PINHOLE", "width": 640, "height": 480, "params": CAMERA.params.tolist()}
    for seed in range(12):
        points_w, pixels, T_cw = points_and_pixels(seed, count=200, outliers=0.4, noise=1.0)
        result = estimate_absolute_pose(points_w, pixels, camera=CAMERA)
        pose, _ = poselib.estimate_absolute_pose(
            pixels[0].numpy(), points_w[0].numpy(), model, {"max_reproj_error": 2.0}, {}
        )
        ours.append(rotation_error(result.T_cw[:, :3, :3], T_cw[:, :3, :3]))
        theirs.append(rotation_error(torch.from_numpy(pose.R)[None], T_cw[:, :3, :3]))
    assert np.mean(ours) <= 1.1 * np.mean(theirs)


def test_exact_data_give_the_exact_pose() -> None:
    for camera in (CAMERA, RADIAL):
        points_w, pixels, T_cw = points_and_pixels(0, outliers=0.2, noise=0.0, camera=camera)
        torch.testing.assert_close(
            estimate_absolute_pose(points_w, pixels, camera=camera).T_cw, T_cw, atol=1e-8, rtol=0
        )


def test_a_batch_holds_independent_problems() -> None:
    """Good, far from the origin, masked, with NaN rows, too few, on a line, pure noise, all behind."""
    points_w, pixels, T_cw = (x.repeat(8, *(x.dim() - 1) * (1,)) for x in points_and_pixels(3))
    mask = torch.ones(8, 150, dtype=torch.bool)
    points_w[1] += 300.0
    mask[2, 20:60] = False
    points_w[2, 20:60], pixels[2, 30:50] = 1e12, torch.inf
    points_w[3, ::7], pixels[3, 1::7] = torch.nan, torch.inf
    mask[4, 3:] = False
    points_w[5] = points_w[5, :1] + torch.linspace(0, 1, 150)[:, None].double() * torch.tensor(
        (1.0, 0.5, 2.0)
    )
    pixels[5] = CAMERA.project(transform(T_cw[5], points_w[5]))[0]
    pixels[6] = torch.rand(150, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 480
    mask[7] = False
    result = estimate_absolute_pose(points_w, pixels, camera=CAMERA, mask=mask)
    assert result.success.tolist() == [True, True, True, True, False, False, False, False]
    assert torch.isfinite(result.T_cw).all()
    assert torch.isfinite(result.score).all()
    assert not result.inliers[~result.success].any()
    assert not (result.inliers & ~mask).any()
    assert rotation_error(result.T_cw[:4, :3, :3], T_cw[:4, :3, :3]) < 0.2
    torch.testing.assert_close(result.T_cw[~result.success], torch.eye(4).double().expand(4, 4, 4))


def test_planar_points() -> None:
    points_w, _, T_cw = points_and_pixels(5)
    points_w = points_w * torch.tensor((1.0, 1.0, 0.0))
    T_cw = se3_exp(torch.tensor(((0.2, -0.1, 6.0, 0.3, -0.2, 0.5),), dtype=torch.float64))
    pixels, valid = CAMERA.project(transform(T_cw, points_w))
    result = estimate_absolute_pose(points_w, pixels, camera=CAMERA, mask=valid)
    assert result.success.all()
    torch.testing.assert_close(result.T_cw, T_cw, atol=1e-7, rtol=0)


DISTORTED = Camera.radial_tangential(
    458.0, 457.0, 367.0, 248.0, -0.28, 0.07, 2e-4, 2e-5, size=(752, 480)
)  # as of machine_hall


@pytest.mark.parametrize("camera", [CAMERA, DISTORTED], ids=["pinhole", "distorted"])
@pytest.mark.parametrize("outliers", [0.0, 0.4, 0.75])
def test_the_start_pose_is_near_the_truth_for_any_outlier_ratio(camera: Camera, outliers: float) -> None:
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


def test_the_start_pose_has_as_many_inliers_as_the_full_estimator() -> None:
    counts = []
    for seed in range(5):
        points_w, pixels, _ = points_and_pixels(seed, 150, 0.5)
        wanted = estimate_absolute_pose(points_w, pixels, camera=CAMERA, threshold=3.0)
        T_cw = start_pose(points_w[0], UndistortedKeypoints.of(pixels[0], CAMERA), CAMERA.size, 3.0)
        assert T_cw is not None
        projected, valid = CAMERA.project(points_w[0] @ T_cw[:3, :3].mT + T_cw[:3, 3])
        agrees = ((projected - pixels[0]).norm(dim=1) < 3.0) & valid
        counts.append(int(agrees.sum()) / int(wanted.inliers.sum()))
    assert min(counts) > 0.97


@pytest.mark.parametrize("camera", [DISTORTED, FISHEYE], ids=["distorted", "fisheye"])
def test_the_start_pose_is_exact_on_exact_data(camera: Camera) -> None:
    """With noise near the pose of least error, but not it: the error is that of undistorted coordinates."""
    apart = []
    for noise in (0.0, 1.0):
        points_w, pixels, truth = points_and_pixels(0, 150, 0.2, noise, camera)
        T_cw = start_pose(points_w[0], UndistortedKeypoints.of(pixels[0], camera), camera.size, 2.0)
        assert T_cw is not None
        best = estimate_absolute_pose(points_w, pixels, camera=camera).T_cw[0] if noise else truth[0]
        apart.append(float(se3_log(T_cw @ se3_inverse(best)).norm()))
    assert apart[0] < 1e-8
    assert 1e-6 < apart[1] < 0.01


def test_outliers_alone_give_no_pose() -> None:
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


@pytest.mark.parametrize(("distinct", "success"), [(3, False), (4, True), (5, True)])
@pytest.mark.parametrize(("noise", "jitter"), [(0.0, 0.0), (0.5, 0.0), (0.5, 1e-4)])
def test_points_that_repeat_count_once(distinct: int, success: bool, noise: float, jitter: float) -> None:
    """Three points have up to four poses, however often each is seen."""
    generator = torch.Generator().manual_seed(1)
    points_w, _, T_cw = points_and_pixels(2, outliers=0.0)
    points_w = points_w[:, :distinct].repeat(1, 20, 1)
    points_w = points_w + jitter * torch.randn(points_w.shape, generator=generator, dtype=torch.float64)
    pixels = CAMERA.project(transform(T_cw, points_w))[0]
    pixels = pixels + noise * torch.randn(pixels.shape, generator=generator, dtype=torch.float64)
    found = estimate_absolute_pose(points_w, pixels, camera=CAMERA)
    assert bool(found.success) == success
    assert not success or rotation_error(found.T_cw[:, :3, :3], T_cw[:, :3, :3]) < 1


@pytest.mark.parametrize(("flat", "least"), [(False, 0.85), (True, 0.7)], ids=["apart", "on a plane"])
def test_six_noisy_matches_give_a_right_pose_or_none(flat: bool, least: float) -> None:
    """Of 1000 planes, 13 had wrong poses when significant inliers sufficed."""
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(300, 6, 2, generator=generator, dtype=torch.float64)
    size = torch.tensor(CAMERA.size, dtype=torch.float64)
    rays = CAMERA.unproject(torch.rand(300, 6, 2, generator=generator, dtype=torch.float64) * size)
    depth = 1.5 + 6 * torch.rand(300, 6, 1, generator=generator, dtype=torch.float64)
    if flat:
        normal = torch.rand(300, 1, 3, generator=generator, dtype=torch.float64) - torch.tensor(
            [0.5, 0.5, -0.5]
        )
        depth = 4 * normal[..., 2:] / (rays * normal).sum(-1, keepdim=True)
    points_c = rays * torch.where(depth > 0, depth, torch.nan)
    found = estimate_absolute_pose(points_c, CAMERA.project(points_c)[0] + noise, camera=CAMERA)
    turned = torch.linalg.vector_norm(so3_log(found.T_cw[:, :3, :3]), dim=-1)
    assert float(found.success.double().mean()) > least
    assert float(torch.rad2deg(turned[found.success]).max()) < 5


@pytest.mark.parametrize("count", [0, 2, 40])
def test_rows_that_fail_share_no_memory(count: int) -> None:
    generator = torch.Generator().manual_seed(0)
    points_w, pixels = (300 * torch.rand(3, count, d, generator=generator) for d in (3, 2))
    found = estimate_absolute_pose(points_w, pixels, camera=CAMERA)
    assert not found.success.any()
    for rows in (found.T_cw, found.inliers, found.success, found.score):
        before = rows[1:].clone()
        rows[0] = 1
        assert torch.equal(rows[1:], before)
