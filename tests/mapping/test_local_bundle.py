"""What is free, what is fixed, how much a keypoint weighs, and which observations are forgotten."""

from __future__ import annotations

import copy

import pytest
import torch
from torch import Tensor

from tests.scene import CAMERA, Scene, adjust_local, rows_of, sideways, submap_of_scene
from torchslam.geometry import se3_exp, transform
from torchslam.map.map import NO_POINT, Map
from torchslam.mapping import local_bundle
from torchslam.mapping.local_bundle import (
    HUBER,
    adjust_all,
    apply_solution,
    build_window,
    remove_outliers,
    select,
    solve_local,
)

SCENE = Scene.of(200)
ROWS = rows_of(SCENE)


def row(T: Tensor) -> Map:
    return submap_of_scene(SCENE, T).map


def perturb(slam_map: Map, keyframes: list[int], size: float = 0.003) -> None:
    generator = torch.Generator().manual_seed(5)
    for keyframe in keyframes:
        twist = size * torch.randn(6, generator=generator, dtype=torch.float64)
        slam_map.keyframes["T_cw"][keyframe] = se3_exp(twist) @ slam_map.T_cw[keyframe]


def which_moved(slam_map: Map, before: Tensor) -> list[int]:
    return torch.nonzero((slam_map.T_cw != before).flatten(1).any(1))[:, 0].tolist()


def test_a_window_has_free_neighbors_and_fixed_keyframes(monkeypatch: pytest.MonkeyPatch) -> None:
    slam_map = row(sideways(6))
    truth = slam_map.T_cw.clone()
    perturb(slam_map, [4, 5])
    before = slam_map.T_cw.clone()
    monkeypatch.setattr(local_bundle, "LOCAL_WINDOW", 2)
    monkeypatch.setattr(local_bundle, "LOCAL_ITERATIONS", 20)
    adjust_local(slam_map, 5, CAMERA)
    assert which_moved(slam_map, before) == [4, 5]  # the one that shares most with it
    torch.testing.assert_close(slam_map.T_cw, truth, atol=1e-5, rtol=0)


def test_the_first_keyframe_is_always_fixed() -> None:
    slam_map = row(sideways(3))
    perturb(slam_map, [1, 2])
    before = slam_map.T_cw.clone()
    adjust_local(slam_map, 1, CAMERA)
    assert which_moved(slam_map, before) == [1, 2]
    adjust_all(slam_map, CAMERA)
    assert torch.equal(slam_map.T_cw[0], before[0])


def test_the_number_of_fixed_keyframes_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """With one holding keyframe alone the scale is free; with two it is not."""
    monkeypatch.setattr(local_bundle, "LOCAL_WINDOW", 2)
    monkeypatch.setattr(local_bundle, "LOCAL_ITERATIONS", 30)
    for limit, holds in ((1, False), (2, True)):
        monkeypatch.setattr(local_bundle, "MAX_FIXED_KEYFRAMES", limit)
        slam_map = row(sideways(4))
        truth = slam_map.T_cw.clone()
        slam_map.keyframes["T_cw"][2:, 0, 3] *= 1.02
        adjust_local(slam_map, 3, CAMERA)
        off = float((slam_map.T_cw[2:] - truth[2:]).abs().max())
        assert (off < 1e-6) is holds


def weighted(coarse: float) -> float:
    """By how many pixels points move of which one of three keyframes that stand has an error of 2 px.

    A fourth one that may move has the same error; both have keypoints of another scale.
    """
    T_cw = sideways(4)
    T_cw[:, 0, 3] = -torch.tensor([0.0, 0.3, 0.0, 0.3], dtype=torch.float64)
    slam_map = row(T_cw)
    slam_map.keyframes["keypoints"][2:, :, 1] += 2.0  # across the way, which no depth explains
    slam_map.keyframes["scales"][:2], slam_map.keyframes["scales"][2:] = 1.0, coarse
    seen = slam_map.observed_points(torch.arange(4))
    before = CAMERA.project(transform(T_cw[0], slam_map.positions_w[seen]))[0]
    window = build_window(slam_map, torch.tensor([2]), torch.tensor([0, 1, 3]), CAMERA)
    assert window is not None
    apply_solution(slam_map, window, *solve_local(window.problem, 30), CAMERA)
    after = CAMERA.project(transform(T_cw[0], slam_map.positions_w[seen]))[0]
    return float((after - before)[:, 1].median())


def test_a_keypoint_is_weighted_by_its_inverse_variance() -> None:
    assert weighted(1.0) == pytest.approx(2 / 3, rel=0.02)
    assert weighted(2.0) == pytest.approx(2 / 9, rel=0.02)
    assert weighted(4.0) == pytest.approx(2 / 33, rel=0.02)


