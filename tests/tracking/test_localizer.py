"""The localizer on a scene of which every answer is known: whose guess is tried, who agrees, and who has a voice."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from tests.map.simulated import estimate_at
from tests.scene import CAMERA, Scene, pose, rows_of, sideways, submap_of_scene
from torchslam.config import Config
from torchslam.geometry import KeypointNoise, SharedCamera, UndistortedKeypoints, transform
from torchslam.map.atlas import Submap
from torchslam.optim.frame_pose import FramePose
from torchslam.tracking import localizer as localizer_module
from torchslam.tracking.localizer import Localizer
from torchslam.tracking.tracker import Tracker
from torchslam.types import MatchIndices

SCENE = Scene.of(300)
ROWS = rows_of(SCENE)


def localizer() -> Localizer:
    return Localizer(SharedCamera(CAMERA), Config())


def submap() -> Submap:
    return submap_of_scene(SCENE, sideways(4))


@pytest.mark.parametrize(
    ("poses", "chosen", "tried"),
    [
        ([(50, 100), (90, 100)], 0, 1),  # half agree: no other candidate is tried
        ([(49, 100), None, (60, 61), (90, 90)], 2, 3),
        ([None, (40, 100), (45, 100), (20, 60)], 2, 4),
        ([None, None], None, 2),
    ],
)
def test_with_few_inliers_other_candidates_are_tried(
    poses: list[tuple[int, int] | None], chosen: int | None, tried: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    here, finder = submap(), localizer()
    answers = [
        None
        if found is None
        else estimate_at(pose(), torch.arange(found[0]), torch.arange(found[0]), matches=found[1])
        for found in poses
    ]
    remaining = iter(answers)
    monkeypatch.setattr(finder, "_locate", lambda *_: next(remaining))
    no_matches = MatchIndices(torch.zeros(0, dtype=torch.int64), torch.zeros(0, dtype=torch.int64))
    view = SCENE.view(50, pose())
    estimate = finder.locate(here.map, view, iter([no_matches] * len(poses)), here.tracking.local_points)
    assert estimate is (None if chosen is None else answers[chosen])
    assert len(list(remaining)) == len(poses) - tried


def test_a_pose_elsewhere_in_the_map_uses_the_local_map_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(localizer_module, "LOCAL_KEYFRAMES", 1)
    here, finder = submap_of_scene(SCENE, sideways(12, step=0.6)), localizer()
    Tracker(SharedCamera(CAMERA), Config()).reset_to_keyframe(here, 11)
    T_cw = sideways(1, start=0.05)[0]
    view = SCENE.view(50, T_cw)
    at = torch.nonzero(view.mask)[:, 0]
    there = ROWS[SCENE.shows(50)[at]]
    alive = here.map.points["is_valid"][there]
    matches = iter([MatchIndices(there[alive][:30], at[alive][:30])])
    estimate = finder.locate(here.map, view, matches, here.tracking.local_points)
    assert estimate is not None
    torch.testing.assert_close(estimate.T_cw, T_cw, atol=1e-7, rtol=0)
    near = here.map.neighborhood(int(here.map.count_observed(there[alive][:30]).argmax()), 1)
    assert near.tolist() == [0, 1]
    assert set(estimate.point_ids.tolist()) <= set(here.map.observed_points(near).tolist())
    assert estimate.inliers > 60


def refined(
    scales: Tensor | float, *offsets: Tensor, T_cw: Tensor | None = None
) -> tuple[FramePose, Tensor, Tensor]:
    """Refinement at a keyframe's pose of what it sees, with keypoints off by (n, 2)."""
    here, seen, pixels = keyframe_0()
    scales = torch.as_tensor(scales, dtype=torch.float64).expand(len(seen))
    for offset in offsets:
        pixels = pixels + offset
    noise, undistorted = KeypointNoise.of(scales, None), UndistortedKeypoints.of(pixels, CAMERA)
    return localizer()._refine(
        here.map, here.map.T_cw[0] if T_cw is None else T_cw, seen, pixels, undistorted, noise
    )


def keyframe_0() -> tuple[Submap, Tensor, Tensor]:
    """A submap, the points of its first keyframe, and where this sees them."""
    here = submap()
    seen = here.map.observed_points(torch.tensor([0]))
    return here, seen, CAMERA.project(transform(here.map.T_cw[0], here.map.positions_w[seen]))[0]


@pytest.mark.parametrize(("offset", "agrees"), [(2.40, True), (2.50, False)])
@pytest.mark.parametrize("scale", [0.5, 3.0])
def test_the_gate_is_that_of_two_degrees_of_freedom_in_units_of_the_scale(
    offset: float, agrees: bool, scale: float
) -> None:
    off = torch.zeros(len(keyframe_0()[1]), dtype=torch.float64)
    off[::40] = offset * scale
    off[::80] *= -1
    _, _, inliers = refined(scale, off[:, None] * torch.tensor([0.6, -0.8], dtype=torch.float64))
    assert torch.equal(inliers, (off == 0) | agrees)


def test_points_behind_the_camera_are_no_inliers() -> None:
    middle = torch.tensor([159.5, 119.5], dtype=torch.float64) - keyframe_0()[2]
    assert not refined(1.0, middle, T_cw=pose(0, 0, 0, 0, math.pi))[2].any()


def test_a_keypoint_is_weighted_by_its_inverse_variance() -> None:
    """Half of the points are four times as coarse and three pixels to the right: the others move by 3 / 17 of that."""
    here, seen, pixels = keyframe_0()
    coarse = torch.arange(len(seen)) % 2 == 1
    scales = torch.where(coarse, 4.0, 1.0).double()
    off = torch.where(coarse, 3.0, 0.0).double()[:, None] * pixels.new_tensor([1.0, 0.0])
    found, errors, agrees = refined(scales, off)
    assert agrees.all()
    fitted = CAMERA.project(transform(found.T_cw, here.map.positions_w[seen]))[0]
    assert float((fitted - pixels)[:, 0].mean()) == pytest.approx(3 / 17, rel=0.1)
    torch.testing.assert_close(errors, ((fitted - pixels - off) ** 2).sum(-1) / scales**2)


def test_outliers_do_not_affect_the_refinement() -> None:
    here, seen, pixels = keyframe_0()
    wrong = torch.arange(len(seen)) < len(seen) // 4
    for off in (6.0, 4.0):
        offsets = torch.where(wrong, off, 0.0).double()[:, None] * pixels.new_tensor([1.0, 0.0])
        found, _, agrees = refined(1.0, offsets)
        assert torch.equal(agrees, ~wrong)
        torch.testing.assert_close(found.T_cw, here.map.T_cw[0], atol=1e-9, rtol=0)
