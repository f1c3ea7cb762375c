"""The tracker's parts by known values, and the whole of it on a scene of which every answer is known."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.scene import CAMERA, Scene, centre, moved, pose, rows_of, sideways, world_in
from torchslam.config import load_config
from torchslam.geometry import se3_exp, se3_inverse, transform
from torchslam.map.submap import Submap
from torchslam.tracking.correspondences import Projected, project_points
from torchslam.tracking.match_selection import (
    CELLS,
    CROWD,
    PER_CELL,
    SENIOR,
    cells,
    coverage,
    explained,
    spread,
    trusted,
    voices,
)
from torchslam.tracking.tracker import MEMORY, Tracker, well_observed
from torchslam.types import FrameFeatures, PoseEstimate

SCENE = Scene.of(300)
ROWS = rows_of(SCENE)
STEP = torch.tensor([-0.05, 0.02, 0.03, 0.01, 0.04, -0.02], dtype=torch.float64)  # from frame to frame
AWAY = pose(0, 0, 0, 0, 3.0)


def tracker(*overrides: str) -> Tracker:
    return Tracker(CAMERA, load_config(None, overrides))


def world(count: int = 4, **options: float) -> Submap:
    return world_in(SCENE, sideways(count), **options)  # type: ignore[arg-type]


def followed(where: Submap, view: FrameFeatures, by: Tracker | None = None) -> PoseEstimate:
    tracked = (by or tracker()).track(where, view)
    assert tracked is not None
    return tracked


# --- the track --------------------------------------------------------------------------------------------------


def test_follow_goes_on_from_a_keyframe() -> None:
    here = world(4)
    here.track.velocity, here.track.error, here.track.explained = pose(0.1), 0.7, 0.4
    tracker().follow(here, 2)
    track = here.track
    assert track.reference == 2
    torch.testing.assert_close(track.T_cr, pose())
    torch.testing.assert_close(here.T_cw, here.map.T_cw[2])
    assert torch.equal(track.velocity, pose(0.1))
    assert (track.error, track.explained) == (0.7, 0.4)
    assert int(track.local_keyframes[0]) == 2
    assert sorted(track.local_keyframes.tolist()) == [0, 1, 2, 3]
    seen = here.map.keyframes["point_ids"][2]
    assert torch.equal(track.seen_last, seen[seen >= 0])
    assert torch.equal(track.local_points, here.map.points_seen_by(torch.arange(4)))


def test_the_local_map_is_bounded() -> None:
    here, few = world(6), tracker("tracking.local_keyframes=2")
    few.follow(here, 0)
    assert here.track.local_keyframes.tolist() == [0, 1, 2]  # the nearest share most
    assert torch.equal(here.track.local_points, here.map.points_seen_by(torch.arange(3)))


def test_the_local_map_may_be_what_was_seen_lately() -> None:
    here, recent = world(4), tracker("tracking.recent_frames=5")
    last_seen = here.map.points["last_seen_frame"]
    last_seen[:] = 10
    last_seen[:20] = 15
    last_seen[20:30] = 11
    here.map.invalidate(torch.tensor([3]))
    recent.follow(here, 3)
    wanted = [row for row in range(30) if here.map.points["is_valid"][row]]
    assert here.track.local_points.tolist() == wanted
    last_seen[0] = 16
    recent.follow(here, 3)
    assert here.track.local_points.tolist() == [row for row in wanted if row < 20]


def test_a_prediction_repeats_the_last_motion() -> None:
    here, follower = world(), tracker()
    first = sideways(1, start=0.2)[0]
    path = [first, se3_exp(STEP) @ first, se3_exp(STEP) @ se3_exp(STEP) @ first]
    for index, T_cw in enumerate(path[:2]):
        followed(here, SCENE.view(50 + index, T_cw), follower)
    torch.testing.assert_close(here.track.velocity, se3_exp(STEP), atol=1e-7, rtol=0)
    torch.testing.assert_close(follower.predict(here), path[2], atol=1e-7, rtol=0)
    torch.testing.assert_close(here.T_cw, path[1], atol=1e-7, rtol=0)
    torch.testing.assert_close(tracker("tracking.motion_model=false").predict(here), here.T_cw)
    here.track.velocity = None
    torch.testing.assert_close(follower.predict(here), here.T_cw)


def test_a_frame_that_cannot_be_located_ends_the_motion() -> None:
    here = world()
    here.track.velocity = pose(0.1)
    before = here.T_cw.clone()
    assert tracker().track(here, SCENE.view(50, AWAY)) is None
    assert here.track.velocity is None
    assert torch.equal(here.T_cw, before)


def test_the_reference_is_the_local_keyframe_that_sees_most_of_what_is_seen() -> None:
    here, follower = world(5, noise=0.0), tracker()
    follower.follow(here, 4)
    T_cw = sideways(1, start=0.16)[0]
    view = SCENE.view(50, T_cw)
    tracked = followed(here, view, follower)
    shared = here.map.observers(tracked.point_ids)
    assert int(shared[here.track.reference]) == int(shared.max())
    assert here.track.reference != 4
    torch.testing.assert_close(here.T_cw, T_cw, atol=1e-7, rtol=0)
    torch.testing.assert_close(
        here.track.T_cr, T_cw @ se3_inverse(here.map.T_cw[here.track.reference]), atol=1e-7, rtol=0
    )
    assert torch.equal(here.track.seen_last, tracked.point_ids)
    assert here.track.velocity is not None
    last_seen = here.map.points["last_seen_frame"]
    assert (last_seen[tracked.point_ids] == 50).all()
    others = torch.ones(len(last_seen), dtype=torch.bool).index_fill(0, tracked.point_ids, False)
    assert (last_seen[others] == 0).all()


def test_the_track_remembers_the_last_ten_frames_or_so() -> None:
    here, follower = world(), tracker()
    here.track.error, here.track.explained = 2.0, 0.5
    tracked = followed(here, SCENE.view(50, sideways(1, start=0.4)[0], noise=0.5), follower)
    assert here.track.error == pytest.approx(2.0 + MEMORY * (tracked.error - 2.0))
    assert here.track.explained == pytest.approx(0.5 + MEMORY * (tracked.explained - 0.5))
    assert MEMORY == 0.1


def test_a_track_begins_anew_where_a_frame_was_found() -> None:
    here, follower = world(5), tracker()
    here.track.velocity, here.track.error, here.track.explained = pose(0.1), 3.0, 0.1
    view = SCENE.view(50, sideways(1, start=0.02)[0])
    tracked = followed(here.aside(), view, follower)
    here.map.points["last_seen_frame"][:] = 0
    follower.start_at(here, view, tracked)
    assert here.track.reference == 0
    assert here.track.velocity is None
    assert (here.track.error, here.track.explained) == (0.0, 1.0)
    assert torch.equal(here.track.seen_last, tracked.point_ids)
    torch.testing.assert_close(here.T_cw, tracked.T_cw)
    assert (here.map.points["last_seen_frame"][tracked.point_ids] == 50).all()


# --- one frame --------------------------------------------------------------------------------------------------


def test_a_frame_is_where_it_is_and_sees_what_it_sees() -> None:
    here, T_cw = world(), se3_exp(3 * STEP)
    view = SCENE.view(50, T_cw)
    visible = here.map.points["times_visible"].clone()
    tracked = followed(here, view)
    torch.testing.assert_close(tracked.T_cw, T_cw, atol=1e-7, rtol=0)
    assert torch.equal(tracked.point_ids, ROWS[SCENE.shows(50)[tracked.keypoints]])
    assert tracked.matches == tracked.inliers > 150
    assert tracked.error < 1e-12
    assert tracked.coverage == 1.0
    depth = transform(T_cw, here.map.positions_w[tracked.point_ids])[:, 2].median()
    assert tracked.depth == pytest.approx(float(depth), abs=1e-6)
    assert tracked.expected is not None
    assert torch.isin(tracked.point_ids, tracked.expected).all()
    assert torch.equal(here.map.points["times_visible"], visible)  # it is not believed yet


def test_a_frame_that_is_believed_speaks_for_what_it_saw_and_should_have_seen() -> None:
    here, follower = world(), tracker()
    points, tracked = here.map.points, followed(here, SCENE.view(50, se3_exp(3 * STEP)))
    tracked = replace(tracked, point_ids=tracked.point_ids[:50])
    visible, found = points["times_visible"].clone(), points["times_found"].clone()
    follower.expect(here.map, tracked)
    follower.vouch(here.map, tracked)
    assert tracked.expected is not None
    assert torch.nonzero(points["times_visible"] - visible)[:, 0].tolist() == sorted(
        tracked.expected.tolist()
    )
    assert torch.nonzero(points["times_found"] - found)[:, 0].tolist() == sorted(tracked.point_ids.tolist())
    follower.expect(here.map, replace(tracked, expected=None))
    assert (points["times_visible"] - visible)[tracked.point_ids].tolist() == [2] * 50
    follower.counts = False
    follower.expect(here.map, tracked)
    assert int((points["times_visible"] - visible).max()) == 2


def test_the_error_is_in_units_of_the_noise() -> None:
    medians = [followed(world(), SCENE.view(50 + n, se3_exp(n * STEP), noise=0.7)).error for n in range(6)]
    # The median of a chi-square of two degrees of freedom is 1.386; six parameters of 400 residuals are fitted.
    assert sum(medians) / len(medians) == pytest.approx(1.386 * 0.7**2, rel=0.15)


def few(here: Submap, count: int) -> None:
    """Leave the map so many of the points that all keyframes see."""
    everyone = torch.nonzero(here.map.points["times_observed"] == here.map.num_keyframes)[:, 0]
    rest = here.map.valid_points()
    here.map.invalidate(rest[~torch.isin(rest, everyone[:count])])
    tracker().follow(here, here.map.num_keyframes - 1)


@pytest.mark.parametrize(("setting", "count"), [("min_matches", 30), ("min_inliers", 30)])
def test_fewer_points_than_are_needed_give_no_pose(setting: str, count: int) -> None:
    here = world(2)
    few(here, count)
    view = SCENE.view(50, sideways(1, start=0.1)[0])
    enough = followed(here.aside(), view, tracker(f"tracking.{setting}={count}"))
    assert enough.inliers == count
    assert tracker(f"tracking.{setting}={count + 1}").track(here.aside(), view) is None


def test_enough_matches_must_agree_in_the_end() -> None:
    here = world(2)
    few(here, 40)
    view = SCENE.view(50, sideways(1, start=0.1)[0])
    wrong = SCENE.at(50)[torch.argsort(ROWS)[here.map.valid_points()[:12]]]
    off = view.keypoints.clone()
    off[wrong, 1] += 4.5 * view.scales[wrong]  # near enough to match, too far to agree
    spoiled = replace(view, keypoints=off)
    tracked = followed(here.aside(), spoiled, tracker("tracking.min_inliers=28"))
    assert (tracked.inliers, tracked.matches) == (28, 40)
    assert tracker("tracking.min_inliers=29").track(here.aside(), spoiled) is None


def located(here: Submap, view: FrameFeatures, T_cw: Tensor) -> PoseEstimate | None:
    """Track a view from a prediction."""
    aside = here.aside()
    aside.track.T_cr = T_cw @ se3_inverse(here.map.T_cw[here.track.reference])
    aside.track.velocity = None
    other = view.descriptors.clone()
    other[:, 0] ^= 255  # eight bits of noise: no nearest neighbour is a billion times nearer than the second
    return tracker("matching.max_ratio=1e-9").track(aside, replace(view, descriptors=other))


@pytest.mark.parametrize(("pixels", "found"), [(10.0, True), (35.0, True), (110.0, False)])
def test_matches_are_looked_for_near_the_prediction(pixels: float, found: bool) -> None:
    """Scales are one to three pixels: the first window is 12 to 36 pixels wide, the second 36 to 108.

    With a ratio test that nothing passes, matches without a place are out of the question.
    """
    here = world(3)
    T_cw = sideways(1, start=0.2)[0]
    turned = pose(0, 0, 0, 0, math.atan(pixels / 200.0)) @ T_cw
    tracked = located(here, SCENE.view(50, T_cw), turned)
    assert (tracked is not None) is found


def test_without_a_place_to_look_descriptors_alone_decide() -> None:
    here = world(3)
    T_cw = sideways(1, start=0.2)[0]
    here.track.T_cr = AWAY
    here.track.velocity = None
    tracked = followed(here, SCENE.view(50, T_cw))
    torch.testing.assert_close(tracked.T_cw, T_cw, atol=1e-7, rtol=0)


def test_points_that_died_are_not_looked_for() -> None:
    here = world(3)
    dead = here.track.seen_last[:20]
    here.map.invalidate(dead)
    tracked = followed(here, SCENE.view(50, sideways(1, start=0.2)[0]))
    assert not torch.isin(tracked.point_ids, dead).any()


# --- the parts --------------------------------------------------------------------------------------------------


def test_points_count_as_well_observed_when_three_local_keyframes_see_them() -> None:
    here = world(4)
    table = here.map.keyframes["point_ids"]

    def seen(keyframe: int) -> set[int]:
        return {row for row in table[keyframe].tolist() if row >= 0}

    local = torch.arange(4)
    wanted = [row for row in seen(3) if sum(row in seen(other) for other in range(4)) >= 3]
    assert well_observed(here.map, 3, local) == len(wanted) < len(seen(3))
    assert well_observed(here.map, 3, torch.tensor([3, 2])) == len(seen(3) & seen(2))
    assert here.track.reference_size == len(wanted)


def test_cells_number_the_image_row_by_row() -> None:
    pixels = torch.tensor(
        [[0.0, 0], [39.9, 39.9], [40.0, 0], [0, 40.0], [319.4, 239.4], [-0.5, -0.5], [320.0, 240.0]]
    ).double()
    assert cells(pixels, (320, 240)).tolist() == [0, 0, 1, 8, 47, 0, 47]
    assert CELLS == (8, 6)


def test_old_points_are_heard_alone_where_they_are_enough() -> None:
    times = torch.tensor([SENIOR, SENIOR - 1, SENIOR + 5, 0, SENIOR])
    assert trusted(times, 3).tolist() == [0, 2, 4]
    assert trusted(times, 4).tolist() == [0, 1, 2, 3, 4]


def test_every_cell_has_a_voice() -> None:
    crowd = torch.tensor([[10.0, 10.0]]).expand(12, 2)
    pixels = torch.cat([crowd, torch.tensor([[300.0, 200.0], [100.0, 10.0]]), crowd]).double()
    chosen = spread(pixels, (320, 240))
    assert chosen.tolist() == [0, 1, 2, 3, 4, 12, 13]
    assert PER_CELL == 5


def test_a_crowd_has_no_more_to_say_than_a_few() -> None:
    crowd = torch.tensor([[10.0, 10.0]]).expand(2 * CROWD, 2)
    few = torch.tensor([[100.0, 10.0]]).expand(CROWD, 2)
    weights = voices(torch.cat([crowd, few, few[:1] + 100]).double(), (320, 240))
    assert weights.tolist() == [0.5] * 2 * CROWD + [1.0] * (CROWD + 1)


def test_what_is_explained_is_the_share_of_the_cells_with_keypoints_that_are_used() -> None:
    places = (
        [(10.0, 10.0)] * 3
        + [(100.0, 10.0)] * 2
        + [(300.0, 200.0)] * 2
        + [(10.0, 200.0)]
        + [(200.0, 100.0)] * 2
    )
    view = SCENE.view(0, pose())
    mask = torch.arange(len(places)) < 8  # the last two are no keypoints
    some = replace(view, keypoints=torch.tensor(places).double(), mask=mask)
    for used, share in (([0, 3, 5], 1.0), ([1, 2], 1 / 3), ([4, 6, 7], 2 / 3), ([7], 0.0)):
        assert explained(some, torch.tensor(used), (320, 240)) == pytest.approx(share)
    nothing = replace(some, mask=torch.zeros_like(mask))
    assert explained(nothing, torch.tensor([0]), (320, 240)) == 1.0


def test_a_tracker_that_does_not_count_leaves_the_map_as_it_is() -> None:
    here, follower = world(), tracker()
    follower.counts = False
    before = {name: column.clone() for name, column in here.map.points.columns().items()}
    tracked = followed(here, SCENE.view(50, sideways(1, start=0.2)[0]), follower)
    follower.vouch(here.map, tracked)
    follower.start_at(here, SCENE.view(51, sideways(1, start=0.2)[0]), tracked)
    assert all(torch.equal(column, before[name]) for name, column in here.map.points.columns().items())
    follower.counts = True
    follower.vouch(here.map, tracked)
    found = here.map.points["times_found"] - before["times_found"]
    assert torch.equal(torch.nonzero(found)[:, 0], tracked.point_ids.sort().values)
    assert int(found.max()) == 1


def test_coverage_is_the_share_of_the_cells_that_have_a_fifth_of_what_is_expected() -> None:
    here = world()
    ids = here.map.valid_points()[:30]
    here.map.points["times_found"][ids] = SENIOR
    ten, five = [(10.0, 10.0)] * 10, [(100.0, 10.0)] * 5
    twos = [(300.0, 200.0), (300.0, 100.0), (300.0, 10.0)] * 2
    places = [*ten, *five, *twos, (10.0, 200.0)]
    expected = Projected(ids[:22], torch.tensor(places).double(), torch.ones(22), torch.zeros(22))

    def share(*seen: int) -> float:
        return coverage(here.map, expected, ids[list(seen)], (320, 240))

    assert share(*range(22)) == 1.0
    assert share(0, 1, 10, 15, 16, 17) == 1.0  # a fifth of each
    assert share(0, 10, 15, 16, 17) == pytest.approx(4 / 5)  # a tenth of the first
    assert share(0, 1) == pytest.approx(1 / 5)
    assert share(21) == 0.0  # a single point is no expectation
    here.map.points["times_found"][ids[10:15]] = SENIOR - 1  # young points are not expected
    assert share() == 1.0  # four cells are too few to say anything


# --- correspondences --------------------------------------------------------------------------------------------


def projected(
    here: Submap, T_cw: Tensor, angle: float = 60.0, scales: tuple[float, float] = (0.1, 50.0)
) -> Projected:
    return project_points(here.map, here.map.valid_points(), T_cw, CAMERA, angle, scales)


def test_the_expected_scale_falls_with_the_distance() -> None:
    here = world(1)
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
def test_points_seen_from_another_side_are_left_out(limit: float) -> None:
    here = world(1)
    here.map.points["is_valid"][here.map.keyframes["point_ids"][0].clamp(min=0)] = True
    middle = torch.tensor([0.0, 0.0, 4.0], dtype=torch.float64)
    angle = math.radians(30.0)
    turn = pose(0, 0, 0, 0, angle)
    T_cw = turn.clone()
    T_cw[:3, 3] = middle - turn[:3, :3] @ middle  # looks at the middle of the scene from 30 degrees aside
    rays = here.map.positions_w - centre(T_cw)
    between = (rays * here.map.positions_w).sum(-1) / (rays.norm(dim=-1) * here.map.positions_w.norm(dim=-1))
    alike = torch.rad2deg(between.acos()) < limit
    kept = projected(here, T_cw, limit).ids
    assert alike[kept].all()
    assert 0 < len(kept) < 300
    pixels, valid = CAMERA.project(transform(T_cw, here.map.positions_w))
    wanted = alike & valid & CAMERA.in_image(pixels) & here.map.points["is_valid"]
    assert torch.equal(kept, torch.nonzero(wanted)[:, 0])


def test_a_track_of_a_moved_world_is_the_same_track() -> None:
    """Nothing depends on where the origin of the world is, nor on its unit."""
    S = torch.eye(4, dtype=torch.float64)
    S[:3] = se3_exp(torch.tensor([1.0, -2.0, 3.0, 0.3, 1.0, -0.5], dtype=torch.float64))[:3]
    S[:3, :3] *= 2.5
    T_cw = se3_exp(3 * STEP)
    here, there = world(), world(S_ws=S)  # type: ignore[arg-type]
    one = followed(here, SCENE.view(50, T_cw, noise=0.5))
    two = followed(there, SCENE.view(50, T_cw, noise=0.5))
    torch.testing.assert_close(two.T_cw, moved(one.T_cw, S), atol=1e-6, rtol=0)
    assert two.depth == pytest.approx(2.5 * one.depth, rel=1e-6)
    assert (two.inliers, two.matches) == (one.inliers, one.matches)
    assert two.error == pytest.approx(one.error, rel=1e-4)
    units = torch.tensor([2.5] * 3 + [1.0] * 3, dtype=torch.float64)
    torch.testing.assert_close(two.covariance, units[:, None] * one.covariance * units, rtol=1e-3, atol=1e-12)


def test_where_the_last_frames_are_in_doubt_the_pose_is_not_looked_for_next_to_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[bool] = []
    follower, here, view = tracker(), world(), SCENE.view(50, sideways(1, start=0.7)[0])
    monkeypatch.setattr(
        "torchslam.tracking.localizer.nearby_pose", lambda *_: asked.append(True)
    )  # and RANSAC finds it
    for is_sure, wanted in ((False, []), (True, [True])):
        aside = here.aside()
        assert follower.track(aside, view, is_sure) is not None
        assert asked == wanted
