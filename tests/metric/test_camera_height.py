"""The height of a camera above the ground."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.metric.plane_world import PlaneWorld
from torchslam.errors import MeasurementError
from torchslam.geometry import rigid, se3_inverse, so3_exp
from torchslam.metric.camera_height import CameraHeight, ground_heights
from torchslam.metric.source import ScaleMeasurement, SubmapView, Unmeasured

HEIGHT = 0.8
DOWN = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)


def drive(frames: int = 13, step: float = 0.5, pitch: float = 0.1) -> Tensor:
    """(F, 4, 4) T_cw of a camera that moves straight on and looks a little down."""
    centers_w = torch.zeros(frames, 3, dtype=torch.float64)
    centers_w[:, 2] = step * torch.arange(frames)
    R_wc = so3_exp(torch.tensor([-pitch, 0.0, 0.02], dtype=torch.float64)).repeat(frames, 1, 1)
    return se3_inverse(rigid(R_wc, centers_w))


@pytest.fixture(scope="module")
def view() -> SubmapView:
    return PlaneWorld(drive(), DOWN, HEIGHT).view()


def test_the_height_is_found_in_every_frame(view: SubmapView) -> None:
    heights = torch.from_numpy(ground_heights(view))
    assert len(heights) >= 4
    assert float((heights / HEIGHT - 1).abs().max()) < 0.03


def test_the_height_gives_the_unit(view: SubmapView) -> None:
    found = CameraHeight(1.6).measure(view)
    assert isinstance(found, ScaleMeasurement)
    assert abs(math.log(found.meters_per_unit / (1.6 / HEIGHT))) < 2 * found.relative_std < 0.06
    assert found.unit == "frames above the ground"


def test_a_wall_is_no_ground() -> None:
    T_cw = drive(step=0.1)
    wall = PlaneWorld(T_cw, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), 6.0)
    found = CameraHeight(1.6).measure(wall.view())
    assert isinstance(found, Unmeasured)
    assert "it must move along it" in found.reason


def test_without_motion_or_images_there_is_no_height(view: SubmapView) -> None:
    for other in (PlaneWorld(drive(step=0.001), DOWN, HEIGHT).view(), replace(view, sequence=None)):
        assert isinstance(CameraHeight(1.6).measure(other), Unmeasured)


def test_a_height_is_positive() -> None:
    for wrong in (0.0, -1.0, math.inf, math.nan):
        with pytest.raises(MeasurementError):
            CameraHeight(wrong)
