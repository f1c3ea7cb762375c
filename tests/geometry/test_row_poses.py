"""Poses at rows, corrected keypoints and velocities: known values, gradients, batches."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from torchslam.geometry import Camera, se3_exp, transform
from torchslam.geometry.rolling_shutter import (
    Readout,
    frame_velocities,
    global_shutter_pixels,
    row_fractions,
    row_poses,
)

CAMERA = Camera.radial_tangential(400.0, 400.0, 319.5, 239.5, -0.1, 0.02, 0.0, 0.0, size=(640, 480))
READOUT = torch.tensor(0.03, dtype=torch.float64)


def keypoints(generator: torch.Generator, *batch: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Pixels of a rolling shutter, poses, velocities and points of N = 6 keypoints."""

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    T_cw, velocities = se3_exp(0.2 * normal(*batch, 6, 6)), 0.5 * normal(*batch, 6, 6)
    points_c = torch.stack((normal(*batch, 6), normal(*batch, 6), 4 + normal(*batch, 6).clamp(-1, 1)), -1)
    points_w = transform(torch.linalg.inv(T_cw), points_c[..., None, :])[..., 0, :]
    pixels = CAMERA.project(points_c)[0]
    for _ in range(8):  # the row decides about the pose, and the pose about the row
        poses = row_poses(T_cw, velocities, row_fractions(pixels, CAMERA.height), READOUT)
        pixels = CAMERA.project(transform(poses, points_w[..., None, :])[..., 0, :])[0]
    return pixels, T_cw, velocities, points_w


def test_rows_are_fractions_of_the_height() -> None:
    pixels = torch.tensor(((3.0, -0.5), (3.0, 239.5), (3.0, 479.5)), dtype=torch.float64)
    assert row_fractions(pixels, 480).tolist() == [-0.5, 0.0, 0.5]


def test_the_camera_moves_from_row_to_row() -> None:
    """One meter a second to the right: half of 20 ms after the middle, the world has moved left by a centimeter."""
    eye, velocity = (
        torch.eye(4, dtype=torch.float64),
        torch.tensor([-1.0, 0, 0, 0, 0, 0], dtype=torch.float64),
    )
    fractions = torch.tensor((-0.5, 0.0, 0.5), dtype=torch.float64)
    poses = row_poses(eye, velocity, fractions, torch.tensor(0.02, dtype=torch.float64))
    torch.testing.assert_close(poses[:, 0, 3], torch.tensor((0.01, 0.0, -0.01), dtype=torch.float64))


def test_corrected_keypoints_are_those_of_the_frame(generator: torch.Generator) -> None:
    pixels, T_cw, velocities, points_w = keypoints(generator)
    expected = CAMERA.project(transform(T_cw, points_w[:, None])[:, 0])[0]
    assert float((pixels - expected).norm(dim=-1).max()) > 1.0
    found = global_shutter_pixels(pixels, T_cw, velocities, points_w, CAMERA, READOUT)
    torch.testing.assert_close(found, expected, rtol=0.0, atol=1e-6)


def test_without_a_readout_or_a_motion_nothing_changes(generator: torch.Generator) -> None:
    pixels, T_cw, velocities, points_w = keypoints(generator)
    for still, readout in ((velocities, torch.zeros_like(READOUT)), (torch.zeros_like(velocities), READOUT)):
        found = global_shutter_pixels(pixels, T_cw, still, points_w, CAMERA, readout)
        torch.testing.assert_close(found, pixels, rtol=0.0, atol=1e-9)


def test_points_behind_the_camera_stay_without_gradient(generator: torch.Generator) -> None:
    pixels, T_cw, velocities, points_w = keypoints(generator)
    behind = transform(torch.linalg.inv(T_cw[:1]), torch.tensor([[[0.1, 0.1, -2.0]]], dtype=torch.float64))
    points_w = torch.cat((behind[:, 0], points_w[1:])).requires_grad_()
    found = global_shutter_pixels(pixels, T_cw, velocities, points_w, CAMERA, READOUT)
    assert torch.equal(found[0], pixels[0])
    (gradient,) = torch.autograd.grad(found.sum(), points_w)
    assert not gradient[0].any()
    assert bool(gradient[1:].isfinite().all())


def test_gradients(generator: torch.Generator) -> None:
    pixels, T_cw, velocities, points_w = keypoints(generator)
    inputs = (pixels, 0.01 * torch.ones_like(velocities), velocities, points_w, CAMERA.params, READOUT)

    def corrected(
        pixels: Tensor, xi: Tensor, velocities: Tensor, points_w: Tensor, params: Tensor, readout: Tensor
    ) -> Tensor:
        camera = CAMERA.with_params(params)
        return global_shutter_pixels(pixels, se3_exp(xi) @ T_cw, velocities, points_w, camera, readout)

    assert torch.autograd.gradcheck(corrected, [each.clone().requires_grad_() for each in inputs])


def test_a_batch_equals_a_loop(generator: torch.Generator) -> None:
    pixels, T_cw, velocities, points_w = keypoints(generator, 3)
    together = global_shutter_pixels(pixels, T_cw, velocities, points_w, CAMERA, READOUT)
    alone = [
        global_shutter_pixels(*each, CAMERA, READOUT)
        for each in zip(pixels, T_cw, velocities, points_w, strict=True)
    ]
    torch.testing.assert_close(together, torch.stack(alone), rtol=0.0, atol=1e-10)


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
