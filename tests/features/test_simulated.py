from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from torchslam.features import SimulatedFeatures
from torchslam.geometry import Camera, se3_exp, transform


@pytest.fixture
def camera() -> Camera:
    return Camera.pinhole(500.0, 500.0, 319.5, 239.5, size=(640, 480))


@pytest.fixture
def T_cw() -> Tensor:
    steps = torch.linspace(0, 1, 20, dtype=torch.float64)[:, None]
    return se3_exp(steps * torch.tensor([1.0, 0.2, 0.1, 0.0, 0.3, 0.0], dtype=torch.float64))


def ids_of(simulated: SimulatedFeatures, descriptors: Tensor) -> Tensor:
    """Which point each descriptor belongs to."""
    rows = {bytes(row): index for index, row in enumerate(simulated.descriptors.tolist())}
    assert len(rows) == len(simulated.descriptors)
    return torch.tensor([rows[bytes(row)] for row in descriptors.tolist()])


def test_without_noise_keypoints_are_projections_of_points(camera: Camera, T_cw: Tensor) -> None:
    simulated = SimulatedFeatures(T_cw, camera, num_keypoints=500, points_per_view=200)
    features = simulated(T_cw[7], 7)
    found = features.mask[0]
    assert int(found.sum()) >= 200
    ids = ids_of(simulated, features.descriptors[0][found])
    pixels, valid = camera.project(transform(T_cw[7], simulated.points_w[ids]))
    assert valid.all()
    assert torch.allclose(features.keypoints[0][found], pixels)


def test_every_frame_sees_enough_points(camera: Camera, T_cw: Tensor) -> None:
    simulated = SimulatedFeatures(T_cw, camera, points_per_view=150)
    assert min(int(simulated(pose, i).mask.sum()) for i, pose in enumerate(T_cw)) >= 150


def test_a_frame_does_not_depend_on_the_order_of_requests(camera: Camera, T_cw: Tensor) -> None:
    one = SimulatedFeatures(T_cw, camera, noise_px=0.5, outliers=0.1, dropout=0.1, seed=3)
    other = SimulatedFeatures(T_cw, camera, noise_px=0.5, outliers=0.1, dropout=0.1, seed=3)
    other(T_cw[0], 0)
    assert torch.equal(one(T_cw[5], 5).keypoints, other(T_cw[5], 5).keypoints)


def test_noise_outliers_and_dropout_have_the_configured_rates(camera: Camera, T_cw: Tensor) -> None:
    simulated = SimulatedFeatures(
        T_cw, camera, num_keypoints=2000, points_per_view=1000, noise_px=0.5, outliers=0.1, dropout=0.2
    )
    complete = SimulatedFeatures(T_cw, camera, num_keypoints=2000, points_per_view=1000)
    errors, shares = [], []
    for i, pose in enumerate(T_cw):
        features = simulated(pose, i)
        found = features.mask[0]
        ids = ids_of(simulated, features.descriptors[0][found])
        pixels = camera.project(transform(pose, simulated.points_w[ids]))[0]
        errors.append((features.keypoints[0][found] - pixels).norm(dim=-1))
        shares.append(float(found.sum() / complete(pose, i).mask.sum()))
    error = torch.cat(errors)
    assert 0.08 < float((error > 4).double().mean()) < 0.12
    inlier = error[error < 4]
    assert 0.45 < float((inlier**2).mean() / 2) ** 0.5 < 0.56
    assert 0.77 < sum(shares) / len(shares) < 0.83


def test_points_lie_within_the_depth_range_of_some_view(camera: Camera, T_cw: Tensor) -> None:
    simulated = SimulatedFeatures(T_cw, camera, depth_near=2.0, depth_far=5.0)
    near, far = simulated.depth_range
    depths = torch.stack([transform(pose, simulated.points_w)[:, 2] for pose in T_cw])
    assert (((depths >= near * 0.999) & (depths <= far * 1.001)).any(0)).all()


def test_a_static_camera_sees_points(camera: Camera) -> None:
    still = torch.eye(4, dtype=torch.float64).expand(5, 4, 4)
    assert int(SimulatedFeatures(still, camera)(still[0], 0).mask.sum()) >= 400


SIZED = {"num_keypoints": 1000, "points_per_view": 400, "scales": True}