def test_the_robust_kernel_starts_at_the_noise_level() -> None:
    assert pytest.approx(5.991**0.5) == HUBER


@pytest.mark.parametrize(("offset", "stays"), [(2.4, True), (2.5, False)])
def test_outliers_are_removed_in_units_of_their_scale(offset: float, stays: bool) -> None:
    slam_map = row(sideways(4))
    table = slam_map.keyframes["point_ids"]
    at = torch.nonzero(table[2] >= 0)[:10, 0]
    points = table[2, at].clone()
    slam_map.keyframes["keypoints"][2, at, 1] += offset * slam_map.keyframes["scales"][2, at]
    before = slam_map.points["times_observed"][points].clone()
    remove_outliers(slam_map, slam_map.observations(), CAMERA)
    assert bool((table[2, at] == points).all()) is stays
    assert bool((table[2, at] == NO_POINT).all()) is not stays
    alive = slam_map.points["is_valid"][points]
    assert torch.equal(alive, before - int(not stays) >= 2)
    assert slam_map.points["is_valid"].sum() > 100


def test_a_point_with_one_observation_is_invalidated() -> None:
    slam_map = row(sideways(2))
    table = slam_map.keyframes["point_ids"]
    at = torch.nonzero(table[1] >= 0)[:3, 0]
    points = table[1, at].clone()
    slam_map.keyframes["keypoints"][1, at] += 30.0
    count = slam_map.num_points
    remove_outliers(slam_map, slam_map.observations(), CAMERA)
    both = slam_map.points["times_observed"][points] == 0
    assert both.all()
    assert not slam_map.points["is_valid"][points].any()
    assert slam_map.num_points == count - 3


def test_an_adjusted_window_has_no_outliers() -> None:
    slam_map = row(sideways(4))
    table = slam_map.keyframes["point_ids"]
    at = torch.nonzero(table[3] >= 0)[:5, 0]
    slam_map.keyframes["keypoints"][3, at] += 25.0
    adjust_local(slam_map, 3, CAMERA)
    assert (table[3, at] == NO_POINT).all()


def test_adjusted_points_are_refreshed_from_their_observations() -> None:
    slam_map = row(sideways(4))
    slam_map.points["scale_distance"][:] = 0
    adjust_local(slam_map, 3, CAMERA)
    seen = slam_map.observed_points(torch.tensor([3]))
    size = SCENE.sizes[torch.argsort(ROWS)[seen]] * 200.0
    torch.testing.assert_close(slam_map.points["scale_distance"][seen], size)


def test_global_adjustment_fixes_the_first_keyframe(monkeypatch: pytest.MonkeyPatch) -> None:
    slam_map = row(sideways(5))
    truth = slam_map.T_cw.clone()
    perturb(slam_map, [1, 2, 3, 4])
    monkeypatch.setattr(local_bundle, "GLOBAL_ITERATIONS", 30)
    adjust_all(slam_map, CAMERA)
    torch.testing.assert_close(slam_map.T_cw[:, :3, :3], truth[:, :3, :3], atol=1e-6, rtol=0)
    scale = float(slam_map.T_cw[4, 0, 3] / truth[4, 0, 3])
    torch.testing.assert_close(slam_map.T_cw[:, :3, 3], scale * truth[:, :3, 3], atol=1e-6, rtol=0)
    assert (slam_map.keyframes["covariances"] == 0).all()


def test_an_interrupted_adjustment_leaves_the_map_unchanged() -> None:
    slam_map = row(sideways(4))
    perturb(slam_map, [1, 2, 3], size=0.03)
    before = copy.deepcopy(slam_map)

    def interrupt(iteration: int, iterations: int) -> None:
        assert iterations == local_bundle.GLOBAL_ITERATIONS
        if iteration == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        adjust_all(slam_map, CAMERA, interrupt)
    for table, old in ((slam_map.points, before.points), (slam_map.keyframes, before.keyframes)):
        for name, column in table.columns().items():
            assert torch.equal(column, old[name]), name


def test_an_empty_window_changes_nothing() -> None:
    slam_map = row(sideways(2))
    slam_map.remove_points(slam_map.valid_points())
    before = slam_map.T_cw.clone()
    adjust_local(slam_map, 1, CAMERA)
    assert adjust_all(slam_map, CAMERA) is CAMERA
    assert torch.equal(slam_map.T_cw, before)


def test_observations_can_be_selected() -> None:
    slam_map = row(sideways(2))
    seen = slam_map.observations()
    few = select(seen, torch.nonzero(seen.keyframe_index == 1)[:, 0])
    assert (few.keyframe_index == 1).all()
    assert len(few) == int((slam_map.keyframes["point_ids"][1] >= 0).sum())
    assert torch.equal(few.pixels, slam_map.keyframes["keypoints"][1, few.keypoint_index])
