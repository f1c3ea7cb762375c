"""Known places are detected, places that only look alike are not."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from tests.loop_closing.ring import END, KEYFRAMES, ring_submap, scaling_sim3
from tests.scene import CAMERA, Scene, camera_center, pose, sideways, submap_of_scene
from torchslam.config import Config
from torchslam.geometry import SharedCamera, sim3_inverse
from torchslam.loop_closing import loop_detector as detector
from torchslam.loop_closing.keyframe_database import KeyframeDatabase
from torchslam.loop_closing.loop_detector import (
    LoopCandidate,
    LoopClosureRecord,
    LoopDetector,
    are_consistent,
    is_plausible_drift,
    two_hop_covisible,
)
from torchslam.map.atlas import Atlas, Submap

SCENE = Scene.of(300)
SIDE = sideways(4)
OTHER = pose(0, 0, 0, 0.0, 0.05, 0.1) @ sideways(4, start=0.08)


def loop_detector(*held: Submap) -> LoopDetector:
    """A detector whose database holds all keyframes of these submaps."""
    atlas, database = Atlas(CAMERA.params), KeyframeDatabase()
    atlas._submaps = list(held)
    for submap in held:
        for keyframe in range(submap.map.num_keyframes):
            view = submap.map.frame_features(keyframe)
            database.add(submap.map.key(keyframe), view.descriptors, view.mask)
    return LoopDetector(SharedCamera(CAMERA), Config(), atlas, database)


def two_submaps(S_21: Tensor) -> tuple[Submap, Submap]:
    return submap_of_scene(SCENE, SIDE), submap_of_scene(SCENE, OTHER, S_ws=S_21, first=100, number=1)


# --- detecting ------------------------------------------------------------------------------------------------


def test_another_submap_of_the_same_place_is_detected(S_21: Tensor) -> None:
    one, other = two_submaps(S_21)
    found = loop_detector(one, other).detect(other, 3)
    assert found is not None
    assert (found.submap, found.keyframe, found.matched_submap) == (other, 3, one)
    assert not found.is_loop
    torch.testing.assert_close(found.S_21, sim3_inverse(S_21), atol=1e-6, rtol=0)
    assert found.closure == LoopClosureRecord(103, found.matched_keyframe, submap=1, matched_submap=0)


def test_a_drifted_loop_is_detected() -> None:
    submap = ring_submap(scale=1.01, twist=0.002)
    found = loop_detector(submap).detect(submap, END)
    assert found is not None
    assert found.is_loop
    assert found.matched_keyframe in (0, 1, 2)
    # what the end sees is smaller by all the steps of the way
    scale = float(found.S_21[:3, :3].det()) ** (1 / 3)
    assert scale == pytest.approx(1.01 ** (END - found.matched_keyframe), rel=0.02)


def test_a_place_that_was_never_left_is_no_loop() -> None:
    submap = submap_of_scene(SCENE, sideways(6))
    assert loop_detector(submap).detect(submap, 5) is None


def test_a_similar_looking_place_elsewhere_is_no_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    """A hundred meters later everything looks the same; no drift is that large over a hundred meters."""
    submap = submap_of_scene(SCENE, sideways(4))
    submap.merge(submap_of_scene(SCENE, OTHER, first=50), pose(0, 0, 100.0))
    assert loop_detector(submap).detect(submap, 7) is None
    monkeypatch.setattr(detector, "_MAX_DRIFT", 1.1)
    found = loop_detector(submap).detect(submap, 7)
    assert found is not None
    torch.testing.assert_close(found.S_21, pose(0, 0, -100.0), atol=1e-5, rtol=0)


def test_neighboring_keyframes_must_verify_a_loop(S_21: Tensor, monkeypatch: pytest.MonkeyPatch) -> None:
    one, other = two_submaps(S_21)
    other.map.keyframes["keypoints"][:3] += 40.0  # these see nothing where it should be
    assert loop_detector(one, other).detect(other, 3) is None
    monkeypatch.setattr(detector, "_MIN_VERIFYING", 0)
    assert loop_detector(one, other).detect(other, 3) is not None
    monkeypatch.undo()
    one, other = two_submaps(S_21)
    other.map.keyframes["keypoints"][:1] += 40.0
    assert loop_detector(one, other).detect(other, 3) is not None
    monkeypatch.setattr(detector, "_MIN_VERIFYING", 3)
    assert loop_detector(one, other).detect(other, 3) is None


def test_covisibility_reaches_two_steps() -> None:
    slam_map = ring_submap().map
    near = two_hop_covisible(slam_map, 10)
    shared = slam_map.count_observed(slam_map.observed_points(torch.tensor([10])))
    assert set(torch.nonzero(shared)[:, 0].tolist()) <= set(near.tolist())
    furthest = int(torch.nonzero(shared)[-1])
    assert int(near.max()) > furthest
    assert len(near) < KEYFRAMES
    assert torch.equal(near, torch.unique(near))
    assert 10 in near


# --- how far a way may drift --------------------------------------------------------------------------------------


def way() -> Submap:
    """Eleven keyframes, a meter apart; the first and the last are ten meters apart."""
    return submap_of_scene(Scene.of(50), sideways(11, step=1.0))


def drifts(S_21: Tensor, submap: Submap | None = None, keyframe: int = 10, matched_keyframe: int = 0) -> bool:
    return is_plausible_drift(submap or way(), keyframe, matched_keyframe, S_21)


def test_the_allowed_position_drift_grows_with_path_length() -> None:
    assert drifts(pose(0, 1.99))
    assert not drifts(pose(0, 2.01))
    assert drifts(pose(0, 0, 0.99), matched_keyframe=5)
    assert not drifts(pose(0, 0, 1.01), matched_keyframe=5)
    assert drifts(pose(0, 0, 0.99), keyframe=0, matched_keyframe=5)


def test_path_length_follows_the_order_of_the_frames() -> None:
    submap = way()
    submap.map.keyframes["frame_index"][:] = torch.tensor([0, 5, 1, 6, 2, 7, 3, 8, 4, 9, 10])
    # to and fro: 2, 2, 2, 2, then 7 back, 2, 2, 2, 2 and 1: 24 meters
    assert drifts(pose(0, 4.79), submap)
    assert not drifts(pose(0, 4.81), submap)


def test_drift_is_measured_at_the_camera_center() -> None:
    here = camera_center(way().map.T_cw[10])
    assert drifts(about(pose(0, 0, 0, 0, math.radians(19.0)), here))
    assert not drifts(pose(0, 0, 0, 0, math.radians(19.0)))  # about the origin the camera moves by 3.3 m
    for degrees, may in ((19.9, True), (20.1, False)):
        assert drifts(about(pose(0, 0, 0, math.radians(degrees)), here)) is may


@pytest.mark.parametrize(("scale", "may"), [(4.99, True), (5.01, False), (1 / 4.99, True), (1 / 5.01, False)])
def test_scale_drift_is_bounded(scale: float, may: bool) -> None:
    here = camera_center(way().map.T_cw[10])
    grown = about(scaling_sim3(scale), here)
    assert drifts(grown) is may
    turned = pose(0, 0, 0, 0, 0, math.radians(15.0))  # the scale is no rotation, nor the other way round
    assert drifts(about(turned, here) @ grown) is may


# --- two answers --------------------------------------------------------------------------------------------------


def answers(S_1: Tensor, S_2: Tensor, same: bool = True) -> bool:
    one, other = submap_of_scene(SCENE, sideways(4)), submap_of_scene(SCENE, sideways(4), number=1)
    third = other if same else submap_of_scene(SCENE, sideways(4), number=2)
    first = LoopCandidate(one, 2, other, 1, S_1)
    return are_consistent(first, LoopCandidate(one, 2, third, 1, S_2))


def about(S: Tensor, here: Tensor = camera_center(SIDE)[2]) -> Tensor:  # noqa: B008
    """The same about a place: the camera of keyframe 2."""
    return pose(*here.tolist()) @ S @ pose(*(-here).tolist())


def test_candidates_with_nearly_equal_similarities_agree() -> None:
    degree = math.pi / 180
    assert answers(pose(), pose())
    for near, far in (
        (pose(0, 0.38), pose(0, 0.5)),  # a tenth of the depth, which is four
        (pose(0, 0, 0, 4.9 * degree), pose(0, 0, 0, 5.1 * degree)),
        (scaling_sim3(1.19), scaling_sim3(1.21)),
    ):
        assert answers(about(near), pose())
        assert answers(pose(), about(near))
        assert not answers(about(far), pose())
        assert not answers(pose(), about(far))


def test_candidates_are_compared_at_the_camera(S_21: Tensor) -> None:
    assert answers(S_21, S_21)
    turned = pose(0, 0, 0, 0, 0, 0.08)
    assert answers(S_21, S_21 @ about(turned))
    assert not answers(S_21, S_21 @ pose(3.0, 4.0) @ turned @ pose(-3.0, -4.0))


def test_candidates_in_different_submaps_are_not_compared() -> None:
    assert answers(pose(5.0), pose(), same=False)


def test_two_contradicting_candidates_are_no_loop(S_21: Tensor, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two corridors of one submap look the same, so a place in them is ambiguous."""
    twin = submap_of_scene(SCENE, sideways(4), first=0)
    twin.merge(submap_of_scene(SCENE, sideways(4), first=50), pose(100.0))
    one = submap_of_scene(SCENE, OTHER, S_ws=S_21, first=100, number=1)
    assert loop_detector(twin, one).detect(one, 3) is None
    monkeypatch.setattr(detector, "_MAX_CANDIDATES", 1)
    assert loop_detector(twin, one).detect(one, 3) is not None
