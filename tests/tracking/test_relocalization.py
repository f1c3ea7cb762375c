"""A camera that is lost finds its place again, or says that it does not know."""

from __future__ import annotations

import torch
from torch import Tensor

from tests.scene import CAMERA, Scene, pose, rows_of, sideways, submap_of_scene
from torchslam.config import Config
from torchslam.geometry import SharedCamera
from torchslam.map.atlas import Submap
from torchslam.tracking import pose_validation, tracker
from torchslam.tracking.data_association import match_keyframe, match_points
from torchslam.tracking.tracker import Relocalizer, Tracker

SCENE = Scene.of(300)
ROWS = rows_of(SCENE)
FAR = Scene(SCENE.points_w, SCENE.sizes, SCENE.descriptors.flip(0) ^ 255)  # of another look
ANYWHERE = pose(-0.3, 0.1, 0.2, 0.05, 0.1, -0.1)


def relocalizer() -> Relocalizer:
    return Relocalizer(Tracker(SharedCamera(CAMERA), Config()))


def submaps() -> tuple[Submap, Submap]:
    return submap_of_scene(SCENE, sideways(6)), submap_of_scene(FAR, sideways(6), number=1)


def found(T_cw: Tensor, candidates: list[tuple[Submap, int]], noise: float = 0.3) -> Submap | None:
    located = relocalizer().locate(SCENE.view(50, T_cw, noise=noise), candidates)
    if located is None:
        return None
    submap, estimate = located
    torch.testing.assert_close(estimate.T_cw, T_cw, atol=0.02, rtol=0)
    assert estimate.inliers > 100
    return submap


def test_a_lost_frame_is_relocalized() -> None:
    right, _ = submaps()
    right.tracking.local_points = right.tracking.local_points[:0]
    assert found(ANYWHERE, [(right, 0)]) is right
    assert found(sideways(1, start=0.6)[0], [(right, 0)]) is right


def test_the_first_candidate_with_a_pose_is_used() -> None:
    right, wrong = submaps()
    assert found(ANYWHERE, [(wrong, 0), (right, 2)]) is right
    twin = submap_of_scene(SCENE, sideways(6), number=2)
    assert found(ANYWHERE, [(twin, 1), (right, 1)]) is twin
    assert found(ANYWHERE, []) is None


def test_the_number_of_candidates_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    right, wrong = submaps()
    others = [submap_of_scene(FAR, sideways(2), number=number) for number in range(3, 6)]
    candidates = [(other, 0) for other in others]
    assert found(ANYWHERE, [*candidates, (right, 0)]) is None
    assert found(ANYWHERE, [*candidates[:2], (right, 0)]) is right
    monkeypatch.setattr(tracker, "MAX_CANDIDATES", 4)
    assert found(ANYWHERE, [*candidates, (right, 0)]) is right
    # neighbors of a failed candidate are not tried and do not count
    monkeypatch.setattr(tracker, "MAX_CANDIDATES", 2)
    assert found(ANYWHERE, [(wrong, row) for row in range(6)] + [(right, 0)]) is right


def test_neighbors_of_a_candidate_that_failed_in_another_submap_are_tried() -> None:
    right, wrong = submaps()
    assert found(ANYWHERE, [(wrong, 3), (right, 3)]) is right


def test_an_uncertain_pose_does_not_relocalize(monkeypatch: pytest.MonkeyPatch) -> None:
    right, _ = submaps()
    for limit, value, is_found in (
        ("MAX_POSITION_STD", 1e-6, False),
        ("MAX_SQUARED_ERROR", 1e-3, False),
        ("MAX_JUMP", 1e-9, True),  # nothing was expected
    ):
        with monkeypatch.context() as patched:
            patched.setattr(pose_validation, limit, value)
            assert (found(ANYWHERE, [(right, 0)]) is right) is is_found


def test_a_candidate_matches_by_its_own_descriptors() -> None:
    right, _ = submaps()
    right.map.points["descriptors"][:] = 0  # of other observations
    view = SCENE.view(50, ANYWHERE)
    pairs = match_keyframe(right.map, 2, view, relocalizer().tracker.matcher)
    points, keypoints = pairs.first, pairs.second
    assert len(points) > 150
    assert torch.equal(ROWS[SCENE.shows(50)[keypoints]], points)
    assert set(points.tolist()) <= set(right.map.observed_points(torch.tensor([2])).tolist())


def test_points_match_by_descriptor_at_any_position() -> None:
    right, _ = submaps()
    view = SCENE.view(50, ANYWHERE)
    ids = right.map.valid_points().flip(0)
    pairs = match_points(right.map, ids, view, relocalizer().tracker.matching)
    points, keypoints = pairs.first, pairs.second
    assert len(points) > 150
    assert torch.equal(ROWS[SCENE.shows(50)[keypoints]], points)
    assert len(match_points(right.map, ids[:0], view, relocalizer().tracker.matching).first) == 0
