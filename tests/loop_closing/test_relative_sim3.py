"""Two maps of one scene, the second moved by a known similarity: it has to be found, or nothing."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from tests.loop_closing.ring import scaling_sim3
from tests.scene import CAMERA, Scene, moved, pose, rows_of, sideways, submap_of_scene
from torchslam.config import Config
from torchslam.geometry import SharedCamera, estimate_similarity, se3_inverse, transform
from torchslam.geometry.similarity import Similarity
from torchslam.loop_closing import loop_detector
from torchslam.loop_closing.keyframe_database import KeyframeDatabase
from torchslam.loop_closing.loop_detector import LoopDetector
from torchslam.map.atlas import Atlas
from torchslam.map.map import Map

SCENE = Scene.of(300)
ROWS = rows_of(SCENE)
ONE = sideways(4)
OTHER = pose(0, 0, 0, 0.0, 0.05, 0.1) @ sideways(4, start=0.08)
DETECTOR = LoopDetector(SharedCamera(CAMERA), Config(), Atlas(CAMERA.params), KeyframeDatabase())
TWO = 100  # first frame of the second map


def maps(S_21: Tensor, noise: float = 0.0) -> tuple[Map, Map]:
    one = submap_of_scene(SCENE, ONE, noise=noise)
    other = submap_of_scene(SCENE, OTHER, S_ws=S_21, first=TWO, number=1, noise=noise)
    return one.map, other.map


def related(map_1: Map, map_2: Map) -> Tensor | None:
    found = DETECTOR.estimate(map_1, 2, map_2, 1)
    return None if found is None else found[0]


def test_the_similarity_between_two_maps_is_estimated(S_21: Tensor) -> None:
    found = related(*maps(S_21))
    assert found is not None
    torch.testing.assert_close(found, S_21, atol=1e-6, rtol=0)


def test_noise_changes_the_similarity_little(S_21: Tensor) -> None:
    found = related(*maps(S_21, noise=0.5))
    assert found is not None
    points = SCENE.points_w[:50]
    off = transform(found, points) - transform(S_21, points)
    assert float(off.norm(dim=-1).median()) < 0.03 * 4.0 * 1.6


@pytest.mark.parametrize(("known", "samples"), [(12, 1), (24, 69), (60, 1147), (120, 3000)])
def test_sampling_stops_when_enough_matches_would_have_been_found(
    S_21: Tensor, monkeypatch: pytest.MonkeyPatch, known: int, samples: int
) -> None:
    map_1, map_2 = maps(S_21)
    shared = in_both(map_1, map_2)
    drawn: list[int] = []

    def estimate(*args: Tensor, **settings: Any) -> Similarity:
        assert args[0].shape[1] == known
        drawn.append(settings["max_samples"])
        return estimate_similarity(*args, **settings)

    monkeypatch.setattr("torchslam.loop_closing.loop_detector.estimate_similarity", estimate)
    related(thinned(map_1, shared[:known]), map_2)
    assert drawn == [samples]


def test_another_scene_is_not_related(S_21: Tensor) -> None:
    map_1, _ = maps(S_21)
    elsewhere = submap_of_scene(Scene.of(300, seed=9), OTHER, first=TWO).map
    assert related(map_1, elsewhere) is None


def test_similar_descriptors_at_other_positions_are_not_related(S_21: Tensor) -> None:
    map_1, _ = maps(S_21)
    looks = Scene(Scene.of(300, seed=9).points_w, SCENE.sizes, SCENE.descriptors)
    assert related(map_1, submap_of_scene(looks, OTHER, first=TWO).map) is None


def thinned(slam_map: Map, points: Tensor) -> Map:
    """Only these points are left."""
    living = slam_map.valid_points()
    slam_map.remove_points(living[~torch.isin(living, points)])
    return slam_map


def in_both(map_1: Map, map_2: Map) -> Tensor:
    """(n,) points that all eight keyframes see."""
    all_of_them = (map_1.points["times_observed"] == 4) & (map_2.points["times_observed"] == 4)
    return torch.nonzero(all_of_them)[:, 0]


def test_enough_points_of_the_other_map_must_be_seen(S_21: Tensor) -> None:
    for count, found in ((40, True), (39, False)):
        map_1, map_2 = maps(S_21)
        thinned(map_2, in_both(map_1, map_2)[:count])
        assert (related(map_1, map_2) is not None) is found


def test_enough_of_them_must_be_known_to_the_own_map(S_21: Tensor) -> None:
    for count, found in ((20, True), (19, False)):
        map_1, map_2 = maps(S_21)
        thinned(map_1, in_both(map_1, map_2)[:count])
        assert (related(map_1, map_2) is not None) is found


def test_the_reverse_direction_needs_half_as_many_matches(
    S_21: Tensor, monkeypatch: pytest.MonkeyPatch
) -> None:
    map_1, map_2 = maps(S_21)
    both = in_both(map_1, map_2)[:30]
    thinned(map_1, both)
    monkeypatch.setattr(loop_detector, "_MIN_MATCHES", 60)
    assert related(map_1, map_2) is not None
    monkeypatch.setattr(loop_detector, "_MIN_MATCHES", 62)
    assert related(map_1, map_2) is None


def test_the_scale_is_that_of_most_depths(S_21: Tensor) -> None:
    """A third of the points of the first map at twice their depth leave the pixels, and the scale, as they are."""
    map_1, map_2 = maps(S_21)
    T_cw = map_1.T_cw[2]
    points_c = transform(T_cw, map_1.positions_w)
    points_c[torch.arange(len(points_c)) % 3 == 0] *= 2
    map_1.points["positions_w"][:] = transform(se3_inverse(T_cw), points_c)
    found = related(map_1, map_2)
    assert found is not None
    torch.testing.assert_close(found, S_21, atol=1e-3, rtol=0)


def test_a_neighbor_verifies_a_similarity_that_predicts_its_points(S_21: Tensor) -> None:
    map_1, map_2 = maps(S_21)
    near = torch.arange(4)
    assert DETECTOR.verify(S_21, map_1, 3, map_2, near)
    for wrong in (pose(0.5), pose(0, 0, 0, 0, 0.1), scaling_sim3(1.3)):
        assert not DETECTOR.verify(wrong @ S_21, map_1, 3, map_2, near)
    thinned(map_2, in_both(map_1, map_2)[:20])
    assert DETECTOR.verify(S_21, map_1, 3, map_2, near)
    thinned(map_2, in_both(map_1, map_2)[:19])
    assert not DETECTOR.verify(S_21, map_1, 3, map_2, near)


@pytest.mark.parametrize(("offset", "agrees"), [(4.85, True), (4.95, False)])
def test_points_agree_within_twice_the_noise(S_21: Tensor, offset: float, agrees: bool) -> None:
    map_1, map_2 = maps(S_21)
    T_12 = moved(ONE[2], S_21)
    keypoints, scales = map_1.keyframes["keypoints"], map_1.keyframes["scales"]
    keypoints[2, :, 0] += offset * scales[2]
    ids, _ = DETECTOR.match(map_2, map_2.valid_points(), T_12, map_1, 2)
    good, at = DETECTOR.match_inliers(map_2, map_2.valid_points(), T_12, map_1, 2)
    assert len(ids) > 100
    assert (len(good) > 100) is agrees
    assert len(good) > 100 or len(good) < 0.1 * len(ids)  # a stray one is near another's place
    order = SCENE.shows(2)
    assert torch.equal(ROWS[order[at]], good)


def test_projected_points_are_searched_within_eight_pixels(S_21: Tensor) -> None:
    for offset, found in ((7.8, True), (8.2, False)):
        map_1, map_2 = maps(S_21)
        map_1.keyframes["keypoints"][2, :, 0] += offset * map_1.keyframes["scales"][2]
        T_12 = moved(ONE[2], S_21)
        ids, _ = DETECTOR.match(map_2, map_2.valid_points(), T_12, map_1, 2)
        assert (len(ids) > 100) is found


def test_a_neighborhood_is_a_keyframe_and_its_most_covisible_ones() -> None:
    slam_map = submap_of_scene(SCENE, sideways(5)).map
    assert slam_map.neighborhood(4, 2).tolist() == [4, 3, 2]
    assert slam_map.neighborhood(0, 10).tolist() == [0, 1, 2, 3, 4]
