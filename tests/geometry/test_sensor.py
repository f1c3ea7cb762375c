"""The sensor model: keypoints as a global shutter would have seen them, and the model that components share."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from torchslam.geometry import Camera, SensorModel, SharedCamera, transform
from torchslam.geometry.rolling_shutter import Readout, global_shutter_pixels, row_fractions, row_poses

CAMERA = Camera.radial_tangential(400.0, 405.0, 319.5, 239.5, -0.1, 0.02, 1e-3, 0.0, size=(640, 480))
ROLLING = SensorModel(CAMERA, Readout.known(0.03, 1e-3))
EYE = torch.eye(4, dtype=torch.float64)


def seen(generator: torch.Generator, frames: int = 3, count: int = 20) -> tuple[Tensor, Tensor, Tensor]:
    """Points of frames, relative to them in the middle of the exposure, velocities, and where their rows see them."""

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    velocities = 0.5 * normal(frames, 6)
    points_c = torch.stack(
        (normal(frames, count), normal(frames, count), 4 + normal(frames, count).clamp(-1, 1)), -1
    )
    readout = ROLLING.readout
    assert readout is not None
    pixels = CAMERA.project(points_c)[0]
    for _ in range(12):  # the row decides about the pose, and the pose about the row
        poses = row_poses(EYE, velocities[:, None], row_fractions(pixels, CAMERA.height), readout.seconds)
        points_row = transform(poses, points_c[..., None, :])[..., 0, :]
        pixels = CAMERA.project(points_row)[0]
    return points_c, velocities, torch.cat((pixels, points_row[..., 2:]), dim=-1)


def test_exact_depths_give_exact_keypoints(generator: torch.Generator) -> None:
    """Depths at the moment at which the row of a keypoint was exposed, as the keypoint itself is from."""
    points_c, velocities, rows = seen(generator)
    expected = CAMERA.project(points_c)[0]
    assert float((rows[..., :2] - expected).norm(dim=-1).max()) > 3.0
    found = ROLLING.at_middle_row(rows[..., :2], velocities, rows[..., 2])
    torch.testing.assert_close(found, expected, rtol=0.0, atol=1e-6)


def test_depths_in_the_middle_of_the_exposure_are_nearly_exact(generator: torch.Generator) -> None:
    """As a map has them: at 0.5 m/s a depth of 4 m changes by less than a hundredth."""
    points_c, velocities, rows = seen(generator)
    expected = CAMERA.project(points_c)[0]
    found = ROLLING.at_middle_row(rows[..., :2], velocities, points_c[..., 2])
    assert float((found - expected).norm(dim=-1).max()) < 0.05 * float(
        (rows[..., :2] - expected).norm(dim=-1).max()
    )


def test_keypoints_are_corrected_as_those_of_a_graph(generator: torch.Generator) -> None:
    """There by the shift of their points, here by their rays: the same for keypoints of these points."""
    points_c, velocities, rows = seen(generator, frames=1)
    readout = ROLLING.readout
    assert readout is not None
    count = points_c.shape[1]
    of_graph = global_shutter_pixels(
        rows[0, :, :2],
        EYE.expand(count, 4, 4),
        velocities.expand(count, 6),
        points_c[0],
        CAMERA,
        readout.seconds,
    )
    found = ROLLING.at_middle_row(rows[..., :2], velocities, rows[..., 2])[0]
    torch.testing.assert_close(found, of_graph, rtol=0.0, atol=1e-6)


def test_a_turning_camera_needs_no_depths(generator: torch.Generator) -> None:
    _, velocities, rows = seen(generator)
    velocities[:, :3] = 0
    near, far = (
        ROLLING.at_middle_row(rows[..., :2], velocities, torch.full_like(rows[..., 2], depth))
        for depth in (0.5, 500.0)
    )
    torch.testing.assert_close(near, far, rtol=0.0, atol=1e-9)
    assert float((near - rows[..., :2]).norm(dim=-1).max()) > 1.0


def test_a_global_shutter_changes_nothing(generator: torch.Generator) -> None:
    _, velocities, rows = seen(generator)
    detected = rows[..., :2]
    assert SensorModel(CAMERA).at_middle_row(detected, velocities, rows[..., 2]) is detected
    for sensor, speeds in (
        (SensorModel(CAMERA, Readout.known(0.0, 1e-3)), velocities),
        (ROLLING, 0 * velocities),
    ):
        found = sensor.at_middle_row(detected, speeds, rows[..., 2])
        torch.testing.assert_close(found, detected, rtol=0.0, atol=1e-6)


def test_the_middle_row_stays() -> None:
    middle = torch.tensor([[[100.0, (CAMERA.height - 1) / 2]]], dtype=torch.float64)
    velocities = torch.tensor([[0.5, 0.2, -0.3, 0.4, 0.1, 1.0]], dtype=torch.float64)
    found = ROLLING.at_middle_row(middle, velocities, torch.full((1, 1), 2.0, dtype=torch.float64))
    torch.testing.assert_close(found, middle, rtol=0.0, atol=1e-6)


def test_a_point_that_would_be_behind_the_camera_stays() -> None:
    """A depth of next to nothing, and a camera that moves on by more."""
    detected = torch.tensor([[[300.0, 470.0], [300.0, 470.0]]], dtype=torch.float64)
    velocities = torch.tensor([[0.0, 0, 10.0, 0, 0, 0]], dtype=torch.float64)
    depths = torch.tensor([[0.01, 5.0]], dtype=torch.float64)
    found = ROLLING.at_middle_row(detected, velocities, depths)
    assert torch.equal(found[0, 0], detected[0, 0])
    assert not torch.equal(found[0, 1], detected[0, 1])


def test_a_batch_equals_a_loop(generator: torch.Generator) -> None:
    _, velocities, rows = seen(generator)
    together = ROLLING.at_middle_row(rows[..., :2], velocities, rows[..., 2])
    alone = [
        ROLLING.at_middle_row(own[None, :, :2], velocity[None], own[None, :, 2])
        for own, velocity in zip(rows, velocities, strict=True)
    ]
    torch.testing.assert_close(together, torch.cat(alone), rtol=0.0, atol=1e-10)
    assert ROLLING.at_middle_row(rows[:0, :, :2], velocities[:0], rows[:0, :, 2]).shape == (
        0,
        rows.shape[1],
        2,
    )


def test_gradients(generator: torch.Generator) -> None:
    _, velocities, rows = seen(generator, frames=1, count=4)

    def corrected(detected: Tensor, velocities: Tensor, depths: Tensor, params: Tensor) -> Tensor:
        return SensorModel(CAMERA.with_params(params), ROLLING.readout).at_middle_row(
            detected, velocities, depths
        )

    inputs = (rows[..., :2], velocities, rows[..., 2], CAMERA.params)
    assert torch.autograd.gradcheck(corrected, [each.clone().requires_grad_() for each in inputs])


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
    speed = 1.0
    velocities = torch.tensor([[-speed, 0, 0, 0, 0, 0]], dtype=torch.float64)
    sensor = SensorModel(Camera.pinhole(400.0, 400.0, 319.5, 239.5, size=(640, 480)), ROLLING.readout)
    found = sensor.at_middle_row(detected, velocities, torch.full((1, 1), 2.0, dtype=torch.float64))
    # Half of the readout later, 0.015 m further.
    assert found[0, 0].tolist() == pytest.approx([320.0 + 400 * 0.015 / 2, 479.5], abs=1e-3)
