"""The tracker's parts by known values, and the whole of it on a scene of which every answer is known."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.scene import (
    CAMERA,
    Scene,
    assert_same_state,
    camera_center,
    moved,
    pose,
    rows_of,
    sideways,
    state_of,
    submap_of_scene,
)
from torchslam.config import load_config
from torchslam.geometry import SharedCamera, se3_exp, se3_inverse, transform
from torchslam.map.atlas import EMA_RATE, Submap
from torchslam.tracking import data_association, localizer
from torchslam.tracking import tracker as tracker_module
from torchslam.tracking.data_association import (
    GRID,
    MATURE_OBSERVATIONS,
    MAX_CELL_WEIGHT,
    MAX_MATCHES_PER_CELL,
    cell_numbers,
    coverage_ratio,
    explained_ratio,
    grid_weights,
    select_mature,
    subsample_per_cell,
)
from torchslam.tracking.localizer import Projected, project_points
from torchslam.tracking.tracker import SEARCH_RADIUS_PX, Tracker, well_observed
from torchslam.types import FrameFeatures, PoseEstimate, PosePrediction

SCENE = Scene.of(300)
EMPTY = torch.empty(0, dtype=torch.float64)
ROWS = rows_of(SCENE)
STEP = torch.tensor([-0.05, 0.02, 0.03, 0.01, 0.04, -0.02], dtype=torch.float64)  # from frame to frame
AWAY = pose(0, 0, 0, 0, 3.0)


def tracker(*overrides: str) -> Tracker:
    return Tracker(SharedCamera(CAMERA), load_config(None, overrides))


def submap(count: int = 4, **options: float) -> Submap:
    return submap_of_scene(SCENE, sideways(count), **options)  # type: ignore[arg-type]


def followed(where: Submap, view: FrameFeatures, by: Tracker | None = None) -> PoseEstimate:
    by = by or tracker()
    estimate = by.track(where, view)
    assert estimate is not None
    by.commit(where, view, estimate)
    return estimate


# --- the track --------------------------------------------------------------------------------------------------


def test_tracking_continues_from_a_keyframe() -> None:
    here = submap(4)
    here.tracking = replace(here.tracking.moved(pose(0.1), 0.0), error=0.7, explained_ratio=0.4)
    tracker().reset_to_keyframe(here, 2)
    tracking = here.tracking
    assert tracking.reference == 2
    torch.testing.assert_close(tracking.T_cr, pose())
    torch.testing.assert_close(here.T_cw, here.map.T_cw[2])
    assert torch.equal(tracking.motions, pose(0.1)[None])
    assert (tracking.error, tracking.explained_ratio) == (0.7, 0.4)
    assert int(tracking.local_keyframes[0]) == 2
    assert sorted(tracking.local_keyframes.tolist()) == [0, 1, 2, 3]
    seen = here.map.keyframes["point_ids"][2]
    assert torch.equal(tracking.last_inlier_points, seen[seen >= 0])
    assert torch.equal(tracking.local_points, here.map.observed_points(torch.arange(4)))


def test_the_local_map_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(localizer, "LOCAL_KEYFRAMES", 2)
    here, few = submap(6), tracker()
    few.reset_to_keyframe(here, 0)
    assert here.tracking.local_keyframes.tolist() == [0, 1, 2]  # the nearest share most
    assert torch.equal(here.tracking.local_points, here.map.observed_points(torch.arange(3)))


def test_the_local_map_may_be_the_recently_seen_points(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tracker_module, "RECENT_FRAMES", 5)
    here, recent = submap(4), tracker("paper.brute_force=true")
    last_seen = here.map.points["last_seen_frame"]
    last_seen[:] = 10
    last_seen[:20] = 15
    last_seen[20:30] = 11
    here.map.remove_points(torch.tensor([3]))
    recent.reset_to_keyframe(here, 3)
    wanted = [row for row in range(30) if here.map.points["is_valid"][row]]
    assert here.tracking.local_points.tolist() == wanted
    last_seen[0] = 16
    recent.reset_to_keyframe(here, 3)
    assert here.tracking.local_points.tolist() == [row for row in wanted if row < 20]


def test_a_prediction_repeats_the_last_motion() -> None:
    here, follower = submap(), tracker()
    first = sideways(1, start=0.2)[0]
    path = [first, se3_exp(STEP) @ first, se3_exp(STEP) @ se3_exp(STEP) @ first]
    for index, T_cw in enumerate(path[:2]):
        followed(here, SCENE.view(50 + index, T_cw), follower)
    torch.testing.assert_close(here.tracking.motions[-1], se3_exp(STEP), atol=1e-7, rtol=0)
    torch.testing.assert_close(follower.predict(here, 60.0).T_cw, path[2], atol=1e-7, rtol=0)
    torch.testing.assert_close(here.T_cw, path[1], atol=1e-7, rtol=0)
    for still in ("paper.brute_force=true", "tracking.motion_model=constant-pose"):
        torch.testing.assert_close(tracker(still).predict(here, 60.0).T_cw, here.T_cw)
    here.tracking = here.tracking.without_motion()
    torch.testing.assert_close(follower.predict(here, 60.0).T_cw, here.T_cw)


def test_a_lost_frame_resets_the_motion_model() -> None:
    here = submap()
    here.tracking = here.tracking.moved(pose(0.1), 0.0)
    before, view, follower = state_of(here), SCENE.view(50, AWAY), tracker()
    assert follower.track(here, view) is None
    follower.commit(here, view, None)
    assert_same_state(state_of(here), before | {"motions": EMPTY.view(0, 4, 4), "intervals": EMPTY})


@pytest.mark.parametrize("T_cw", [se3_exp(3 * STEP), AWAY], ids=["found", "lost"])
@pytest.mark.parametrize("is_sure", [True, False])
def test_estimating_a_pose_changes_neither_map_nor_tracking_state(T_cw: Tensor, is_sure: bool) -> None:
    here, view, follower = submap(), SCENE.view(50, T_cw, noise=0.5), tracker()
    here.tracking = here.tracking.moved(se3_exp(STEP), 0.0)
    before, posed = state_of(here), len(here.posed_frames)
    estimate = follower.track(here, view, is_sure=is_sure)
    assert (estimate is None) is (T_cw is AWAY)
    assert_same_state(state_of(here), before)
    assert len(here.posed_frames) == posed
    again = follower.track(here, view, is_sure=is_sure)
    assert (again is None) is (estimate is None)
    if estimate is not None and again is not None:
        assert torch.equal(estimate.T_cw, again.T_cw)
        follower.commit(here, view, estimate)
        with pytest.raises(AssertionError):
            assert_same_state(state_of(here), before)


def test_matches_are_searched_around_the_prior_pose_if_there_is_one() -> None:
    here, follower = submap(3), tracker("matching.max_ratio=1e-9")  # which no match without a place passes
    T_cw = sideways(1, start=0.2)[0]
    view = SCENE.view(50, T_cw)
    view = replace(view, descriptors=view.descriptors ^ torch.eye(32, dtype=torch.uint8)[0] * 255)
    here.tracking.T_cr = AWAY
    assert follower.track(here, view) is None
    estimate = follower.track(here, view, PosePrediction(T_cw))
    assert estimate is not None
    torch.testing.assert_close(estimate.T_cw, T_cw, atol=1e-7, rtol=0)


def test_the_reference_keyframe_shares_the_most_points() -> None:
    here, follower = submap(5, noise=0.0), tracker()
    follower.reset_to_keyframe(here, 4)
    T_cw = sideways(1, start=0.16)[0]
    view = SCENE.view(50, T_cw)
    estimate = followed(here, view, follower)
    shared = here.map.count_observed(estimate.point_ids)
    assert int(shared[here.tracking.reference]) == int(shared.max())
    assert here.tracking.reference != 4
    torch.testing.assert_close(here.T_cw, T_cw, atol=1e-7, rtol=0)
    torch.testing.assert_close(
        here.tracking.T_cr, T_cw @ se3_inverse(here.map.T_cw[here.tracking.reference]), atol=1e-7, rtol=0
    )
    assert torch.equal(here.tracking.last_inlier_points, estimate.point_ids)
    assert len(here.tracking.motions)
    last_seen = here.map.points["last_seen_frame"]
    assert (last_seen[estimate.point_ids] == 50).all()
    others = torch.ones(len(last_seen), dtype=torch.bool).index_fill(0, estimate.point_ids, False)
    assert (last_seen[others] == 0).all()


def test_running_averages_span_about_ten_frames() -> None:
    here, follower = submap(), tracker()
    here.tracking.error, here.tracking.explained_ratio = 2.0, 0.5
    estimate = followed(here, SCENE.view(50, sideways(1, start=0.4)[0], noise=0.5), follower)
    assert here.tracking.error == pytest.approx(2.0 + EMA_RATE * (estimate.error - 2.0))
    assert here.tracking.explained_ratio == pytest.approx(0.5 + EMA_RATE * (estimate.explained_ratio - 0.5))
    assert EMA_RATE == 0.1


def test_the_tracking_state_restarts_after_relocalization() -> None:
    here, follower = submap(5), tracker()
    here.tracking = replace(here.tracking.moved(pose(0.1), 0.0), error=3.0, explained_ratio=0.1)
    view = SCENE.view(50, sideways(1, start=0.02)[0])
    estimate = followed(here.fork(), view, follower)
    here.map.points["last_seen_frame"][:] = 0
    before = here.world
    follower.start_at_estimate(here, view, estimate)
    assert here.world != before
    assert here.tracking.reference == 0
    assert not len(here.tracking.motions)
    assert (here.tracking.error, here.tracking.explained_ratio) == (0.0, 1.0)
    assert torch.equal(here.tracking.last_inlier_points, estimate.point_ids)
    torch.testing.assert_close(here.T_cw, estimate.T_cw)
    assert (here.map.points["last_seen_frame"][estimate.point_ids] == 50).all()


def test_the_last_frame_may_be_posed_anew_after_its_map_was_adjusted() -> None:
    """Its motion stays; the pose follows the reference keyframe from where it is now."""
    here, follower = submap(5, noise=0.0), tracker()
    view = SCENE.view(50, sideways(1, start=0.16)[0])
    followed(here, view, follower)
    before, reference = here.tracking, here.tracking.reference
    here.map.keyframes["T_cw"][:] = here.map.T_cw @ AWAY  # the adjusted map is elsewhere, but not its points
    estimate = follower.track(here, view, PosePrediction(sideways(1, start=0.16)[0]))
    assert estimate is not None
    follower.correct(here, estimate)
    torch.testing.assert_close(here.T_cw, estimate.T_cw)
    assert here.tracking.reference == reference
    assert not torch.allclose(here.tracking.T_cr, before.T_cr)
    assert torch.equal(here.tracking.motions, before.motions)
    assert torch.equal(here.tracking.last_inlier_points, estimate.point_ids)


# --- one frame --------------------------------------------------------------------------------------------------


def test_a_frame_has_the_true_pose_and_observations() -> None:
    here, T_cw = submap(), se3_exp(3 * STEP)
    view = SCENE.view(50, T_cw)
    visible = here.map.points["times_visible"].clone()
    estimate = followed(here, view)
    torch.testing.assert_close(estimate.T_cw, T_cw, atol=1e-7, rtol=0)
    assert torch.equal(estimate.point_ids, ROWS[SCENE.shows(50)[estimate.keypoints]])
    assert estimate.matches == estimate.inliers > 150
    assert estimate.error < 1e-12
    assert estimate.coverage_ratio == 1.0
    depth = transform(T_cw, here.map.positions_w[estimate.point_ids])[:, 2].median()
    assert estimate.depth == pytest.approx(float(depth), abs=1e-6)
    assert estimate.expected is not None
    assert torch.isin(estimate.point_ids, estimate.expected).all()
    assert torch.equal(here.map.points["times_visible"], visible)  # it is not believed yet


def test_an_accepted_frame_counts_visible_and_found_points() -> None:
    here, follower = submap(), tracker()
    points, estimate = here.map.points, followed(here, SCENE.view(50, se3_exp(3 * STEP)))
    estimate = replace(estimate, point_ids=estimate.point_ids[:50], keypoints=estimate.keypoints[:50])
    visible, found = points["times_visible"].clone(), points["times_found"].clone()
    follower.count_visible(here.map, estimate)
    follower.count_found(here.map, estimate)
    assert estimate.expected is not None
    assert torch.nonzero(points["times_visible"] - visible)[:, 0].tolist() == sorted(
        estimate.expected.tolist()
    )
    assert torch.nonzero(points["times_found"] - found)[:, 0].tolist() == sorted(estimate.point_ids.tolist())
    follower.count_visible(here.map, replace(estimate, expected=None))
    assert (points["times_visible"] - visible)[estimate.point_ids].tolist() == [2] * 50
    follower.counts = False
    follower.count_visible(here.map, estimate)
    assert int((points["times_visible"] - visible).max()) == 2


def test_the_error_is_in_units_of_the_noise() -> None:
    medians = [followed(submap(), SCENE.view(50 + n, se3_exp(n * STEP), noise=0.7)).error for n in range(6)]
    # The median of a chi-square of two degrees of freedom is 1.386; six parameters of 400 residuals are fitted.
    assert sum(medians) / len(medians) == pytest.approx(1.386 * 0.7**2, rel=0.15)


def few(here: Submap, count: int) -> None:
    """Leave the map so many of the points that all keyframes see."""
    everyone = torch.nonzero(here.map.points["times_observed"] == here.map.num_keyframes)[:, 0]
    rest = here.map.valid_points()
    here.map.remove_points(rest[~torch.isin(rest, everyone[:count])])
    tracker().reset_to_keyframe(here, here.map.num_keyframes - 1)


@pytest.mark.parametrize("limit", ["MIN_MATCHES", "MIN_INLIERS"])
def test_too_few_points_give_no_pose(limit: str, monkeypatch: pytest.MonkeyPatch) -> None:
    count = 30
    here = submap(2)
    few(here, count)
    view = SCENE.view(50, sideways(1, start=0.1)[0])
    monkeypatch.setattr(localizer, limit, count)
    assert followed(here.fork(), view).inliers == count
    monkeypatch.setattr(localizer, limit, count + 1)
    assert tracker().track(here.fork(), view) is None


def test_enough_matches_must_be_inliers(monkeypatch: pytest.MonkeyPatch) -> None:
    here = submap(2)
    few(here, 40)
    view = SCENE.view(50, sideways(1, start=0.1)[0])
    wrong = SCENE.at(50)[torch.argsort(ROWS)[here.map.valid_points()[:12]]]
    off = view.keypoints.clone()
    off[wrong, 1] += 4.5 * view.scales[wrong]  # near enough to match, too far to agree
    spoiled = replace(view, keypoints=off)
    monkeypatch.setattr(localizer, "MIN_INLIERS", 28)
    estimate = followed(here.fork(), spoiled)
    assert (estimate.inliers, estimate.matches) == (28, 40)
    monkeypatch.setattr(localizer, "MIN_INLIERS", 29)
    assert tracker().track(here.fork(), spoiled) is None


def located(here: Submap, view: FrameFeatures, T_cw: Tensor) -> PoseEstimate | None:
    """Track a view from a prediction."""
    aside = here.fork()
    aside.tracking.T_cr = T_cw @ se3_inverse(here.map.T_cw[here.tracking.reference])
    aside.tracking = aside.tracking.without_motion()
    other = view.descriptors.clone()
    other[:, 0] ^= 255  # eight bits of noise: no nearest neighbor is a billion times nearer than the second
    return tracker("matching.max_ratio=1e-9").track(aside, replace(view, descriptors=other))


@pytest.mark.parametrize(("pixels", "found"), [(10.0, True), (35.0, True), (110.0, False)])
def test_matches_are_searched_near_the_prediction(pixels: float, found: bool) -> None:
    """Scales are one to three pixels: the first window is 12 to 36 pixels wide, the second 36 to 108.

    With a ratio test that nothing passes, matches without a place are out of the question.
    """
    here = submap(3)
    T_cw = sideways(1, start=0.2)[0]
    turned = pose(0, 0, 0, 0, math.atan(pixels / 200.0)) @ T_cw
    estimate = located(here, SCENE.view(50, T_cw), turned)
    assert (estimate is not None) is found


def test_without_a_prediction_matching_is_by_descriptor() -> None:
    here = submap(3)
    T_cw = sideways(1, start=0.2)[0]
    here.tracking.T_cr = AWAY
    here.tracking = here.tracking.without_motion()
    estimate = followed(here, SCENE.view(50, T_cw))
    torch.testing.assert_close(estimate.T_cw, T_cw, atol=1e-7, rtol=0)


# --- the parts --------------------------------------------------------------------------------------------------


def test_points_count_as_well_observed_when_three_local_keyframes_see_them() -> None:
    here = submap(4)
    table = here.map.keyframes["point_ids"]

    def seen(keyframe: int) -> set[int]:
        return {row for row in table[keyframe].tolist() if row >= 0}

    local = torch.arange(4)
    wanted = [row for row in seen(3) if sum(row in seen(other) for other in range(4)) >= 3]
    assert well_observed(here.map, 3, local) == len(wanted) < len(seen(3))
    assert well_observed(here.map, 3, torch.tensor([3, 2])) == len(seen(3) & seen(2))
    assert here.tracking.reference_size == len(wanted)


def test_cells_number_the_image_row_by_row() -> None:
    pixels = torch.tensor(
        [[0.0, 0], [39.9, 39.9], [40.0, 0], [0, 40.0], [319.4, 239.4], [-0.5, -0.5], [320.0, 240.0]]
    ).double()
    assert cell_numbers(pixels, (320, 240)).tolist() == [0, 0, 1, 8, 47, 0, 47]
    assert GRID == (8, 6)


def test_mature_points_are_used_alone_where_they_suffice() -> None:
    times = torch.tensor(
        [MATURE_OBSERVATIONS, MATURE_OBSERVATIONS - 1, MATURE_OBSERVATIONS + 5, 0, MATURE_OBSERVATIONS]
    )
    assert select_mature(times, 3).tolist() == [0, 2, 4]
    assert select_mature(times, 4).tolist() == [0, 1, 2, 3, 4]


def test_every_cell_is_sampled() -> None:
    crowd = torch.tensor([[10.0, 10.0]]).expand(12, 2)
    pixels = torch.cat([crowd, torch.tensor([[300.0, 200.0], [100.0, 10.0]]), crowd]).double()
    chosen = subsample_per_cell(pixels, (320, 240))
    assert chosen.tolist() == [0, 1, 2, 3, 4, 12, 13]
    assert MAX_MATCHES_PER_CELL == 5


def test_the_weight_of_a_cell_is_bounded() -> None:
    crowd = torch.tensor([[10.0, 10.0]]).expand(2 * MAX_CELL_WEIGHT, 2)
    few = torch.tensor([[100.0, 10.0]]).expand(MAX_CELL_WEIGHT, 2)
    weights = grid_weights(torch.cat([crowd, few, few[:1] + 100]).double(), (320, 240))
    assert weights.tolist() == [0.5] * 2 * MAX_CELL_WEIGHT + [1.0] * (MAX_CELL_WEIGHT + 1)


def test_the_explained_fraction_counts_cells_with_inliers() -> None:
    places = (
        [(10.0, 10.0)] * 3
        + [(100.0, 10.0)] * 2
        + [(300.0, 200.0)] * 2
        + [(10.0, 200.0)]
        + [(200.0, 100.0)] * 2
    )
    keypoints, one = torch.tensor(places).double(), torch.ones(len(places)).double()
    mask = torch.arange(len(places)) < 8  # the last two are no keypoints
    some = FrameFeatures(0, 0.0, keypoints, one, 0 * one, one[:, None], mask)
    for used, share in (([0, 3, 5], 1.0), ([1, 2], 1 / 3), ([4, 6, 7], 2 / 3), ([7], 0.0)):
        assert explained_ratio(some, torch.tensor(used), (320, 240)) == pytest.approx(share)
    nothing = replace(some, mask=torch.zeros_like(mask))
    assert explained_ratio(nothing, torch.tensor([0]), (320, 240)) == 1.0


def test_a_tracker_that_does_not_count_leaves_the_map_as_it_is() -> None:
    here, follower = submap(), tracker()
    follower.counts = False
    before = {name: column.clone() for name, column in here.map.points.columns().items()}
    estimate = followed(here, SCENE.view(50, sideways(1, start=0.2)[0]), follower)
    follower.count_found(here.map, estimate)
    follower.start_at_estimate(here, SCENE.view(51, sideways(1, start=0.2)[0]), estimate)
    assert all(torch.equal(column, before[name]) for name, column in here.map.points.columns().items())
    follower.counts = True
    follower.count_found(here.map, estimate)
    found = here.map.points["times_found"] - before["times_found"]
    assert torch.equal(torch.nonzero(found)[:, 0], estimate.point_ids.sort().values)
    assert int(found.max()) == 1


def test_coverage_counts_cells_with_a_fifth_of_the_expected_points() -> None:
    here = submap()
    ids = here.map.valid_points()[:30]
    here.map.points["times_found"][ids] = MATURE_OBSERVATIONS
    ten, five = [(10.0, 10.0)] * 10, [(100.0, 10.0)] * 5
    twos = [(300.0, 200.0), (300.0, 100.0), (300.0, 10.0)] * 2
    places = [*ten, *five, *twos, (10.0, 200.0)]
    expected = Projected(ids[:22], torch.tensor(places).double(), torch.ones(22), torch.zeros(22))

    def share(*seen: int) -> float:
        return coverage_ratio(here.map, expected, ids[list(seen)], (320, 240))

    assert share(*range(22)) == 1.0
    assert share(0, 1, 10, 15, 16, 17) == 1.0  # a fifth of each
    assert share(0, 10, 15, 16, 17) == pytest.approx(4 / 5)  # a tenth of the first
    assert share(0, 1) == pytest.approx(1 / 5)
    assert share(21) == 0.0  # a single point is no expectation
    here.map.points["times_found"][ids[10:15]] = MATURE_OBSERVATIONS - 1  # young points are not expected
    assert share() == 1.0  # four cells are too few to say anything


# --- correspondences --------------------------------------------------------------------------------------------


def projected(here: Submap, T_cw: Tensor, scales: tuple[float, float] = (0.1, 50.0)) -> Projected:
    return project_points(here.map, here.map.valid_points(), T_cw, CAMERA, scales)


def test_the_expected_scale_falls_with_the_distance() -> None:
    here = submap(1)
    here.map.points["is_valid"][here.map.keyframes["point_ids"][0].clamp(min=0)] = True
    back = pose(0, 0, 4.0)
    seen = projected(here, back)
    size = SCENE.sizes[torch.argsort(ROWS)[seen.ids]]
    distance = torch.linalg.vector_norm(transform(back, here.map.positions_w[seen.ids]), dim=-1)
    torch.testing.assert_close(seen.scales, size * 200.0 / distance)
    torch.testing.assert_close(
        seen.pixels, CAMERA.project(transform(back, here.map.positions_w[seen.ids]))[0]
    )
    narrow = projected(here, back, scales=(0.9, 1.1))
    torch.testing.assert_close(narrow.scales, seen.scales.clamp(0.9, 1.1))


@pytest.mark.parametrize("limit", [20.0, 40.0])
def test_points_seen_from_another_side_are_excluded(limit: float, monkeypatch: pytest.MonkeyPatch) -> None:
    here = submap(1)
    here.map.points["is_valid"][here.map.keyframes["point_ids"][0].clamp(min=0)] = True
    middle = torch.tensor([0.0, 0.0, 4.0], dtype=torch.float64)
    angle = math.radians(30.0)
    turn = pose(0, 0, 0, 0, angle)
    T_cw = turn.clone()
    T_cw[:3, 3] = middle - turn[:3, :3] @ middle  # looks at the middle of the scene from 30 degrees aside
    rays = here.map.positions_w - camera_center(T_cw)
    between = (rays * here.map.positions_w).sum(-1) / (rays.norm(dim=-1) * here.map.positions_w.norm(dim=-1))
    alike = torch.rad2deg(between.acos()) < limit
    monkeypatch.setattr(data_association, "MAX_VIEW_ANGLE_DEG", limit)
    kept = projected(here, T_cw).ids
    assert alike[kept].all()
    assert 0 < len(kept) < 300
    pixels, valid = CAMERA.project(transform(T_cw, here.map.positions_w))
    wanted = alike & valid & CAMERA.in_image(pixels) & here.map.points["is_valid"]
    assert torch.equal(kept, torch.nonzero(wanted)[:, 0])


def test_tracking_does_not_depend_on_the_map_frame() -> None:
    """Nothing depends on the origin or the scale of the map frame."""
    S = torch.eye(4, dtype=torch.float64)
    S[:3] = se3_exp(torch.tensor([1.0, -2.0, 3.0, 0.3, 1.0, -0.5], dtype=torch.float64))[:3]
    S[:3, :3] *= 2.5
    T_cw = se3_exp(3 * STEP)
    here, there = submap(), submap(S_ws=S)  # type: ignore[arg-type]
    one = followed(here, SCENE.view(50, T_cw, noise=0.5))
    two = followed(there, SCENE.view(50, T_cw, noise=0.5))
    torch.testing.assert_close(two.T_cw, moved(one.T_cw, S), atol=1e-6, rtol=0)
    assert two.depth == pytest.approx(2.5 * one.depth, rel=1e-6)
    assert (two.inliers, two.matches) == (one.inliers, one.matches)
    assert two.error == pytest.approx(one.error, rel=1e-4)
    units = torch.tensor([2.5] * 3 + [1.0] * 3, dtype=torch.float64)
    torch.testing.assert_close(two.covariance, units[:, None] * one.covariance * units, rtol=1e-3, atol=1e-12)


def test_after_uncertain_frames_the_pose_search_starts_from_scratch(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[bool] = []
    follower, here, view = tracker(), submap(), SCENE.view(50, sideways(1, start=0.7)[0])
    monkeypatch.setattr(
        "torchslam.tracking.localizer.nearby_pose", lambda *_: calls.append(True)
    )  # and RANSAC finds it
    for is_sure, wanted in ((False, []), (True, [True])):
        aside = here.fork()
        assert follower.track(aside, view, is_sure=is_sure) is not None
        assert calls == wanted


def test_keypoints_are_searched_for_where_a_covariance_allows() -> None:
    """A frame far from its prediction, at first found by a model that states how wrong it is."""
    here, view = submap(), SCENE.view(50, se3_exp(3 * STEP) @ submap().T_cw)
    radii = []
    for std in (None, 1e-4, 0.05):
        covariance = None if std is None else std**2 * torch.eye(6, dtype=torch.float64)
        prediction = PosePrediction(here.T_cw, covariance)
        follower = tracker()
        near = follower.localizer.project(here.map, here.tracking.local_points, here.T_cw, view)
        radii.append(follower._search_radius(here.map, near, prediction))
        assert follower.track(here, view, prediction) is not None
    assert radii[0] == SEARCH_RADIUS_PX
    assert float(radii[1].max()) < 6
    assert float(radii[2].min()) > SEARCH_RADIUS_PX
