"""Absolute poses from matches of which many are wrong."""

from __future__ import annotations

import numpy as np
import poselib
import pytest
import torch
from torch import Tensor

from tests.geometry.geometry_scenes import CAMERA, direction_error, points_and_pixels, rotation_error
from torchslam.geometry import (
    Camera,
    UndistortedKeypoints,
    estimate_absolute_pose,
    p3p,
    se3_exp,
    se3_inverse,
    se3_log,
    start_pose,
    transform,
)

RADIAL = Camera.radial_tangential(500.0, 520.0, 320.0, 240.0, -0.28, 0.07, 1e-3, -5e-4, 0.01, size=(640, 480))
FISHEYE = Camera.fisheye(300.0, 305.0, 320.0, 240.0, 0.02, -0.01, 0.003, -0.001, size=(640, 480))


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


def test_pure_noise_is_never_a_success() -> None:
    generator = torch.Generator().manual_seed(0)
    points_w = torch.randn(20, 200, 3, generator=generator, dtype=torch.float64)
    pixels = torch.rand(20, 200, 2, generator=generator, dtype=torch.float64) * torch.tensor((640.0, 480.0))
    assert not estimate_absolute_pose(points_w, pixels, camera=CAMERA, max_samples=500).success.any()


def test_same_seed_same_bytes_and_batch_agrees_with_loop() -> None:
    problems = [points_and_pixels(seed) for seed in range(4)]
    points_w, pixels = (torch.cat([problem[i] for problem in problems]) for i in (0, 1))
    batch, again = (estimate_absolute_pose(points_w, pixels, camera=CAMERA, seed=7) for _ in range(2))
    assert torch.equal(batch.T_cw, again.T_cw)
    single = torch.cat([estimate_absolute_pose(*problem[:2], camera=CAMERA).T_cw for problem in problems])
    torch.testing.assert_close(
        batch.T_cw, single, atol=5e-3, rtol=0
    )  # other samples, nearly the same inliers


@pytest.mark.parametrize("camera", [CAMERA, RADIAL], ids=["pinhole", "radial_tangential"])
def test_the_gradient_is_that_of_the_estimate(camera: Camera) -> None:
    """Against central differences of the whole estimator; the set of inliers stays the same."""
    points_w, pixels, _ = points_and_pixels(2, count=40, outliers=0.2, noise=0.3, camera=camera)
    inputs = {"points_w": points_w, "pixels": pixels, "params": camera.params}
    direction = {
        name: torch.randn(x.shape, generator=torch.Generator().manual_seed(1)).double()
        for name, x in inputs.items()
    }

    def estimate(points_w: Tensor, pixels: Tensor, params: Tensor) -> Tensor:
        return estimate_absolute_pose(points_w, pixels, camera=camera.with_params(params), threshold=3.0).T_cw

    leaves = {name: x.clone().requires_grad_() for name, x in inputs.items()}
    T_cw = estimate(**leaves)
    weights = torch.linspace(-1, 1, 12, dtype=torch.float64).view(3, 4)
    (T_cw[0, :3] * weights).sum().backward()
    torch.testing.assert_close(T_cw.detach(), estimate(**inputs))
    for name, x in inputs.items():
        step = 1e-4 * direction[name]
        high, low = (estimate(**{**inputs, name: x + sign * step})[0, :3] for sign in (1, -1))
        expected = ((high - low) * weights).sum() / 2e-4
        torch.testing.assert_close(
            (leaves[name].grad * direction[name]).sum(), expected, rtol=1e-4, atol=1e-9
        )


def test_gradients_are_finite_in_float32_where_there_is_no_pose() -> None:
    points_w, pixels, _ = (x.float().repeat(2, *(x.dim() - 1) * (1,)) for x in points_and_pixels(1))
    points_w[1, 1:] = torch.nan
    points_w, pixels = points_w.requires_grad_(), pixels.requires_grad_()
    result = estimate_absolute_pose(points_w, pixels, camera=CAMERA.to(torch.float32))
    assert result.success.tolist() == [True, False]
    result.T_cw.square().sum().backward()
    assert torch.isfinite(points_w.grad).all()
    assert torch.isfinite(pixels.grad).all()
    assert float(pixels.grad[0].abs().max()) > 0


def test_dtype_and_device(device: torch.device, dtype: torch.dtype) -> None:
    points_w, pixels, T_cw = (x.to(device, dtype) for x in points_and_pixels(4))
    result = estimate_absolute_pose(points_w, pixels, camera=CAMERA.to(device).to(dtype))
    assert (result.T_cw.dtype, result.T_cw.device.type) == (dtype, device.type)
    assert rotation_error(result.T_cw[:, :3, :3].double(), T_cw[:, :3, :3].double()) < 0.2
    assert direction_error(result.T_cw[:, :3, 3], T_cw[:, :3, 3]) < 1
    assert p3p(points_w[:, :3], points_w[:, 3:6])[0].dtype == dtype
    assert float(se3_log(result.T_cw).norm()) > 0


@pytest.mark.usefixtures("without_shape_checks")
def test_wrong_shapes_are_named() -> None:
    with pytest.raises(ValueError, match=r"points_w must be \(B, N, 3\), not \(5, 3\)"):
        estimate_absolute_pose(torch.zeros(5, 3), torch.zeros(5, 2), camera=CAMERA)


def test_an_empty_batch_or_no_points() -> None:
    camera = CAMERA.to(torch.float32)
    assert estimate_absolute_pose(torch.zeros(0, 10, 3), torch.zeros(0, 10, 2), camera=camera).T_cw.shape == (
        0,
        4,
        4,
    )
    assert not estimate_absolute_pose(torch.zeros(2, 0, 3), torch.zeros(2, 0, 2), camera=camera).success.any()


DISTORTED = Camera.radial_tangential(
    458.0, 457.0, 367.0, 248.0, -0.28, 0.07, 2e-4, 2e-5, size=(752, 480)
)  # as of machine_hall
FISHEYE = Camera.fisheye(300.0, 305.0, 320.0, 240.0, 0.02, -0.01, 0.003, -0.001, size=(640, 480))


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


def test_too_few_points_give_a_gradient_of_zero() -> None:
    for count in (0, 2):
        points = torch.rand(2, count, 3, dtype=torch.float64).requires_grad_()
        found = estimate_absolute_pose(points, torch.rand(2, count, 2, dtype=torch.float64), camera=CAMERA)
        (gradient,) = torch.autograd.grad(found.T_cw.sum(), points)
        assert not found.success.any()
        assert not gradient.any()
