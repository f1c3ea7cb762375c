"""The pose next to a prediction: found where most matches lead there, refused where they do not."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from torchslam.geometry import UndistortedKeypoints, se3_exp, se3_inverse, se3_log
from torchslam.optim.frame_pose import MIN_AGREEING, nearby_pose

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
