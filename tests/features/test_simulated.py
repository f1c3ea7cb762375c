from __future__ import annotations

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
    same = (descriptors[:, None] == simulated.descriptors[None]).all(-1)
    assert (same.sum(1) == 1).all()
    return same.long().argmax(1)


def test_without_noise_keypoints_are_projections_of_points(camera: Camera, T_cw: Tensor) -> None:
    simulated = SimulatedFeatures(T_cw, camera, num_keypoints=500, points_per_view=200)
    features = simulated(T_cw[7], 7)
    found = features.mask[0]
    assert int(found.sum()) >= 200
    ids = ids_of(simulated, features.descriptors[0][found])
    pixels, valid = camera.project(transform(T_cw[7], simulated.points_w[ids]))
    assert valid.all()
    assert torch.allclose(features.keypoints[0][found], pixels)


def test_every_view_holds_enough_points(camera: Camera, T_cw: Tensor) -> None:
    simulated = SimulatedFeatures(T_cw, camera, points_per_view=150)
    assert min(int(simulated(pose, i).mask.sum()) for i, pose in enumerate(T_cw)) >= 150


def test_a_frame_is_the_same_whenever_it_is_asked_for(camera: Camera, T_cw: Tensor) -> None:
    one = SimulatedFeatures(T_cw, camera, noise_px=0.5, outliers=0.1, dropout=0.1, seed=3)
    other = SimulatedFeatures(T_cw, camera, noise_px=0.5, outliers=0.1, dropout=0.1, seed=3)
    other(T_cw[0], 0)
    assert torch.equal(one(T_cw[5], 5).keypoints, other(T_cw[5], 5).keypoints)


def test_noise_outliers_and_dropout_are_as_asked_for(camera: Camera, T_cw: Tensor) -> None:
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


def test_a_camera_at_rest_sees_points_too(camera: Camera) -> None:
    still = torch.eye(4, dtype=torch.float64).expand(5, 4, 4)
    assert int(SimulatedFeatures(still, camera)(still[0], 0).mask.sum()) >= 400
