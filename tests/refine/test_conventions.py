"""Conventions of poses that image pairs determine: inverted, swapped, and all axes of the camera."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from torchslam.geometry import Camera, se3_exp, se3_inverse, transform
from torchslam.geometry.transforms import opengl, signed_axes
from torchslam.refine.conventions import MIN_PAIRS, Reading, fitting_reading

EYE = torch.eye(3, dtype=torch.float64)
GL = torch.diag(torch.tensor((1.0, -1.0, -1.0), dtype=torch.float64))
ROWS = torch.tensor([(i, i + step) for step in (1, 2, 3) for i in range(12 - step)])


CAMERA = Camera.pinhole(500.0, 500.0, 319.5, 239.5, (640, 480))


@pytest.fixture(scope="module")
def T_cw() -> Tensor:
    """A walk that looks ahead, so that all images see points far before it."""
    steps = torch.randn(12, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return se3_exp((0.12 * steps).cumsum(0))


def matches_of(T_cw: Tensor, noise: float = 0.0) -> tuple[Tensor, Tensor]:
    """Pixels of points 2 to 6 before the first camera of each pair, with noise in pixels."""
    generator = torch.Generator().manual_seed(1)
    points = torch.rand(len(ROWS), 20, 3, generator=generator, dtype=torch.float64)
    points = (points - torch.tensor((0.5, 0.5, 0.0)).double()) * torch.tensor((3.0, 2.0, 4.0)).double()
    points[..., 2] += 2
    T_21 = T_cw[ROWS[:, 1]] @ se3_inverse(T_cw[ROWS[:, 0]])
    pixels = (CAMERA.project(each)[0] for each in (points, transform(T_21, points)))
    noisy = (x + noise * torch.randn(x.shape, generator=generator, dtype=torch.float64) for x in pixels)
    return next(noisy), next(noisy)


def reading_of(
    poses: Tensor, world_to_camera: bool, T_cw: Tensor, noise: float = 0.0
) -> tuple[float, list[Reading]]:
    return fitting_reading(poses, world_to_camera, ROWS, *matches_of(T_cw, noise), CAMERA)


def with_axes(A: Tensor) -> Tensor:
    """(4, 4) from camera axes of which the columns of A are ours."""
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3] = A
    return T


@pytest.mark.parametrize("world_to_camera", [False, True])
@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_right_poses_have_no_other_reading(T_cw: Tensor, world_to_camera: bool, noise: float) -> None:
    poses = T_cw if world_to_camera else se3_inverse(T_cw)
    share, others = reading_of(poses, world_to_camera, T_cw, noise)
    assert share > 0.6
    assert not others


@pytest.mark.parametrize("world_to_camera", [False, True])
@pytest.mark.parametrize("inverted", [False, True])
@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_every_change_of_axes_is_found(
    T_cw: Tensor, world_to_camera: bool, inverted: bool, noise: float
) -> None:
    for axes in signed_axes(EYE):
        if torch.equal(axes, EYE) and not inverted:
            continue
        # A left-handed camera is in a left-handed world.
        world = axes if torch.linalg.det(axes) < 0 else EYE
        in_axes = with_axes(axes.T) @ T_cw @ with_axes(world)
        poses = in_axes if world_to_camera != inverted else se3_inverse(in_axes)
        share, others = reading_of(poses, world_to_camera, T_cw, noise)
        assert share < 0.3
        other = others[0]
        assert other.share > 0.6
        assert other.inverted == inverted
        assert not other.swapped
        assert torch.equal(other.axes, axes)


def test_readings_that_fit_equally_are_all_named() -> None:
    """Five noisy poses in OpenGL's axes: the right reading is among those that are named, whichever fits best."""
    GL_cw = with_axes(GL)
    alone = 0
    for seed in range(20):
        generator = torch.Generator().manual_seed(seed)
        steps = torch.randn(12, 6, generator=generator, dtype=torch.float64)
        T_cw = se3_exp((0.12 * steps).cumsum(0))
        pixels_1, pixels_2 = matches_of(T_cw, 0.7)
        noise = torch.randn(12, 6, generator=generator, dtype=torch.float64)
        poses = GL_cw @ se3_exp(0.012 * noise) @ T_cw
        few = (ROWS < 5).all(1)
        _, others = fitting_reading(poses, True, ROWS[few], pixels_1[few], pixels_2[few], CAMERA)
        named = [not each.inverted and not each.swapped and torch.equal(each.axes, GL) for each in others]
        assert any(named) or not named
        alone += named == [True]
    assert alone >= 8


def test_centers_in_place_of_translations_are_found(T_cw: Tensor) -> None:
    poses = T_cw.clone()
    poses[:, :3, 3] = se3_inverse(T_cw)[:, :3, 3]
    _, (other,) = reading_of(poses, True, T_cw)
    assert (other.inverted, other.swapped, other.share) == (False, True, 1.0)
    assert (
        other.sentence("world to camera", EYE)
        == "world to camera, with the position of the camera in the world"
    )


def test_poses_that_nothing_fits_have_no_other_reading(T_cw: Tensor) -> None:
    share, others = reading_of(T_cw.flip(0).roll(5, 0), True, T_cw)
    assert share < 0.3
    assert not others
    few = (x[: MIN_PAIRS - 1] for x in (ROWS, *matches_of(T_cw)))
    assert not fitting_reading(se3_inverse(T_cw), True, *few, CAMERA)[1]


@pytest.mark.parametrize(
    ("stored", "words"),
    [
        ("w2c", "world to camera"),  # in OpenGL's axes, as all of the format
        ("opencv", "camera to world, camera axes x right, y down, z forward"),
        ("w2c opencv", "world to camera, camera axes x right, y down, z forward"),
    ],
)
def test_the_axes_of_a_format_with_its_own(T_cw: Tensor, stored: str, words: str) -> None:
    """As `transforms.json` is read, whose cameras look backward."""
    T_wc = se3_inverse(T_cw)
    file = {"w2c": se3_inverse(opengl(T_wc)), "opencv": T_wc, "w2c opencv": T_cw}[stored]
    _, (other,) = reading_of(opengl(file), False, T_cw)
    assert other.sentence("camera to world", GL) == words


def test_a_left_handed_reading_in_words() -> None:
    reading = Reading(False, False, torch.diag(torch.tensor((1.0, -1.0, 1.0), dtype=torch.float64)), 1.0)
    words = "camera to world, camera axes x right, y up, z forward, left-handed"
    assert reading.sentence("camera to world", EYE) == words
