"""A camera with an uncertain focal length that only turned is told from one that moved."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from tests.global_mapping.synthetic import CAMERA, Recording, arc, ball, line, wall
from torchslam.geometry import Camera, rigid, se3_inverse, so3_exp
from torchslam.geometry.camera_measurement import CameraMeasurement
from torchslam.global_mapping import turning
from torchslam.global_mapping.coarse import CoarseMapper
from torchslam.global_mapping.turning import turning_focal

THRESHOLD_PX = 1.5


def turns(count: int, step: float = 0.05) -> Tensor:
    """(K, 4, 4) T_cw of cameras that turn to the right, by so many radians each."""
    yaw = step * torch.arange(count, dtype=torch.float64)
    zero = torch.zeros_like(yaw)
    return se3_inverse(
        rigid(so3_exp(torch.stack((zero, yaw, 0.1 * yaw), dim=-1)), zero[:, None].expand(-1, 3))
    )


PAN = Recording.of(turns(10), wall(300, 4.0), noise_px=0.5)
PAIRS = PAN.pairs(1, 2, 3)


def given(factor: float, std: float) -> CameraMeasurement:
    """The camera with a focal length that is wrong by a factor."""
    focal = 400.0 * factor
    return CameraMeasurement.of(
        Camera.pinhole(focal, focal, 319.5, 239.5, size=(640, 480)).to(torch.float64), std
    )


@pytest.mark.parametrize("factor", [0.75, 1.0, 1.5, 2.2])
def test_a_turning_camera_is_found_with_its_focal_length(factor: float) -> None:
    focal = turning_focal(PAIRS, PAN.views, given(factor, 0.3), THRESHOLD_PX)
    assert focal == pytest.approx(400, rel=0.03)


@pytest.mark.parametrize("std", [0.02, 0.3])
@pytest.mark.parametrize(
    "recording",
    [Recording.of(arc(8), ball(150), noise_px=0.5), Recording.of(line(8), wall(300, 2.0), noise_px=0.5)],
    ids=["around", "past"],
)
def test_a_camera_that_moves_is_none(recording: Recording, std: float) -> None:
    assert turning_focal(recording.pairs(1, 2, 3), recording.views, given(1.1, std), THRESHOLD_PX) is None


def test_a_focal_length_outside_its_error_explains_nothing() -> None:
    """Three standard deviations: 1.5 is five of 0.08, and two of 0.2."""
    assert turning_focal(PAIRS, PAN.views, given(1.5, 0.08), THRESHOLD_PX) is None
    assert turning_focal(PAIRS, PAN.views, given(1.5, 0.2), THRESHOLD_PX) is not None


def test_most_pairs_decide(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of each image the furthest one; the first six images turn, the others walk."""
    T_cw = torch.cat((turns(6), se3_inverse(se3_inverse(line(7)[1:]) @ se3_inverse(turns(6)[-1:]))))
    mixed = Recording.of(T_cw, wall(300, 4.0), noise_px=0.5)
    pairs = mixed.pairs(1)
    turned = [pair for pair in pairs if pair.second < 6]
    assert len(turned) == 5
    camera = given(1.5, 0.3)
    assert turning_focal(turned, mixed.views, camera, THRESHOLD_PX) is not None
    assert turning_focal(pairs, mixed.views, camera, THRESHOLD_PX) is None
    monkeypatch.setattr(turning, "_PAIRS", 4)
    assert turning_focal(turned + pairs[-1:], mixed.views, camera, THRESHOLD_PX) is not None


def test_there_is_no_map_of_a_turning_camera() -> None:
    """Nor where the essential matrices of a wrong focal length show a motion."""
    camera = given(1.5, 0.3)
    found = CoarseMapper(camera.camera, camera, threshold_px=THRESHOLD_PX).map(PAN.views, PAIRS, [])
    assert isinstance(found, str)
    assert "the camera only turns, with a focal length of about " in found
    number = float(found.split("about ")[1].split(" px")[0])
    assert number == pytest.approx(400, rel=0.03)
    assert CAMERA.size == camera.camera.size
