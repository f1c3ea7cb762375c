"""A rotation, a focal length and k1 from the matches of a camera that only turned."""

from __future__ import annotations

import math

import pytest
import torch
from geometry_scenes import many_views, rotation_error
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from torchslam.geometry import Camera, so3_exp
from torchslam.geometry.camera_measurement import with_radial_terms
from torchslam.geometry.rolling_shutter import at_middle_row, row_fractions
from torchslam.geometry.rotating_camera import READOUT_STD, fit_rotating_camera, rotation_between

TRUE = Camera.pinhole(500.0, 500.0, 319.5, 239.5, size=(640, 480))
BENT = Camera.radial_tangential(500.0, 500.0, 319.5, 239.5, -0.15, 0.0, 0.0, 0.0, size=(640, 480))
FISHEYE = Camera.fisheye(300.0, 300.0, 319.5, 239.5, 0.02, -0.01, 0.003, -0.001, size=(640, 480))
GUESS = math.log(3.0) / 3


def turned(
    camera: Camera, omega: tuple[float, float, float], noise: float = 0.0, seed: int = 0
) -> tuple[Tensor, Tensor, Tensor]:
    """Matching pixels (1, N, 2) of a camera that turned by a rotation vector, and the rotation (1, 3, 3)."""
    generator = torch.Generator().manual_seed(seed)
    pixels = torch.rand(600, 2, generator=generator, dtype=torch.float64) * torch.tensor(camera.size)
    R_21 = so3_exp(torch.tensor(omega, dtype=torch.float64))
    seen, valid = camera.project(camera.unproject(pixels) @ R_21.mT)
    rows = valid & camera.in_image(seen)
    pixels_1, pixels_2 = (
        x[rows] + noise * torch.randn(int(rows.sum()), 2, generator=generator, dtype=torch.float64)
        for x in (pixels, seen)
    )
    return pixels_1[None], pixels_2[None], R_21[None]


def scaled(camera: Camera, factor: float) -> Camera:
    return camera.with_params(torch.cat((factor * camera.params[:2], camera.params[2:])))


def everything(pixels: Tensor) -> Tensor:
    return torch.ones_like(pixels[..., 0], dtype=torch.bool)


@settings(deadline=None, max_examples=15)
@given(
    factor=st.floats(1 / 2.5, 2.5),
    axis=st.floats(0, 2 * math.pi),
    angle=st.floats(0.15, 0.5),
    roll=st.floats(-0.3, 0.3),
)
def test_any_rotation_is_found_with_any_guess_of_the_focal_length(
    factor: float, axis: float, angle: float, roll: float
) -> None:
    omega = (angle * math.cos(axis), angle * math.sin(axis), roll)
    pixels_1, pixels_2, R_21 = turned(TRUE, omega, noise=0.3)
    found = fit_rotating_camera(pixels_1, pixels_2, scaled(TRUE, factor), GUESS, 1.5, everything(pixels_1))
    assert float(found.camera.focal) == pytest.approx(500.0, rel=0.05)
    assert rotation_error(found.R_21, R_21) < 1.0
    assert float(found.departure) < 3
    assert float((found.errors_px > 2.12).double().mean()) < 0.02


@pytest.mark.parametrize("camera", [TRUE, BENT, FISHEYE], ids=["pinhole", "radial_tangential", "fisheye"])
def test_exact_matches_give_the_rotation_and_the_camera(camera: Camera) -> None:
    pixels_1, pixels_2, R_21 = turned(camera, (0.1, 0.25, 0.1))
    found = fit_rotating_camera(pixels_1, pixels_2, camera, 0.02, 1.5, everything(pixels_1))
    torch.testing.assert_close(found.R_21, R_21, atol=1e-9, rtol=0)
    torch.testing.assert_close(found.camera.params[0], with_radial_terms(camera).params, atol=1e-5, rtol=1e-7)
    assert float(found.departure) < 1e-5
    assert float(found.errors_px.max()) < 1e-6


