"""When two frames contradict a map that was initialized recently."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from tests.scene import CAMERA, Scene, pose, submap_of_scene
from torchslam.config import Config
from torchslam.geometry import SharedCamera, epipolar_offsets, se3_inverse, so3_exp
from torchslam.tracking.initialization import (
    MIN_SUPPORT_RATIO,
    Initializer,
    contradicting_initialization,
    support,
)
from torchslam.tracking.turning_camera import THRESHOLD_PX
from torchslam.types import FrameFeatures, TwoViewMap

SCENE = Scene.of(400)
SIDE = pose(-0.5, 0.0, 0.1, 0.01, -0.05, 0.02)


def swung(degrees: float) -> Tensor:
    """(4, 4) SIDE as it would be had the camera moved in a direction that much higher."""
    T_cw = SIDE.clone()
    turn = so3_exp(torch.tensor([0.0, 0.0, math.radians(degrees)], dtype=torch.float64))
    T_cw[:3, 3] = T_cw[:3, :3] @ turn @ se3_inverse(SIDE)[:3, 3] * -1
    return T_cw


def contradiction(T_cw: Tensor, last: FrameFeatures | None = None) -> TwoViewMap | None:
    """What two frames say to a map that has one of them at the origin and the other, at SIDE, at T_cw.

    The map has a frame of its own. The last frame may be another one.
    """
    submap = submap_of_scene(SCENE, torch.stack([pose(), SIDE]))
    own = pose(0.3, -0.2, 1.0, 0.5, 0.1, -0.4)
    submap.map.keyframes["T_cw"][:] = torch.stack([own, T_cw @ own])
    first, last = SCENE.view(0, pose()), last or SCENE.view(1, SIDE)
    return contradicting_initialization(submap, first, last, CAMERA, Config())


def two_views() -> TwoViewMap:
    initializer = Initializer(SharedCamera(CAMERA), Config())
    initializer.step(SCENE.view(0, pose()))
    start = initializer.step(SCENE.view(1, SIDE))
    assert isinstance(start, TwoViewMap), start
    return start


def supported(start: TwoViewMap, T_21: Tensor) -> float:
    pixels_1 = start.reference.keypoints[start.keypoints_1]
    return support(pixels_1, start.view.keypoints[start.keypoints_2], T_21, CAMERA, THRESHOLD_PX)


def test_a_consistent_map_has_no_contradicting_initialization(monkeypatch: pytest.MonkeyPatch) -> None:
    assert contradiction(SIDE) is None
    looked: list[FrameFeatures] = []
    monkeypatch.setattr(Initializer, "step", lambda _, view: looked.append(view))
    assert contradiction(SIDE) is None
    assert not looked  # it explains more than half of the matches: no motion can have twice as much support
    assert contradiction(swung(60)) is None
    assert len(looked) == 2


def test_the_initialization_that_contradicts_a_wrong_map_has_the_true_motion() -> None:
    start = contradiction(swung(60))
    assert start is not None
    wanted = SIDE.clone()
    wanted[:3, 3] /= SIDE[:3, 3].norm()
    torch.testing.assert_close(start.T_cw, wanted, atol=1e-6, rtol=0)
    assert (start.reference.index, start.view.index) == (0, 1)


def test_frames_without_initialization_contradict_nothing() -> None:
    assert contradiction(swung(60)) is not None
    assert contradiction(swung(60), last=SCENE.view(1, pose())) is None


def test_a_map_with_less_than_half_of_the_support_is_contradicted() -> None:
    start, decided = two_views(), set()
    for degrees in torch.linspace(2.5, 4.5, 11).tolist():
        T_21 = swung(degrees)
        share = supported(start, T_21) / supported(start, start.T_cw)
        contradicted = contradiction(T_21) is not None
        assert contradicted is (share < MIN_SUPPORT_RATIO)
        if abs(share - 0.5) < 0.1:
            decided.add(contradicted)
    assert decided == {True, False}


def test_support_falls_with_the_square_of_the_error_and_ends_at_the_threshold() -> None:
    start = two_views()
    T_21 = swung(5)
    assert supported(start, start.T_cw) == pytest.approx(len(start.points_w), abs=1e-4)
    pixels_1 = start.reference.keypoints[start.keypoints_1]
    pixels_2 = start.view.keypoints[start.keypoints_2]
    errors = epipolar_offsets(T_21, pixels_1, pixels_2, CAMERA, CAMERA)[0].abs()
    wanted = sum(1 - (e / THRESHOLD_PX) ** 2 for e in errors.tolist() if e < THRESHOLD_PX)
    assert 0 < wanted < len(start.points_w)
    assert supported(start, T_21) == pytest.approx(wanted)
