"""Tracks and their points: joined from matches, found by consensus, put into a map."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from tests.global_mapping.synthetic import Recording, arc, ball, line, rand, randn, view_pair
from torchslam.geometry import se3_exp, se3_inverse, so3_exp
from torchslam.global_mapping.tracks import (
    MIN_PARALLAX,
    Tracks,
    held_parts,
    join_matches,
    longest_tracks,
    make_map,
    parallax,
    ray_errors,
    triangulate_tracks,
    without_empty_rows,
)
from torchslam.map.map import KEYPOINT_COLUMNS

TOLERANCE = 0.01


def rows(tracks: Tracks) -> list[tuple[int, int, int]]:
    """Track, image and keypoint of each observation."""
    return list(zip(tracks.track.tolist(), tracks.view.tolist(), tracks.keypoint.tolist(), strict=True))


def tracks_of(*lengths: int) -> Tracks:
    """Tracks of these lengths, each seen by the images from the first on."""
    track = torch.arange(len(lengths)).repeat_interleave(torch.tensor(lengths, dtype=torch.int64))
    view = torch.tensor([row for length in lengths for row in range(length)], dtype=torch.int64)
    return Tracks(track, view, torch.zeros_like(track))


# --- joining ---------------------------------------------------------------------------------------------------


def test_connected_matches_are_one_track() -> None:
    """Numbered by their lowest image and keypoint, the observations by image."""
    pairs = [
        view_pair(1, 2, (2, 0)),
        view_pair(0, 1, (5, 6), (4, 2)),
        view_pair(0, 3, (7, 7)),
        view_pair(1, 3, (0, 1)),
    ]
    tracks = join_matches(pairs, views=4, keypoints=8)
    assert rows(tracks) == [
        *((0, 0, 4), (0, 1, 2), (0, 2, 0)),
        *((1, 0, 5), (1, 1, 6)),
        *((2, 0, 7), (2, 3, 7)),
        *((3, 1, 0), (3, 3, 1)),
    ]
    assert (tracks.count, len(tracks), tracks.lengths.tolist()) == (4, 9, [3, 2, 2, 2])


def test_no_matches_are_no_tracks() -> None:
    for pairs in ([], [view_pair(0, 1)]):
        tracks = join_matches(pairs, views=3, keypoints=4)
        assert (tracks.count, len(tracks), tracks.lengths.tolist()) == (0, 0, [])
    assert join_matches([], views=0, keypoints=0).count == 0


@given(st.integers(2, 6), st.integers(1, 5), st.data())
@settings(max_examples=60, deadline=None)
def test_tracks_are_the_connected_components_of_matches(
    views: int, keypoints: int, data: st.DataObject
) -> None:
    images, points = st.integers(0, views - 1), st.integers(0, keypoints - 1)
    matches = data.draw(
        st.lists(
            st.tuples(images, images, points, points).filter(lambda match: match[0] < match[1]), max_size=20
        )
    )
    parts = {(view, point): {(view, point)} for view in range(views) for point in range(keypoints)}
    for first, second, one, other in matches:
        joined = parts[first, one] | parts[second, other]
        for node in joined:
            parts[node] = joined
    expected = []
    for part in {min(part): part for part in parts.values()}.values():
        images_of = [view for view, _ in part]
        kept = sorted(node for node in part if images_of.count(node[0]) == 1)
        if len(kept) > 1:
            expected.append((min(part), kept))
    pairs = [view_pair(first, second, (one, other)) for first, second, one, other in matches]
    found = rows(join_matches(pairs, views, keypoints))
    assert found == [(number, *node) for number, (_, part) in enumerate(sorted(expected)) for node in part]


def test_tracks_with_enough_observations_left_are_selected() -> None:
    """Renumbered without gaps, and it is known which they were."""
    tracks = tracks_of(3, 2, 4)
    keep = torch.tensor([True, True, False, True, False, False, True, True, True])
    selected, former = tracks.select(keep)
    assert rows(selected) == [(0, 0, 0), (0, 1, 0), (1, 1, 0), (1, 2, 0), (1, 3, 0)]
    assert former.tolist() == [0, 2]
    for least, kept in ((1, [0, 1, 2]), (2, [0, 2]), (3, [2]), (4, [])):
        selected, former = tracks.select(keep, least)
        assert former.tolist() == kept
        assert selected.count == len(kept)
        assert len(selected) == int((keep & torch.isin(tracks.track, former)).sum())


# --- the longest tracks ----------------------------------------------------------------------------------------


@given(st.integers(0, 1000), st.integers(1, 4))
@settings(max_examples=30, deadline=None)
def test_every_image_keeps_its_longest_tracks(seed: int, per_view: int) -> None:
    seen = rand(seed, 12, 6) < 0.5  # points by images
    seen[:, :2] = True
    track, view = seen.nonzero().unbind(-1)
    tracks = Tracks(track, view, track)
    chosen = longest_tracks(tracks, per_view)
    needed = set()
    for row in range(6):
        own = seen[:, row].nonzero()[:, 0].tolist()
        needed |= set(sorted(own, key=lambda point: (-int(seen[point].sum()), point))[:per_view])
    assert set(chosen.nonzero()[:, 0].tolist()) == needed


# --- points ----------------------------------------------------------------------------------------------------


def looking(points_w: Tensor, centers_w: Tensor, tracks: Tracks) -> tuple[Tensor, Tensor]:
    """Exact rays and centers of the observations."""
    centers_w = centers_w[tracks.view]
    return torch.nn.functional.normalize(points_w[tracks.track] - centers_w, dim=-1), centers_w


class Found(NamedTuple):
    points_w: Tensor
    agrees: Tensor
    parallax_rad: Tensor


def triangulated(
    tracks: Tracks, rays_w: Tensor, centers_w: Tensor, tolerance: float | Tensor = TOLERANCE
) -> Found:
    tolerances = torch.as_tensor(tolerance, dtype=rays_w.dtype).expand(len(tracks))
    found = triangulate_tracks(tracks, rays_w, centers_w, tolerances)
    return Found(*found, parallax(tracks, centers_w, *found))


def turned(rays_w: Tensor, row: int, angle: float) -> Tensor:
    """The rays, one of them turned by an angle."""
    axis = torch.nn.functional.normalize(
        torch.linalg.cross(rays_w[row], rays_w.new_tensor([0.0, 1, 0])), dim=-1
    )
    rays_w = rays_w.clone()
    rays_w[row] = so3_exp(angle * axis) @ rays_w[row]
    return rays_w


CENTERS = se3_inverse(arc(12))[:, :3, 3]
POINTS = ball(5)


def test_exact_rays_meet_in_the_point() -> None:
    tracks = tracks_of(2, 3, 12, 7, 4)
    found = triangulated(tracks, *looking(POINTS, CENTERS, tracks))
    torch.testing.assert_close(found.points_w, POINTS, atol=1e-10, rtol=0)
    assert bool(found.agrees.all())


@given(st.integers(0, 10_000), st.floats(1e-3, 1e3))
@settings(max_examples=25, deadline=None)
def test_points_move_with_the_cameras(seed: int, scale: float) -> None:
    """Turned, moved and scaled cameras have turned, moved and scaled points, and the same observations agree."""
    tracks = tracks_of(6, 3, 9, 2, 5)
    rays_w, centers_w = looking(POINTS, CENTERS, tracks)
    rays_w = torch.nn.functional.normalize(rays_w + 0.004 * randn(seed, *rays_w.shape), dim=-1)
    found = triangulated(tracks, rays_w, centers_w)
    T = se3_exp(randn(seed + 1, 6))
    moved = triangulated(tracks, rays_w @ T[:3, :3].mT, scale * (centers_w @ T[:3, :3].mT + T[:3, 3]))
    expected = scale * (found.points_w @ T[:3, :3].mT + T[:3, 3])
    torch.testing.assert_close(moved.points_w, expected, atol=1e-7 * scale, rtol=0)
    assert torch.equal(moved.agrees, found.agrees)
    torch.testing.assert_close(moved.parallax_rad, found.parallax_rad, atol=1e-7, rtol=0)


@pytest.mark.parametrize("wrong", range(4))
def test_one_wrong_observation_of_four_is_left_out(wrong: int) -> None:
    """Whichever it is; the point is that of the others, as if it were not there, also in other tracks."""
    tracks = tracks_of(3, 4, 3)
    rays_w, centers_w = looking(POINTS[:3], CENTERS[::3], tracks)
    found = triangulated(tracks, turned(rays_w, 3 + wrong, 0.1), centers_w)
    torch.testing.assert_close(found.points_w, POINTS[:3], atol=1e-9, rtol=0)
    expected = torch.ones(10, dtype=torch.bool)
    expected[3 + wrong] = False
    assert torch.equal(found.agrees, expected)


@pytest.mark.parametrize("right", [(0, 4), (0, 2), (2, 4), (1, 3), (0, 1), (3, 4)])
def test_two_right_observations_of_five_are_found(right: tuple[int, int]) -> None:
    """If they are the ends, a half, the middle or a quarter of the track; the wrong rays miss each other."""
    tracks = tracks_of(5)
    rays_w, centers_w = looking(POINTS[:1], CENTERS[::2], tracks)
    for row in set(range(5)) - set(right):
        rays_w[row] = torch.nn.functional.normalize(rays_w[row] + 0.2 * randn(row, 3), dim=-1)
    found = triangulated(tracks, rays_w, centers_w, 1e-4)
    torch.testing.assert_close(found.points_w, POINTS[:1], atol=1e-9, rtol=0)
    assert found.agrees.nonzero()[:, 0].tolist() == list(right)


def test_the_hypothesis_with_the_least_errors_wins() -> None:
    """The ends of the track miss the others by less than the tolerance; the exact ones count for more."""
    tracks = tracks_of(5)
    rays_w, centers_w = looking(POINTS[:1], CENTERS[::2], tracks)
    # Hypotheses with an end are off by nearly the tolerance for all but the rays they come from.
    rays_w = turned(turned(rays_w, 0, 0.0145), 4, 0.0145)
    found = triangulated(tracks, rays_w, centers_w)
    assert found.agrees.tolist() == [False, True, True, True, False]
    torch.testing.assert_close(found.points_w, POINTS[:1], atol=1e-9, rtol=0)


@pytest.mark.parametrize(("factor", "agrees"), [(0.95, True), (1.05, False)])
def test_the_tolerance_is_that_of_each_observation(factor: float, agrees: bool) -> None:
    """Of many exact observations and one that is off; and so with a tolerance of its own."""
    tracks = tracks_of(12, 12)
    rays_w, centers_w = looking(POINTS[:2], CENTERS, tracks)
    tolerance = torch.full((24,), 1e-3, dtype=torch.float64)
    tolerance[19] = 0.004
    rays_w = turned(turned(rays_w, 7, factor * 1e-3), 19, factor * 0.004)
    found = triangulated(tracks, rays_w, centers_w, tolerance)
    assert found.agrees.tolist() == [row not in (7, 19) or agrees for row in range(24)]


def test_points_behind_the_cameras_do_not_agree() -> None:
    """Rays that go apart meet behind: nothing agrees, and what nothing agrees with is finite and has no parallax."""
    tracks = tracks_of(2, 4, 2)
    rays_w, centers_w = looking(POINTS[:3], CENTERS[::3], tracks)
    rays_w[:6] *= -1
    found = triangulated(tracks, rays_w, centers_w)
    assert found.agrees.tolist() == [False] * 6 + [True] * 2
    torch.testing.assert_close(found.points_w[:2], POINTS[:2], atol=1e-9, rtol=0)  # the best hypothesis
    assert found.parallax_rad[:2].tolist() == [0, 0]
    assert float(found.parallax_rad[2]) > 0.1


def test_parallel_rays_have_no_parallax() -> None:
    """They agree with a point far ahead of both; where the camera did not move, there is none."""
    tracks = tracks_of(2, 2, 2)
    ray = torch.tensor([0.0, 0, 1], dtype=torch.float64)
    centers_w = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 0, 0], [0, 0, 1], [2, 3, 4], [2, 3, 4]]).double()
    found = triangulated(tracks, ray.expand(6, 3), centers_w)
    assert found.agrees.tolist() == [True, True, True, True, False, False]
    assert float(found.points_w[0, 2]) == pytest.approx(1e6, rel=1e-6)
    assert float(found.points_w[0, 0]) == pytest.approx(0.5)
    assert float(found.points_w[1, 2]) == pytest.approx(1e6, rel=1e-5)
    assert found.points_w[2].tolist() == [2, 3, 4]
    assert float(found.parallax_rad.max()) < 1e-3 * MIN_PARALLAX


def test_points_have_the_least_angles_to_their_rays() -> None:
    """Distances from rays are divided by that from the camera: checked by linear least squares."""
    tracks = tracks_of(6)
    reach = torch.tensor([1.0, 1.2, 6.0, 8.0, 2.0, 9.0], dtype=torch.float64)
    centers_w = POINTS[:1] + reach[:, None] * torch.nn.functional.normalize(randn(3, 6, 3), dim=-1)
    rays_w, _ = looking(POINTS[:1], centers_w, tracks)
    rays_w = torch.nn.functional.normalize(rays_w + 1e-7 * randn(4, 6, 3), dim=-1)
    found = triangulated(tracks, rays_w, centers_w)
    across = np.eye(3) - rays_w.numpy()[:, :, None] * rays_w.numpy()[:, None]
    A = across / reach.numpy()[:, None, None]
    expected = np.linalg.lstsq(A.reshape(-1, 3), (A @ centers_w.numpy()[:, :, None]).reshape(-1), rcond=None)[
        0
    ]
    np.testing.assert_allclose(found.points_w[0].numpy(), expected, atol=1e-12)
    assert float((found.points_w - POINTS[:1]).norm()) > 1e-9


def test_the_parallax_is_that_between_agreeing_observations() -> None:
    """The first of these and the most different one: 20 degrees to one side, 35 to the other, 70 that do not agree."""
    angles = torch.deg2rad(torch.tensor([70.0, 0, 20, -35, 10], dtype=torch.float64))
    centers_w = -3 * torch.stack([angles.sin(), torch.zeros_like(angles), angles.cos()], -1)
    tracks = Tracks(
        torch.tensor([0, 1, 1, 1, 1, 1, 2]), torch.tensor([0, 0, 1, 2, 3, 4, 0]), torch.zeros(7).long()
    )
    points_w = torch.zeros(3, 3, dtype=torch.float64)
    agrees = torch.tensor([True, False, True, True, True, True, False])
    found = parallax(tracks, centers_w[tracks.view], points_w, agrees)
    torch.testing.assert_close(torch.rad2deg(found), torch.tensor([0.0, 35, 0]).double())
    agrees[4] = False
    assert math.degrees(parallax(tracks, centers_w[tracks.view], points_w, agrees)[1]) == pytest.approx(20)
    nothing = tracks_of()
    assert parallax(nothing, centers_w[:0], points_w[:0], agrees[:0]).tolist() == []


def test_angles_between_rays_and_points_are_known() -> None:
    """Ahead, a fifth of a degree off, to the side, behind, and at the center, which no camera sees."""
    ray = torch.tensor([0.0, 0, 1], dtype=torch.float64).expand(5, 3)
    centers_w = torch.tensor([1.0, 2, 3], dtype=torch.float64).expand(5, 3)
    aside = 3 * math.tan(math.radians(0.2))
    off = torch.tensor([[0, 0, 2], [aside, 0, 3], [0, 5, 0], [0, 0, -1], [0, 0, 0]], dtype=torch.float64)
    found = torch.rad2deg(ray_errors(ray, centers_w, centers_w + off))
    torch.testing.assert_close(found, torch.tensor([0.0, 0.2, 90, 180, 180]).double(), atol=1e-6, rtol=0)


def test_a_view_loses_the_rows_after_its_last_keypoint() -> None:
    full = Recording.of(line(2), ball(12)).views[0]
    mask = torch.zeros(12, dtype=torch.bool)
    assert len(without_empty_rows(replace(full, mask=mask)).mask) == 0
    mask[[0, 5]] = True
    old = replace(full, mask=mask)
    view = without_empty_rows(old)
    for name in KEYPOINT_COLUMNS:
        assert torch.equal(getattr(view, name), getattr(old, name)[:6])
        size = getattr(view, name).untyped_storage().nbytes()
        assert size < getattr(old, name).untyped_storage().nbytes() or size == 0
    assert without_empty_rows(view) is view


# --- the map ---------------------------------------------------------------------------------------------------


def test_a_map_has_the_observations_of_the_tracks() -> None:
    recording = Recording.of(line(3), torch.tensor([0.0, 0, 4]) + ball(12), first=7)
    tracks = Tracks(
        torch.tensor([0, 0, 1, 1, 1, 2, 2]),
        torch.tensor([1, 2, 0, 1, 2, 0, 2]),
        torch.tensor([5, 6, 7, 8, 9, 1, 0]),
    )
    points_w = torch.tensor([[0.0, 0, 4], [1, 0, 4], [2, 0, 4]], dtype=torch.float64)
    made = make_map(recording.views, recording.T_cw, tracks, points_w)
    seen = made.observations()
    assert seen.keyframe_index.tolist() == [0, 0, 1, 1, 2, 2, 2]
    assert seen.keypoint_index.tolist() == [1, 7, 5, 8, 0, 6, 9]
    assert made.positions_w[seen.point_index][:, 0].tolist() == [2, 1, 0, 1, 2, 0, 1]
    torch.testing.assert_close(made.T_cw, recording.T_cw)
    assert made.keyframes["frame_index"].tolist() == [7, 8, 9]
    order = torch.argsort(made.positions_w[:, 0])
    assert made.points["first_keyframe"][order].tolist() == [1, 0, 0]
    assert made.points["last_seen_frame"][order].tolist() == [8, 7, 7]
    assert made.points["times_observed"][order].tolist() == [2, 3, 2]
    # What points look like is read from their newest observations.
    newest = recording.views[2].descriptors[torch.tensor([6, 9, 0])]
    torch.testing.assert_close(made.points["descriptors"][order], newest)
    seen_w = torch.nn.functional.normalize(points_w - torch.tensor([0.5, 0, 0]), dim=-1)
    torch.testing.assert_close(made.points["view_directions_w"][order], seen_w)


@pytest.mark.parametrize("shared", [4, 5])
def test_images_are_held_together_by_shared_points(shared: int) -> None:
    """Images 0 to 2 share ten points, 3 and 4 nine, and 2 and 3 some."""
    rows = []
    for views, count in (((0, 1, 2), 10), ((3, 4), 9), ((2, 3), shared)):
        for _ in range(count):
            number = len({row[0] for row in rows})
            rows += [(number, view, number) for view in views]
    tracks = Tracks(*(torch.tensor(column) for column in zip(*rows, strict=True)))
    everything = torch.ones(len(tracks), dtype=torch.bool)
    other = 0 if shared == 5 else 3
    assert held_parts(tracks, everything, 6, least_shared=5).tolist() == [0, 0, 0, other, other, 5]
    assert held_parts(tracks, tracks.view > 2, 6, least_shared=5).tolist() == [0, 1, 2, 3, 3, 5]
