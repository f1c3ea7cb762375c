"""A map is started by a camera that turns and moves, before it has turned away, and by none that only turns."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.scene import CAMERA, Scene
from torchslam import load_config
from torchslam.geometry import SharedCamera, se3_inverse, so3_exp, so3_log
from torchslam.geometry.rolling_shutter import Readout, row_fractions
from torchslam.geometry.rotating_camera import RotatingCamera
from torchslam.tracking import initialization
from torchslam.tracking.initialization import LEAVING_INTERVAL, Initializer
from torchslam.tracking.matcher import make_matcher, run_matcher
from torchslam.tracking.turning_camera import READOUT_SIGMAS, TurningCamera
from torchslam.types import FrameFeatures, Reason, TwoViewMap

SCENE = Scene.of(1600, width=24.0)


def walk(frames: int, step: float) -> Tensor:
    """(F, 4, 4) T_cw of a camera that turns to the right ever faster, nods, and moves to the right."""
    k = torch.arange(frames, dtype=torch.float64)
    zero = torch.zeros_like(k)
    R_wc = so3_exp(torch.stack((0.01 * k.sin(), 0.04 * k + 0.001 * k**2, zero), dim=-1))
    T_wc = torch.eye(4, dtype=torch.float64).repeat(frames, 1, 1)
    T_wc[:, :3, :3], T_wc[:, 0, 3] = R_wc, step * k
    return se3_inverse(T_wc)


def views_of(T_cw: Tensor, readout: float, noise: float = 0.2) -> list[FrameFeatures]:
    """The views of a rolling shutter, which takes a share of the interval between two frames for an image."""
    views = []
    for index, T in enumerate(T_cw):
        view = SCENE.view(index, T, noise=noise)
        before, after = T_cw[max(index - 1, 0)], T_cw[min(index + 1, len(T_cw) - 1)]
        turn = so3_log((after @ se3_inverse(before))[:3, :3]) / (2 if 0 < index < len(T_cw) - 1 else 1)
        rays, seen = CAMERA.unproject(view.keypoints), view.keypoints
        for _ in range(20):
            R = so3_exp(readout * row_fractions(seen, CAMERA.height)[:, None] * turn)
            seen = CAMERA.project((R @ rays[..., None])[..., 0])[0]
        mask = view.mask & CAMERA.in_image(seen)
        views.append(replace(view, keypoints=torch.where(mask[:, None], seen, 0.0), mask=mask))
    return views


def start(views: list[FrameFeatures], *overrides: str) -> tuple[TwoViewMap | None, list[Reason]]:
    """The first map, and why there was none before."""
    initializer = Initializer(
        SharedCamera(CAMERA), load_config(None, ["initialization.min_matches=60", *overrides])
    )
    reasons = []
    for view in views:
        result = initializer.step(view)
        if isinstance(result, TwoViewMap):
            return result, reasons
        assert isinstance(result.reason, Reason)
        reasons.append(result.reason)
    return None, reasons


@pytest.mark.parametrize("readout", [0.0, 0.9])
def test_a_camera_that_turns_and_moves_starts_a_map(readout: float, monkeypatch: pytest.MonkeyPatch) -> None:
    T_cw = walk(24, 0.02)
    views = views_of(T_cw, readout)
    found, reasons = start(views)
    assert found is not None, reasons
    assert (found.view.index + 1) % LEAVING_INTERVAL == 0
    T_21 = T_cw[found.view.index] @ se3_inverse(T_cw[found.reference.index])
    R_error = so3_log(found.T_cw[:3, :3] @ T_21[:3, :3].mT)
    assert float(R_error.norm()) < 0.01
    assert float(torch.cosine_similarity(found.T_cw[:3, 3], T_21[:3, 3], dim=0)) > 0.995
    # By the threshold alone the camera turns away first.
    monkeypatch.setattr(initialization, "MAX_LEFT_RATIO", 0.0)
    later, reasons = start(views[: found.view.index + 1])
    assert later is None
    assert Reason.PURE_ROTATION in reasons


@pytest.mark.parametrize(("readout", "noise"), [(0.0, 0.2), (0.4, 0.6), (0.9, 0.2)])
def test_a_camera_that_only_turns_starts_none(readout: float, noise: float) -> None:
    found, reasons = start(views_of(walk(24, 0.0), readout, noise))
    assert found is None
    assert Reason.PURE_ROTATION in reasons


def fitted(
    views: list[FrameFeatures], known: Readout | None = None, *overrides: str
) -> tuple[TurningCamera, RotatingCamera, Tensor, tuple[Tensor, Tensor]]:
    """The fit to the first and the last of some views, with the readout of the sensor model."""
    config = load_config(None, ["initialization.min_matches=60", *overrides])
    matcher = make_matcher(config.matching, features=config.features.kind)
    turning = TurningCamera(SharedCamera(CAMERA, known), config, matcher)
    turning.refer_to(views[0])
    for view in views[1:]:
        turning.add(view)
    pairs = run_matcher(matcher, views[0], views[-1])
    pixels = views[0].keypoints[pairs.first], views[-1].keypoints[pairs.second]
    found, turns = turning.fit(*pixels, torch.ones_like(pairs.first, dtype=torch.bool))
    return turning, found, turns, pixels


def test_the_turns_during_a_readout_are_measured() -> None:
    T_cw = walk(14, 0.0)
    turning, found, turns, pixels = fitted(views_of(T_cw, 0.6, noise=0.1))
    assert float(found.readout) == pytest.approx(0.6, abs=0.1)
    # The rate at frame k is 0.04 + 0.002 k about the y axis of the camera, to the left of the scene.
    rates = torch.tensor([0.04, 0.04 + 0.002 * 13], dtype=torch.float64)
    torch.testing.assert_close(turns[:, 1], -0.6 * rates, atol=0, rtol=0.15)
    everything = torch.ones(len(pixels[0]), dtype=torch.bool)
    assert found.explains(everything[None], 0.6)[0]
    middle_1, middle_2 = turning.at_middle_rows(pixels, turns)
    R_21 = (T_cw[-1] @ se3_inverse(T_cw[0]))[:3, :3]
    mapped, _ = CAMERA.project(CAMERA.unproject(middle_1) @ R_21.mT)
    assert float((mapped - middle_2).norm(dim=-1).median()) < 0.7


def test_a_readout_that_is_known_is_not_fitted() -> None:
    views = views_of(walk(14, 0.0), 0.6, noise=0.1)
    interval = views[1].timestamp - views[0].timestamp
    _, found, turns, pixels = fitted(views, Readout.known(0.6 * interval, 0.01 * interval))
    assert float(found.readout) == 0.0
    rates = torch.tensor([0.04, 0.04 + 0.002 * 13], dtype=torch.float64)
    torch.testing.assert_close(turns[:, 1], -0.6 * rates, atol=0, rtol=0.05)
    everything = torch.ones(len(pixels[0]), dtype=torch.bool)
    assert found.explains(everything[None], 0.6)[0]


def test_a_readout_is_not_fitted_where_none_is_wanted_or_measured() -> None:
    views, overrides = views_of(walk(14, 0.0), 0.6, noise=0.1), ("camera.readout_std=0",)
    for _, found, turns, _ in (fitted(views, None, *overrides), fitted([views[0], views[-1]])):
        assert (
            float(found.readout) == 0.0
        )  # of two views, which do not tell how fast the camera turns, as well
        assert not bool(turns.any())
    _, found, turns, _ = fitted(views_of(walk(14, 0.0), 0.0))
    assert abs(float(found.readout)) < READOUT_SIGMAS * float(found.readout_std)
    assert not bool(turns.any())


def test_a_moving_camera_is_not_explained_by_a_rotation() -> None:
    _, found, _, pixels = fitted(views_of(walk(10, 0.05), 0.0))
    assert not found.explains(torch.ones(len(pixels[0]), dtype=torch.bool)[None], 0.5)[0]
