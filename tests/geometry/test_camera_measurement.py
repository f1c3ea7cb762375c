"""Cameras with an error: what they say, what an adjustment makes of them, which two may be the same."""

from __future__ import annotations

import pytest
import torch

from torchslam.geometry import Camera
from torchslam.geometry.camera_measurement import CameraMeasurement, may_be_same, with_radial_terms

PINHOLE = Camera.pinhole(500.0, 510.0, 320.0, 240.0, size=(640, 480))


def test_a_given_camera_may_be_wrong_in_focal_length_and_radial_distortion() -> None:
    given = CameraMeasurement.of(PINHOLE, 0.02)
    assert given.camera.model == "radial_tangential"
    std = given.directions.norm(dim=-1)
    expected = torch.tensor([10.0, 10.2, 0, 0, 0.02, 0.02, 0, 0, 0], dtype=torch.float64)
    torch.testing.assert_close(std, expected)
    assert given.focal_std == pytest.approx(0.02)
    assert given.radial_std == pytest.approx((0.02, 0.02))


def test_the_information_is_the_inverse_along_the_directions() -> None:
    given = CameraMeasurement.of(PINHOLE, 0.02)
    step = given.directions @ torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
    assert float(step @ given.information @ step) == pytest.approx(1 + 4 + 0.25)


def test_another_error_has_the_covariance_that_was_found() -> None:
    given = CameraMeasurement.of(PINHOLE, 0.02)
    shrunk = torch.diag(torch.tensor([0.01, 0.04, 0.09], dtype=torch.float64))
    moved = given.camera.with_params(given.camera.params * 1.01)
    found = given.with_error(moved, shrunk)
    assert found.camera is moved
    assert found.focal_std == pytest.approx(0.02 / 1.01 * 0.1)
    assert found.radial_std == pytest.approx((0.02 * 0.2, 0.02 * 0.3))
    assert found.observation_variance == given.observation_variance


def test_a_camera_that_is_held_has_no_error() -> None:
    given = CameraMeasurement.of(PINHOLE, 0.02)
    held = CameraMeasurement(given.camera, given.directions[:, :0])
    assert (held.focal_std, held.radial_std) == (0.0, (0.0, 0.0))
    assert not held.information.any()


@pytest.mark.parametrize(
    ("factor", "shift", "std", "expected"),
    [
        (1.0, 0.0, 0.0, True),
        (1.01, 0.0, 0.0, False),
        (1.05, 0.0, 0.02, True),
        (1.11, 0.0, 0.02, False),
        (1.0, 0.01, 0.02, False),  # the principal point is never adjusted
    ],
)
def test_a_found_camera_may_be_the_given_one(factor: float, shift: float, std: float, expected: bool) -> None:
    fx, fy, cx, cy = PINHOLE.params.tolist()
    found = Camera.pinhole(factor * fx, factor * fy, cx + shift, cy, size=PINHOLE.size)
    assert may_be_same(with_radial_terms(found), PINHOLE, std) is expected


def test_a_fisheye_is_not_a_pinhole() -> None:
    fisheye = Camera.fisheye(500.0, 510.0, 320.0, 240.0, 0.0, 0.0, 0.0, 0.0, size=(640, 480))
    assert not may_be_same(fisheye, PINHOLE, 0.02)
