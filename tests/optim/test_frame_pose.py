"""The lean pose of one frame, against `solve_pose`, which takes the long way."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from torchslam.geometry import KeypointNoise, UndistortedKeypoints, se3_exp, se3_inverse, se3_log
from torchslam.optim.frame_pose import MIN_AGREEING, SCALE, FrameProblem, nearby_pose


def problem_of(scene, noise: KeypointNoise | None = None) -> FrameProblem:
    pixels = scene.pixels[0]
    noise = noise or KeypointNoise.of(torch.ones_like(pixels[:, 0]), None)
    undistorted = UndistortedKeypoints.of(pixels, scene.camera)
    return FrameProblem(scene.points_w[0], undistorted.xy, undistorted.whitened(noise))


def apart(T_cw: Tensor, other: Tensor) -> Tensor:
    return se3_log(T_cw @ se3_inverse(other))


@pytest.mark.parametrize("kernel", ["cauchy", "huber"])
def test_it_reaches_the_pose_of_solve_pose(pose_scene, kernel, model):
    far = 0.2 if model == "pinhole" else 0.0  # the first order of a distortion says nothing so far away
    scene = pose_scene(batch=1, count=200, outliers=far, model=model, perturbation=0.01)
    noise = KeypointNoise.of(1 + torch.arange(200).double() % 3, None)
    weights = torch.where(torch.arange(200) % 4 == 0, 0.5, 1.0).double()
    mask = torch.arange(200) % 7 != 0
    wanted = scene.solved(
        weights=(noise.weights * weights)[None], mask=mask[None], kernel=kernel, scale=SCALE
    )
    problem = problem_of(scene, noise)
    found = problem.minimize(problem.linearize(scene.start[0]), weights * mask, kernel)
    assert found.success
    off, sigma = apart(found.T_cw, wanted.T_cw[0]), wanted.covariance[0].diagonal().sqrt()
    assert (off.abs() < 0.05 * sigma).all()
    torch.testing.assert_close(
        found.covariance(), wanted.covariance[0], rtol=0.02, atol=0.02 * float(sigma.square().max())
    )


def test_errors_and_depths_are_evaluated_at_the_pose(pose_scene):
    scene = pose_scene(batch=1, outliers=0.2)
    noise = KeypointNoise.of(torch.full((40,), 2.0).double(), None)
    linearization = problem_of(scene, noise).linearize(scene.T_cw[0])
    points_c = scene.points_w[0] @ scene.T_cw[0, :3, :3].mT + scene.T_cw[0, :3, 3]
    wanted = noise.squared_reprojection(points_c, scene.pixels[0], scene.camera)
    torch.testing.assert_close(linearization.squared, wanted)
    torch.testing.assert_close(linearization.depths, points_c[:, 2])
    assert torch.equal(linearization.T_cw, scene.T_cw[0])


def test_the_jacobian_agrees_with_autograd(pose_scene, model):
    scene = pose_scene(batch=1, model=model)
    problem, step = problem_of(scene), 1e-6
    rows = torch.from_numpy(problem.linearize(scene.T_cw[0]).rows)
    for axis in range(6):
        xi = torch.zeros(6, dtype=torch.float64)
        xi[axis] = step
        ahead, behind = (problem.linearize(se3_exp(sign * xi) @ scene.T_cw[0]).rows[6] for sign in (1, -1))
        slope = torch.from_numpy((ahead - behind) / (2 * step))
        torch.testing.assert_close(slope, rows[axis], rtol=1e-5, atol=1e-3)


def test_points_behind_the_camera_are_outliers_without_gradient(pose_scene):
    scene = pose_scene(batch=1, noise=0.0)
    points_w = scene.points_w.clone()
    points_w[0, :5] = se3_inverse(scene.T_cw[0])[:3, 3] - 0.5 * (
        scene.points_w[0, :5] - se3_inverse(scene.T_cw[0])[:3, 3]
    )
    problem = problem_of(scene._replace(points_w=points_w))
    linearization = problem.linearize(scene.start[0])
    assert (linearization.squared[:5] > 1e12).all()
    found = problem.minimize(linearization, (linearization.squared < 1e12).double(), "cauchy")
    assert apart(found.T_cw, scene.T_cw[0]).norm() < 1e-6


@pytest.mark.parametrize("usable", [0, 2])
def test_too_few_points_leave_the_pose_unchanged(pose_scene, usable):
    scene = pose_scene(batch=1)
    problem = problem_of(scene)
    found = problem.minimize(problem.linearize(scene.start[0]), (torch.arange(40) < usable).double(), "huber")
    assert not found.success
    assert torch.equal(found.T_cw, scene.start[0])
    assert not found.covariance().any()


def test_single_precision_is_kept(pose_scene):
    scene = pose_scene(batch=1)
    single = scene._replace(
        points_w=scene.points_w.float(), pixels=scene.pixels.float(), camera=scene.camera.to(torch.float32)
    )
    problem = problem_of(single)
    found = problem.minimize(problem.linearize(scene.start[0].float()), torch.ones(40), "cauchy")
    assert found.T_cw.dtype == found.covariance().dtype == torch.float32
    exact = problem_of(scene)
    wanted = exact.minimize(exact.linearize(scene.start[0]), torch.ones(40).double(), "cauchy")
    assert apart(found.T_cw.double(), wanted.T_cw).norm() < 1e-4


THRESHOLD = 3.0  # pixels


def found(scene, expected: Tensor) -> Tensor | None:
    undistorted = UndistortedKeypoints.of(scene.pixels[0], scene.camera)
    return nearby_pose(expected, scene.points_w[0], undistorted, THRESHOLD)


def off(T_cw: Tensor | None, scene) -> float:
    assert T_cw is not None
    return float(se3_log(T_cw @ se3_inverse(scene.T_cw[0])).norm())


def test_exact_matches_give_the_exact_pose(pose_scene, model):
    scene = pose_scene(batch=1, count=60, noise=0.0, model=model, perturbation=0.01)
    assert off(found(scene, scene.start[0]), scene) < (1e-7 if model == "pinhole" else 1e-4)


@pytest.mark.parametrize("share", [0.1, 0.2])
def test_outliers_do_not_move_the_pose(pose_scene, share):
    scene = pose_scene(batch=1, count=100, noise=0.0, outliers=share, perturbation=0.01)
    assert off(found(scene, scene.start[0]), scene) < 1e-6


@pytest.mark.parametrize(("wrong", "is_found"), [(24, True), (26, False)])
def test_a_majority_must_agree(pose_scene, wrong, is_found):
    scene = pose_scene(batch=1, count=100)
    assert MIN_AGREEING == 0.75
    scene.pixels[0, :wrong] += 40.0 * torch.linspace(-1, 1, 2 * wrong).view(wrong, 2).sign().double()
    assert (found(scene, scene.T_cw[0]) is not None) is is_found


def test_inliers_are_within_the_threshold(pose_scene):
    scene = pose_scene(batch=1, count=100)
    scene.pixels[0, :30, 0] += THRESHOLD * torch.tensor([1.0, -1.0]).repeat(15) * 0.9
    assert found(scene, scene.T_cw[0]) is not None
    scene.pixels[0, :30, 0] += THRESHOLD * torch.tensor([1.0, -1.0]).repeat(15) * 0.6
    assert found(scene, scene.T_cw[0]) is None


def test_the_pose_is_not_biased_towards_the_prediction(pose_scene):
    """From either side the same pose, though a quarter is wrong."""
    scene = pose_scene(batch=1, count=100, outliers=0.2, noise=0.5)
    step = se3_exp(torch.tensor([0.02, -0.01, 0.02, 0.01, -0.01, 0.0], dtype=torch.float64))
    one, other = found(scene, step @ scene.T_cw[0]), found(scene, se3_inverse(step) @ scene.T_cw[0])
    assert one is not None
    assert other is not None
    torch.testing.assert_close(one, other, rtol=0, atol=2e-5)


def test_points_on_a_line_determine_no_pose(pose_scene):
    scene = pose_scene(batch=1, count=20)
    along = torch.linspace(0, 1, 20, dtype=torch.float64)[:, None]
    points = torch.tensor([-1.0, 0.3, 4.0]).double() + along * torch.tensor([2.0, -0.4, 1.0]).double()
    pixels, _ = scene.camera.project(points)
    undistorted = UndistortedKeypoints.of(pixels, scene.camera)
    eye = torch.eye(4, dtype=torch.float64)
    assert nearby_pose(eye, points, undistorted, THRESHOLD) is None
