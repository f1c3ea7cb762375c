from dataclasses import fields, replace

import numpy as np
import poselib
import pytest
import torch
from geometry_scenes import CAMERA, FISHEYE, RADIAL, Scene, direction_error, rotation_error, two_views
from torch import Tensor

from torchslam.geometry import Camera, RelativePose, estimate_relative_pose, rigid


def estimate(scene: Scene, camera: Camera = CAMERA, **options: float) -> RelativePose:
    return estimate_relative_pose(scene.pixels_1, scene.pixels_2, camera_1=camera, camera_2=camera, **options)


@pytest.mark.parametrize("camera", [CAMERA, RADIAL, FISHEYE], ids=["pinhole", "radial_tangential", "fisheye"])
@pytest.mark.parametrize("outliers", [0.0, 0.3, 0.5])
def test_finds_the_pose_among_wrong_matches(camera: Camera, outliers: float) -> None:
    for seed in range(4):
        scene = two_views(seed, outliers=outliers, camera=camera)
        result = estimate(scene, camera)
        assert result.success.all()
        assert result.model == ("essential",)
        assert rotation_error(result.T_21[:, :3, :3], scene.T_21[:, :3, :3]) < 1
        assert direction_error(result.T_21[:, :3, 3], scene.T_21[:, :3, 3]) < 5
        torch.testing.assert_close(result.T_21[:, :3, 3].norm(dim=-1), torch.ones(1, dtype=torch.float64))
        assert float((result.inliers == scene.mask).double().mean()) > 0.9
        assert float(result.score_essential) > max(
            float(result.score_homography), float(result.score_rotation)
        )


@pytest.mark.parametrize(
    ("count", "outliers", "noise", "threshold", "part", "ratio"),
    [(400, 0.4, 1.0, 1.0, "rotation", 1.1), (60, 0.5, 0.5, 2.0, "direction", 1.2)],
)
def test_the_pose_is_as_accurate_as_that_of_poselib(
    count: int, outliers: float, noise: float, threshold: float, part: str, ratio: float
) -> None:
    """Of many matches the rotation, and of few, half of which are wrong, the direction."""
    ours, theirs = [], []
    model = {"model": "PINHOLE", "width": 640, "height": 480, "params": CAMERA.params.tolist()}
    for seed in range(10):
        scene = two_views(seed, count=count, outliers=outliers, noise=noise)
        pixels = scene.pixels_1[0].numpy(), scene.pixels_2[0].numpy()
        pose, _ = poselib.estimate_relative_pose(*pixels, model, model, {"max_epipolar_error": threshold}, {})
        found = estimate(scene, threshold=threshold, model="auto" if part == "rotation" else "essential").T_21
        other = rigid(torch.from_numpy(pose.R), torch.from_numpy(pose.t))[None]
        for errors, T_21 in ((ours, found), (theirs, other)):
            if part == "rotation":
                errors.append(rotation_error(T_21[:, :3, :3], scene.T_21[:, :3, :3]))
            else:
                errors.append(direction_error(T_21[:, :3, 3], scene.T_21[:, :3, 3]))
    assert np.mean(ours) <= ratio * np.mean(theirs)


def test_exact_data_give_the_exact_pose() -> None:
    for camera in (CAMERA, RADIAL):
        scene = two_views(0, noise=0.0, outliers=0.2, camera=camera)
        T_21 = estimate(scene, camera).T_21
        torch.testing.assert_close(T_21[:, :3, :3], scene.T_21[:, :3, :3], atol=1e-7, rtol=0)
        assert direction_error(T_21[:, :3, 3], scene.T_21[:, :3, 3]) < 1e-4


@pytest.mark.parametrize(("seed", "baseline"), [(90, 0.35), (116, 0.35), (1, 0.1), (20, 0.1)])
def test_the_rotation_is_orthonormal_even_if_its_sample_was_inaccurate(seed: int, baseline: float) -> None:
    scene = two_views(seed, baseline=baseline)
    found = estimate(scene)
    for T_21 in (found.T_21, found.T_21_essential):
        R = T_21[0, :3, :3]
        torch.testing.assert_close(R.mT @ R, torch.eye(3, dtype=R.dtype), atol=1e-9, rtol=0)
        assert torch.linalg.det(R) > 0
    assert rotation_error(found.T_21[:, :3, :3], scene.T_21[:, :3, :3]) < 1


@pytest.mark.parametrize("noise", [0.3, 1.0])
def test_a_plane_is_classified_and_its_pose_is_correct_or_ambiguous(noise: float) -> None:
    successes = 0
    for seed in range(10):
        scene = two_views(seed, plane=True, noise=noise)
        result = estimate(scene)
        assert result.model == ("homography",)
        assert result.success.item() != result.ambiguous.item()
        if result.success.item():
            successes += 1
            assert rotation_error(result.T_21[:, :3, :3], scene.T_21[:, :3, :3]) < 2
            assert direction_error(result.T_21[:, :3, 3], scene.T_21[:, :3, 3]) < 12
    assert successes >= 3