def test_distortion_that_is_not_known_of_is_found_too() -> None:
    pixels_1, pixels_2, _ = turned(BENT, (0.1, 0.3, 0.1), noise=0.3)
    found = fit_rotating_camera(pixels_1, pixels_2, scaled(TRUE, 0.7), GUESS, 1.5, everything(pixels_1))
    assert float(found.camera.params[0, 4]) == pytest.approx(-0.15, abs=0.03)
    assert float(found.camera.focal) == pytest.approx(500.0, rel=0.03)


def test_little_is_allowed_of_a_camera_with_a_small_error() -> None:
    pixels_1, pixels_2, _ = turned(TRUE, (0.1, 0.3, 0.1), noise=0.3)
    mask = everything(pixels_1)
    near = fit_rotating_camera(pixels_1, pixels_2, scaled(TRUE, 1.03), 0.02, 1.5, mask)
    far = fit_rotating_camera(pixels_1, pixels_2, scaled(TRUE, 1.3), 0.02, 1.5, mask)
    assert float(near.departure) < 3 < float(far.departure)


def test_no_focal_length_turns_translation_into_rotation() -> None:
    scene = many_views(range(8), outliers=0.0)
    found = fit_rotating_camera(scene.pixels_1, scene.pixels_2, TRUE, GUESS, 1.5, scene.mask)
    assert bool(((found.errors_px > 2.12).double().mean(-1) > 0.2).all())


def test_wrong_matches_weigh_little_and_masked_ones_nothing() -> None:
    pixels_1, pixels_2, R_21 = turned(TRUE, (0.1, 0.25, 0.1))
    used = everything(pixels_1)
    used[:, ::4] = False
    wrong = torch.where(used[..., None], pixels_2, pixels_1.flip(1))
    masked = fit_rotating_camera(pixels_1, wrong, scaled(TRUE, 0.8), GUESS, 1.5, used)
    torch.testing.assert_close(masked.R_21, R_21, atol=1e-4, rtol=0)
    pixels_2[:, ::10] += 40.0
    robust = fit_rotating_camera(pixels_1, pixels_2, scaled(TRUE, 0.8), GUESS, 1.5, everything(pixels_1))
    assert rotation_error(robust.R_21, R_21) < 1.0
    assert float((robust.errors_px < 2.12).double().mean()) == pytest.approx(0.9, abs=0.01)


def test_a_batch_is_the_same_as_each_alone() -> None:
    scene = many_views(range(2), outliers=0.0)
    together = fit_rotating_camera(scene.pixels_1, scene.pixels_2, TRUE, GUESS, 1.5, scene.mask)
    for row in range(2):
        each = many_views([row], outliers=0.0)
        alone = fit_rotating_camera(each.pixels_1, each.pixels_2, TRUE, GUESS, 1.5, each.mask)
        torch.testing.assert_close(together.R_21[row], alone.R_21[0], atol=1e-6, rtol=0)
        torch.testing.assert_close(together.errors_px[row], alone.errors_px[0], atol=1e-3, rtol=1e-3)


def test_it_works_on_the_device_in_the_dtype_and_without_matches(
    device: torch.device, dtype: torch.dtype
) -> None:
    pixels_1, pixels_2, R_21 = (x.to(device, dtype) for x in turned(TRUE, (0.1, 0.25, 0.1), noise=0.3))
    camera = scaled(TRUE, 0.8).to(device, dtype)
    found = fit_rotating_camera(pixels_1, pixels_2, camera, GUESS, 1.5, everything(pixels_1))
    assert found.R_21.dtype == found.errors_px.dtype == dtype
    assert found.R_21.device.type == device.type
    assert rotation_error(found.R_21.double().cpu(), R_21.double().cpu()) < 1.0
    nothing = fit_rotating_camera(pixels_1, pixels_2, camera, GUESS, 1.5, ~everything(pixels_1))
    assert torch.isfinite(nothing.R_21).all()
    torch.testing.assert_close(nothing.camera.params[0, :1], camera.params[:1])


def rolled(pixels: Tensor, camera: Camera, turns: Tensor) -> Tensor:
    """Where a rolling shutter sees what a global one sees at pixels (1, N, 2); turns (1, 3) during the readout."""
    rays, seen = camera.unproject(pixels), pixels
    for _ in range(30):
        R = so3_exp(row_fractions(seen, camera.height)[..., None] * turns[:, None])
        seen = camera.project((R @ rays[..., None])[..., 0])[0]
    return seen