def test_keypoint_size_follows_from_point_size_and_depth(camera: Camera, T_cw: Tensor) -> None:
    simulated = SimulatedFeatures(T_cw, camera, **SIZED)
    seen = []
    for index, pose in enumerate(T_cw):
        features = simulated(pose, index)
        found = features.mask[0]
        ids = ids_of(simulated, features.descriptors[0][found])
        depth = transform(pose, simulated.points_w[ids])[:, 2]
        scale = features.scales[0][found]
        wanted = simulated.sizes[ids] * 500.0 / depth
        assert ((scale / wanted).log().abs() <= 0.5 * math.log(1.2) + 1e-9).all()
        seen.append(scale)
    levels = torch.cat(seen).log() / math.log(1.2)
    assert torch.allclose(levels, levels.round(), atol=1e-9)
    assert torch.unique(levels.round()).tolist() == list(range(8))


def test_a_point_twice_as_far_is_half_as_large_and_gone_beyond_the_pyramid(camera: Camera) -> None:
    poses = torch.eye(4, dtype=torch.float64).repeat(4, 1, 1)
    simulated = SimulatedFeatures(poses, camera, depth_near=1, depth_far=4, **SIZED)
    simulated.points_w = torch.tensor([[0.0, 0, 2]] * 3, dtype=torch.float64)
    simulated.sizes = torch.tensor([2.0, 1.2**7 * 2.0, 1.2**9 * 2.0], dtype=torch.float64) / 500.0
    simulated.directions_w = simulated.directions_w[:3]
    simulated.strengths, simulated.descriptors = simulated.strengths[:3], simulated.descriptors[:3]

    def sizes(factor: float) -> dict[int, float]:
        pose = poses[0].clone()
        pose[2, 3] = 2.0 * factor - 2.0
        features = simulated(pose, 0)
        found = features.mask[0]
        ids = ids_of(simulated, features.descriptors[0][found])
        return dict(zip(ids.tolist(), features.scales[0][found].tolist(), strict=True))

    assert sizes(1.0) == pytest.approx({0: 1.0, 1: 1.2**7})
    assert sizes(1.2**2) == pytest.approx({1: 1.2**5, 2: 1.2**7})
    assert sizes(1 / 1.2) == pytest.approx({0: 1.2})


def test_noise_grows_with_the_scale(camera: Camera, T_cw: Tensor) -> None:
    simulated = SimulatedFeatures(T_cw, camera, noise_px=0.5, **SIZED)
    normalized, scales = [], []
    for index, pose in enumerate(T_cw):
        features = simulated(pose, index)
        found = features.mask[0]
        ids = ids_of(simulated, features.descriptors[0][found])
        pixels = camera.project(transform(pose, simulated.points_w[ids]))[0]
        scales.append(features.scales[0][found])
        normalized.append((features.keypoints[0][found] - pixels) / scales[-1][:, None])
    error, scale = torch.cat(normalized), torch.cat(scales)
    for part in (error[scale < 1.5], error[scale > 2.5]):
        assert len(part) > 300
        assert 0.46 < float((part**2).mean()) ** 0.5 < 0.54


@pytest.mark.parametrize("degrees", [30.0, -100.0])
def test_angles_turn_with_the_camera(camera: Camera, T_cw: Tensor, degrees: float) -> None:
    simulated = SimulatedFeatures(T_cw, camera, **SIZED)
    roll = se3_exp(torch.tensor([0, 0, 0, 0, 0, math.radians(degrees)], dtype=torch.float64))
    angles = []
    for pose in (T_cw[0], roll @ T_cw[0]):
        features = simulated(pose, 0)
        found = features.mask[0]
        ids = ids_of(simulated, features.descriptors[0][found])
        angles.append(dict(zip(ids.tolist(), features.angles[0][found].tolist(), strict=True)))
    both = angles[0].keys() & angles[1].keys()
    assert len(both) > 100
    for point in both:  # x to y is the way the optical axis turns
        turned = math.remainder(angles[1][point] - angles[0][point] - math.radians(degrees), 2 * math.pi)
        assert turned == pytest.approx(0, abs=1e-9)


def test_without_scales_all_keypoints_are_alike(camera: Camera, T_cw: Tensor) -> None:
    features = SimulatedFeatures(T_cw, camera)(T_cw[3], 3)
    assert (features.scales == 1).all()
    assert (features.angles == 0).all()