@pytest.mark.parametrize("noise", [0.0, 0.3, 1.0, 2.0])
def test_a_pure_rotation_gets_no_translation(noise: float) -> None:
    for seed in range(5):
        scene = two_views(seed, baseline=0.0, noise=noise)
        result = estimate(scene)
        assert result.model == ("rotation",)
        assert not result.success.any()
        assert (result.T_21[:, :3, 3] == 0).all()
        assert rotation_error(result.T_21[:, :3, :3], scene.T_21[:, :3, :3]) < 0.5


def test_a_plane_with_some_points_off_it_is_no_plane() -> None:
    plane, rest = two_views(3, plane=True, count=160, outliers=0.2), two_views(3, count=60, outliers=0.0)
    scene = Scene(
        torch.cat((plane.pixels_1, rest.pixels_1), dim=1),
        torch.cat((plane.pixels_2, rest.pixels_2), dim=1),
        plane.points_1,
        plane.T_21,
        plane.mask,
    )
    result = estimate(scene)
    assert result.model == ("essential",)
    assert direction_error(result.T_21[:, :3, 3], scene.T_21[:, :3, 3]) < 8


def test_a_batch_holds_independent_problems() -> None:
    """Good, masked, with NaN rows, few but exact, too few, nothing, pure noise, all the same match, on a line."""
    scene = two_views(1, noise=0.2)
    pixels_1, pixels_2 = (x.repeat(9, 1, 1) for x in (scene.pixels_1, scene.pixels_2))
    mask = torch.ones(9, 200, dtype=torch.bool)
    mask[1, 80:120] = False
    pixels_1[1, 80:120], pixels_2[1, 100:120] = 1e9, torch.nan
    pixels_1[2, ::9], pixels_2[2, 1::9] = torch.nan, torch.inf
    mask[3, :60], mask[3, 85:] = False, False
    mask[4, :60], mask[4, 64:] = False, False
    mask[5] = False
    pixels_2[6] = torch.rand(200, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 480
    pixels_1[7], pixels_2[7] = 100.0, 120.0
    pixels_1[8, :, 1], pixels_2[8, :, 1] = 200.0, 210.0
    result = estimate_relative_pose(pixels_1, pixels_2, camera_1=CAMERA, camera_2=CAMERA, mask=mask)
    assert result.success.tolist() == [True, True, True, True, False, False, False, False, False]
    assert all(
        torch.isfinite(x).all() for x in (result.T_21, result.score_essential, result.score_homography)
    )
    assert not (result.inliers & ~mask).any()
    assert rotation_error(result.T_21[:3, :3, :3], scene.T_21[:, :3, :3]) < 1
    assert direction_error(result.T_21[:3, :3, 3], scene.T_21[:, :3, 3]) < 4


def gradients(scene: Scene) -> tuple[RelativePose, Tensor]:
    """The relative pose, and the gradient of all its numbers to the pixels of the first view."""
    pixels = scene.pixels_1.clone().requires_grad_()
    found = estimate_relative_pose(pixels, scene.pixels_2, camera_1=CAMERA, camera_2=CAMERA)
    (gradient,) = torch.autograd.grad((found.T_21 * torch.arange(16.0).double().view(4, 4)).sum(), pixels)
    return found, gradient


def test_failures_are_as_the_page_on_gradients_says() -> None:
    """Noise has no pose and no gradient, few matches neither; a rotation is determined but for its direction."""
    size = torch.tensor(CAMERA.size, dtype=torch.float64)
    for count in (4, 5, 80):
        draws = torch.rand(
            2, 3, count, 2, generator=torch.Generator().manual_seed(count), dtype=torch.float64
        )
        noise = replace(two_views(0), pixels_1=draws[0] * size, pixels_2=draws[1] * size)
        found, gradient = gradients(noise)
        assert not found.success.any()
        assert torch.equal(found.T_21, torch.eye(4, dtype=torch.float64).expand(3, 4, 4))
        assert not gradient.any()
    found, gradient = gradients(two_views(0, baseline=0.0))
    assert (found.model, found.success.tolist()) == (("rotation",), [False])
    assert not found.T_21[0, :3, 3].any()
    assert gradient.abs().sum() > 0


@pytest.mark.parametrize(("distinct", "success"), [(5, False), (10, True)])
@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_matches_that_repeat_count_once(distinct: int, success: bool, noise: float) -> None:
    """Five matches have up to ten poses, however often each is seen."""
    generator = torch.Generator().manual_seed(0)
    scene = two_views(1, count=distinct, outliers=0.0, noise=0.0)
    pixels = (x.repeat(1, 12, 1) for x in (scene.pixels_1, scene.pixels_2))
    pixels_1, pixels_2 = (
        x + noise * torch.randn(x.shape, generator=generator, dtype=torch.float64) for x in pixels
    )
    found = estimate_relative_pose(pixels_1, pixels_2, camera_1=CAMERA, camera_2=CAMERA)
    assert bool(found.success) == success


def test_results_of_too_few_matches_share_no_memory() -> None:
    found = estimate_relative_pose(*torch.ones(2, 3, 4, 2), camera_1=CAMERA, camera_2=CAMERA)
    tensors = [getattr(found, field.name) for field in fields(found)]
    before = [tensor[1:].clone() for tensor in tensors]
    for tensor in tensors:
        tensor[0] = 1
    assert all(torch.equal(tensor[1:], rows) for tensor, rows in zip(tensors, before, strict=True))
    assert not found.score_rotation[1:].any()
