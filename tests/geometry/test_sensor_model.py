"""A rolling shutter: poses at rows, keypoints as a global shutter would have seen them, velocities, and the sensor."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from torchslam.geometry import Camera, SensorModel, SharedCamera, se3_exp, se3_inverse, transform
from torchslam.geometry.rolling_shutter import (
    Readout,
    frame_velocities,
    global_shutter_pixels,
    row_fractions,
    row_poses,
)

CAMERA = Camera.radial_tangential(400.0, 405.0, 319.5, 239.5, -0.1, 0.02, 1e-3, 0.0, size=(640, 480))
READOUT = torch.tensor(0.03, dtype=torch.float64)
ROLLING = SensorModel(CAMERA, Readout.known(0.03, 1e-3))
EYE = torch.eye(4, dtype=torch.float64)
KINDS = ["graph", "sensor"]
"""By the shift of the point of a keypoint, as in graphs, and by its ray and depth, as in `SensorModel`."""


def seen(generator: torch.Generator, frames: int = 3, count: int = 12) -> tuple[Tensor, Tensor, Tensor]:
    """Points in the middle of the exposure, velocities, and where rows see them: pixels and depths."""

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    velocities, depths = 0.5 * normal(frames, 6), 4 + normal(frames, count).clamp(-1, 1)
    points_c = torch.stack((normal(frames, count), normal(frames, count), depths), -1)
    pixels = CAMERA.project(points_c)[0]
    for _ in range(12):  # the row decides about the pose, and the pose about the row
        poses = row_poses(EYE, velocities[:, None], row_fractions(pixels, CAMERA.height), READOUT)
        points_row = transform(poses, points_c[..., None, :])[..., 0, :]
        pixels = CAMERA.project(points_row)[0]
    return points_c, velocities, torch.cat((pixels, points_row[..., 2:]), dim=-1)


def corrected(
    kind: str,
    points_c: Tensor,
    velocities: Tensor,
    rows: Tensor,
    readout: Tensor = READOUT,
    camera: Camera = CAMERA,
) -> Tensor:
    if kind == "sensor":
        sensor = SensorModel(camera, Readout(readout, 0.0, 0.0, 0.0))
        return sensor.at_middle_row(rows[..., :2], velocities, rows[..., 2])
    xi = torch.linspace(-0.2, 0.3, 6 * len(points_c), dtype=torch.float64).view(-1, 1, 6)
    T_cw = se3_exp(xi.expand(*points_c.shape[:2], 6))
    points_w = transform(se3_inverse(T_cw), points_c[..., None, :])[..., 0, :]
    speeds = velocities[:, None].expand(*points_c.shape[:2], 6)
    return global_shutter_pixels(rows[..., :2], T_cw, speeds, points_w, camera, readout)


def test_rows_are_fractions_of_the_height() -> None:
    pixels = torch.tensor(((3.0, -0.5), (3.0, 239.5), (3.0, 479.5)), dtype=torch.float64)
    assert row_fractions(pixels, 480).tolist() == [-0.5, 0.0, 0.5]


def test_the_camera_moves_from_row_to_row() -> None:
    """One meter a second to the right: half of 20 ms after the middle, the world has moved left by a centimeter."""
    velocity = torch.tensor([-1.0, 0, 0, 0, 0, 0], dtype=torch.float64)
    fractions = torch.tensor((-0.5, 0.0, 0.5), dtype=torch.float64)
    poses = row_poses(EYE, velocity, fractions, torch.tensor(0.02, dtype=torch.float64))
    torch.testing.assert_close(poses[:, 0, 3], torch.tensor((0.01, 0.0, -0.01), dtype=torch.float64))


@pytest.mark.parametrize("kind", KINDS)
def test_corrected_keypoints_are_those_of_the_middle_row(kind: str, generator: torch.Generator) -> None:
    points_c, velocities, rows = seen(generator)
    expected = CAMERA.project(points_c)[0]
    assert float((rows[..., :2] - expected).norm(dim=-1).max()) > 1.0
    found = corrected(kind, points_c, velocities, rows)
    torch.testing.assert_close(found, expected, rtol=0.0, atol=1e-6)
    alone = [corrected("sensor", *(x[k : k + 1] for x in (points_c, velocities, rows))) for k in range(3)]
    torch.testing.assert_close(torch.cat(alone), found, rtol=0.0, atol=1e-6)
    assert corrected(kind, points_c[:0], velocities[:0], rows[:0]).shape == (0, 12, 2)


def test_depths_in_the_middle_of_the_exposure_are_nearly_exact(generator: torch.Generator) -> None:
    """As a map has them: at 0.5 m/s a depth of 4 m changes by less than a hundredth."""
    points_c, velocities, rows = seen(generator)
    expected = CAMERA.project(points_c)[0]
    found = ROLLING.at_middle_row(rows[..., :2], velocities, points_c[..., 2])
    worst, before = ((x - expected).norm(dim=-1).max() for x in (found, rows[..., :2]))
    assert float(worst) < 0.05 * float(before)


def test_a_turning_camera_needs_no_depths(generator: torch.Generator) -> None:
    _, velocities, rows = seen(generator)
    velocities[:, :3] = 0
    near, far = (
        ROLLING.at_middle_row(rows[..., :2], velocities, torch.full_like(rows[..., 2], depth))
        for depth in (0.5, 500.0)
    )
    torch.testing.assert_close(near, far, rtol=0.0, atol=1e-9)
    assert float((near - rows[..., :2]).norm(dim=-1).max()) > 1.0


@pytest.mark.parametrize("kind", KINDS)
def test_without_a_readout_or_a_motion_nothing_changes(kind: str, generator: torch.Generator) -> None:
    points_c, velocities, rows = seen(generator)
    for still, readout in ((velocities, torch.zeros_like(READOUT)), (torch.zeros_like(velocities), READOUT)):
        found = corrected(kind, points_c, still, rows, readout)
        torch.testing.assert_close(found, rows[..., :2], rtol=0.0, atol=1e-6)
    detected = rows[..., :2]
    assert SensorModel(CAMERA).at_middle_row(detected, velocities, rows[..., 2]) is detected
    middle = torch.tensor([[[100.0, (CAMERA.height - 1) / 2]]], dtype=torch.float64)
    found = ROLLING.at_middle_row(middle, velocities[:1], torch.full((1, 1), 2.0, dtype=torch.float64))
    torch.testing.assert_close(found, middle, rtol=0.0, atol=1e-6)


def test_a_point_that_would_be_behind_the_camera_stays(generator: torch.Generator) -> None:
    """A depth of next to nothing, and a camera that moves on by more; or a point that is there, without gradient."""
    detected = torch.tensor([[[300.0, 470.0], [300.0, 470.0]]], dtype=torch.float64)
    velocities = torch.tensor([[0.0, 0, 10.0, 0, 0, 0]], dtype=torch.float64)
    found = ROLLING.at_middle_row(detected, velocities, torch.tensor([[0.01, 5.0]], dtype=torch.float64))
    assert torch.equal(found[0, 0], detected[0, 0])
    assert not torch.equal(found[0, 1], detected[0, 1])
    points_c, velocities, rows = seen(generator)
    points_c[0, 0] = torch.tensor([0.1, 0.1, -2.0])
    found = corrected("graph", points_c.requires_grad_(), velocities, rows)
    assert torch.equal(found[0, 0], rows[0, 0, :2])
    (gradient,) = torch.autograd.grad(found.sum(), points_c)
    assert not gradient[0, 0].any()
    assert bool(gradient.isfinite().all())


@pytest.mark.parametrize("kind", KINDS)
def test_gradients(kind: str, generator: torch.Generator) -> None:
    inputs = (*seen(generator, frames=1, count=4), READOUT, CAMERA.params)

    def function(*inputs: Tensor) -> Tensor:
        return corrected(kind, *inputs[:4], CAMERA.with_params(inputs[4]))

    assert torch.autograd.gradcheck(function, [each.clone().requires_grad_() for each in inputs])


def test_components_share_the_model_that_is_used_last() -> None:
    """The undistortion follows the camera."""
    shared = SharedCamera(CAMERA)
    assert shared.model == SensorModel(CAMERA)
    shared.use(ROLLING)
    assert shared.model is ROLLING
    other = CAMERA.with_params(1.1 * CAMERA.params)
    undistortion = shared.undistortion
    shared.use(SensorModel(other, ROLLING.readout))
    assert shared.current is shared.model.camera is other
    assert shared.undistortion is not undistortion
    assert shared.undistortion.camera is other
    assert SharedCamera(CAMERA, ROLLING.readout).model.readout is ROLLING.readout


def test_the_velocity_is_that_of_the_pose_from_world_to_camera() -> None:
    """A camera that moves right sees points move left: a row below the middle has moved them already."""
    detected = torch.tensor([[[320.0, 479.5]]], dtype=torch.float64)
    velocities = torch.tensor([[-1.0, 0, 0, 0, 0, 0]], dtype=torch.float64)
    sensor = SensorModel(Camera.pinhole(400.0, 400.0, 319.5, 239.5, size=(640, 480)), ROLLING.readout)
    found = sensor.at_middle_row(detected, velocities, torch.full((1, 1), 2.0, dtype=torch.float64))
    # Half of the readout later, 0.015 m further.
    assert found[0, 0].tolist() == pytest.approx([320.0 + 400 * 0.015 / 2, 479.5], abs=1e-3)


TWIST = torch.tensor([0.01, -0.02, 0.03, 0.004, 0.005, -0.006], dtype=torch.float64)


def test_velocities_are_those_of_a_constant_motion_without_gaps() -> None:
    order = torch.randperm(20, generator=torch.Generator().manual_seed(1))
    times = torch.arange(20, dtype=torch.float64) / 25
    times[12:] += 0.1  # frames are missing
    T_cw = se3_exp(torch.arange(20)[:, None] * TWIST)
    velocities, is_central = frame_velocities(T_cw[order], times[order])
    expected = torch.ones(20, dtype=torch.bool)
    expected[[0, 11, 12, 19]] = False
    assert torch.equal(is_central, expected[order])
    torch.testing.assert_close(velocities, 25 * TWIST.expand(20, 6))


def test_velocities_of_some_frames_are_those_of_all() -> None:
    times = torch.arange(20, dtype=torch.float64) / 25
    T_cw = se3_exp(torch.arange(20)[:, None] ** 1.5 * TWIST)
    every, is_central = frame_velocities(T_cw, times)
    rows = torch.tensor([0, 7, 19])
    some, same = frame_velocities(T_cw, times, frames=rows)
    torch.testing.assert_close(some[rows], every[rows], rtol=0.0, atol=1e-14)
    assert int(some.any(-1).sum()) == 3
    assert torch.equal(same, is_central)


def test_a_frame_between_two_gaps_has_no_velocity() -> None:
    times = torch.tensor([0.0, 0.04, 0.08, 0.3, 0.6, 0.64], dtype=torch.float64)
    velocities, is_central = frame_velocities(se3_exp(torch.arange(6)[:, None] * TWIST), times)
    assert not velocities[3].any()
    assert velocities[[0, 1, 2, 4, 5]].any(-1).all()
    assert is_central.tolist() == [False, True, False, False, False, False]


def test_frames_of_other_recordings_are_no_neighbors() -> None:
    times = torch.arange(6, dtype=torch.float64).repeat_interleave(2) / 25
    recordings = torch.tensor([0, 1]).repeat(6)
    steps = torch.where(recordings == 0, 1.0, -1.0) * torch.arange(6).repeat_interleave(2)
    velocities, is_central = frame_velocities(se3_exp(steps[:, None] * TWIST), times, recordings)
    signs = torch.where(recordings == 0, 25.0, -25.0)[:, None]
    torch.testing.assert_close(velocities, (signs * TWIST).to(velocities))
    assert int(is_central.sum()) == 8
    assert not frame_velocities(se3_exp(steps[:2, None] * TWIST), times[:2])[0].any()  # at one time


def test_gradients_of_velocities() -> None:
    times = torch.tensor([0.0, 0.04, 0.08, 0.12, 0.5], dtype=torch.float64)
    T_cw = se3_exp(torch.arange(5)[:, None] * TWIST)
    xi = (0.1 * torch.ones(5, 6, dtype=torch.float64)).requires_grad_()
    assert torch.autograd.gradcheck(lambda xi: frame_velocities(se3_exp(xi) @ T_cw, times)[0], xi)


def test_a_readout_is_a_mean_of_prior_and_evidence() -> None:
    found = Readout.known(0.0, 0.03).updated(0.02, 0.03)
    assert float(found.seconds) == pytest.approx(0.01)
    assert found.std == pytest.approx(0.03 / 2**0.5)
    assert (found.prior, found.prior_std) == (0.0, 0.03)
    assert found.updated(0.0, float("inf")) == found
    assert found.description() == "10.0 ± 21.2 ms"