TURNS = torch.tensor([[[0.01, 0.04, -0.02], [-0.02, -0.03, 0.01]]], dtype=torch.float64)
"""Over the interval between two frames, of a camera that turns back between two views."""


def rolled_matches(camera: Camera, readout: float, noise: float) -> tuple[Tensor, Tensor, Tensor]:
    pixels_1, pixels_2, R_21 = turned(camera, (0.05, 0.15, 0.1))
    generator = torch.Generator().manual_seed(1)
    pixels_1, pixels_2 = (
        rolled(x, camera, readout * turn)
        + noise * torch.randn(x.shape, generator=generator, dtype=torch.float64)
        for x, turn in ((pixels_1, TURNS[:, 0]), (pixels_2, TURNS[:, 1]))
    )
    return pixels_1, pixels_2, R_21


@pytest.mark.parametrize("camera", [TRUE, BENT, FISHEYE])
@pytest.mark.parametrize("readout", [0.0, 0.3, 0.9])
def test_a_rolling_shutter_is_found_with_its_readout_time(camera: Camera, readout: float) -> None:
    pixels_1, pixels_2, R_21 = rolled_matches(camera, readout, 0.3)
    found = fit_rotating_camera(pixels_1, pixels_2, camera, 0.02, 1.5, everything(pixels_1), TURNS)
    assert abs(float(found.readout) - readout) < float(found.readout_std) < 0.05
    assert rotation_error(found.R_21, R_21) < 0.1
    assert float(found.errors_px.median()) < 0.6
    assert float(found.departure) < 1.0


def test_without_turns_a_rolling_shutter_is_no_rotation() -> None:
    pixels_1, pixels_2, _ = rolled_matches(TRUE, 0.9, 0.0)
    found = fit_rotating_camera(pixels_1, pixels_2, TRUE, 0.02, 1.5, everything(pixels_1))
    assert float(found.errors_px.median()) > 3.0
    assert (float(found.readout), float(found.readout_std)) == (0.0, READOUT_STD)


def test_at_the_middle_row_matches_are_those_of_a_rotation() -> None:
    pixels_1, pixels_2, R_21 = rolled_matches(BENT, 0.9, 0.0)
    middle_1, middle_2 = (
        at_middle_row(x, BENT, 0.9 * turn) for x, turn in ((pixels_1, TURNS[:, 0]), (pixels_2, TURNS[:, 1]))
    )
    mapped, _ = BENT.project(BENT.unproject(middle_1) @ R_21.mT)
    torch.testing.assert_close(mapped, middle_2, atol=1e-6, rtol=0)


def test_pixels_of_the_middle_row_stay_and_others_move_with_the_turn() -> None:
    pixels = torch.tensor([[[319.5, 239.5], [319.5, 0.0], [319.5, 479.0]]], dtype=torch.float64)
    turn = torch.tensor([[0.0, 0.0, 0.2]], dtype=torch.float64)
    seen = at_middle_row(pixels, TRUE, turn)[0]
    # The middle of the first row is exposed half a turn of 0.2, less half a row, before the middle of the image.
    angle = 0.1 * 479 / 480
    shift = 239.5 * math.sin(angle)
    wanted = [[319.5, 239.5], [319.5 + shift, 239.5 - 239.5 * math.cos(angle)]]
    wanted.append([319.5 + shift, 239.5 + 239.5 * math.cos(angle)])
    torch.testing.assert_close(seen, torch.tensor(wanted, dtype=torch.float64), atol=1e-9, rtol=0)


def test_wrong_matches_do_not_change_the_rotation_between_two_frames() -> None:
    pixels_1, pixels_2, R_21 = turned(TRUE, (0.02, 0.06, -0.03), noise=0.3)
    wrong = pixels_2.clone()
    wrong[:, ::3] = wrong[:, ::3].flip(1)
    assert rotation_error(rotation_between(pixels_1, wrong, TRUE, 1.5), R_21) < 0.05
    both = rotation_between(pixels_1.repeat(2, 1, 1), torch.cat((pixels_2, wrong)), TRUE, 1.5)
    assert rotation_error(both[1:], R_21) < 0.05
