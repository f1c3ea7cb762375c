"""Rounds of adjustment and filtering: the gates, one adjustment, and all rounds from approximate poses."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.global_mapping.synthetic import CAMERA, EYE, SIGMA_PX, Recording, apart, arc, ball, disturbed, line
from torchslam.geometry import Camera, KeypointNoise, se3_inverse, transform
from torchslam.geometry.camera_measurement import CameraMeasurement
from torchslam.global_mapping import rounds
from torchslam.global_mapping.rounds import (
    COARSE,
    FINE,
    ObservedTracks,
    Reconstruction,
    adjust,
    adjust_in_rounds,
)
from torchslam.global_mapping.tracks import Tracks
from torchslam.optim import BundleProblem

SCENE = Recording.of(arc(10, 120.0, 2.5), ball(100))
NOISY = Recording.of(arc(10, 120.0, 2.5), ball(80), noise_px=0.2, wrong=0.2, seed=12)
"""With a seed for which two right observations propose every point."""
RIGHT = NOISY.tracks.keypoint >= 16


def exact(recording: Recording, agrees: bool = False) -> Reconstruction:
    """The true poses and points."""
    return Reconstruction(
        recording.T_cw, CAMERA, recording.points_w, torch.full((len(recording.tracks),), agrees)
    )


def moved(observed: ObservedTracks, row: int, pixels: float) -> ObservedTracks:
    """The tracks, one observation so many pixels lower."""
    at = observed.pixels.clone()
    at[row, 1] += pixels
    return replace(observed, pixels=at)


# --- observed tracks -------------------------------------------------------------------------------------------


def test_observations_have_the_pixels_and_the_noise_of_their_keypoints() -> None:
    """A keypoint is precise to half of its scale, or as its feature extractor says."""
    scales = [torch.linspace(1, 3, 100, dtype=torch.float64) + row for row in range(3)]
    views = [replace(view, scales=scale) for view, scale in zip(SCENE.views, scales, strict=False)]
    tracks = Tracks(torch.tensor([0, 0, 1, 1]), torch.tensor([0, 2, 1, 2]), torch.tensor([5, 7, 99, 0]))
    observed = ObservedTracks.of(tracks, views)
    for row, (view, keypoint) in enumerate(((0, 5), (2, 7), (1, 99), (2, 0))):
        assert torch.equal(observed.pixels[row], views[view].keypoints[keypoint])
        assert float(observed.noise.sigmas[row]) == pytest.approx(float(scales[view][keypoint]) / 2)
    information = [(row + torch.arange(100.0, dtype=torch.float64)[:, None] + 1) for row in range(3)]
    views = [replace(view, information=info) for view, info in zip(views, information, strict=True)]
    observed = ObservedTracks.of(tracks, views)
    assert observed.noise.weights.tolist() == [6, 10, 101, 3]
    kept = observed.select(torch.tensor([False, True]))
    assert (kept.tracks.track.tolist(), kept.tracks.view.tolist()) == ([0, 0], [1, 2])
    assert kept.tracks.keypoint.tolist() == [99, 0]
    assert torch.equal(kept.pixels, observed.pixels[2:])
    assert kept.noise.weights.tolist() == [101, 3]


def test_errors_are_in_standard_deviations() -> None:
    """Three and four pixels are five; a point behind or beside the camera is infinitely off."""
    points_w = torch.tensor([[0.0, 0, 2], [0.5, 0.2, 4], [0, 0, -2], [1, 0, 0]], dtype=torch.float64)
    pixels = torch.tensor(
        [[322.5, 243.5], [369.5, 259.5], [319.5, 239.5], [319.5, 239.5]], dtype=torch.float64
    )
    noise = KeypointNoise(torch.tensor([1.0, 3, 1, 1]).double(), torch.zeros(4, 0).double())
    rows = torch.arange(4)
    observed = ObservedTracks(Tracks(rows, rows * 0, rows), pixels, noise.with_explicit_information())
    found = Reconstruction(EYE[None], CAMERA, points_w, rows > 9)
    assert observed.errors(found).tolist() == [10, 0, math.inf, math.inf]
    away = replace(found, T_cw=se3_along(-1.0)[None])
    assert observed.errors(away)[1] == pytest.approx(math.hypot(400 * 0.5 / 3 - 50, 400 * 0.2 / 3 - 20) / 1.5)


def test_points_that_a_camera_cannot_show_are_infinitely_off() -> None:
    """Where distortion would fold the image over, as well as behind a wide lens that sees to the side."""
    sight = torch.tensor([[2.0, 0, 1], [2, 0, -0.5], [0, 0, 1]], dtype=torch.float64)
    rows = torch.arange(3)
    noise = KeypointNoise(torch.ones(3).double(), torch.zeros(3, 0).double()).with_explicit_information()
    observed = ObservedTracks(Tracks(rows, rows * 0, rows), torch.zeros(3, 2).double(), noise)
    radial = torch.tensor([400, 400, 319.5, 239.5, -0.5, 0, 0, 0, 0], dtype=torch.float64)
    wide = torch.tensor([200, 200, 319.5, 239.5, 0, 0, 0, 0], dtype=torch.float64)
    for camera, shown in (
        (Camera("radial_tangential", radial, CAMERA.size), [False, False, True]),
        (Camera("fisheye", wide, CAMERA.size), [True, False, True]),
    ):
        errors = observed.errors(Reconstruction(EYE[None], camera, sight, rows > 9))
        assert torch.isfinite(errors).tolist() == shown


def se3_along(z: float) -> Tensor:
    T = EYE.clone()
    T[2, 3] = z
    return T


# --- filtering and triangulation -------------------------------------------------------------------------------


@pytest.mark.parametrize(("factor", "agrees"), [(0.99, True), (1.01, False)])
def test_observations_within_the_gate_agree(factor: float, agrees: bool) -> None:
    """All are tried, whatever agreed before; what is found otherwise stays."""
    observed = moved(SCENE.observed, 13, factor * 8 * SIGMA_PX)
    for before in (False, True):
        found = exact(SCENE, before)
        filtered = observed.filter(found, 8.0)
        assert filtered.agrees.tolist() == [row != 13 or agrees for row in range(len(observed.tracks))]
        assert filtered.points_w is found.points_w
        assert filtered.T_cw is found.T_cw
        assert filtered.camera is found.camera


def test_three_images_must_agree_on_a_point() -> None:
    """Of its ten, two or three agree; other points are not concerned."""
    for right in (2, 3):
        observed = SCENE.observed
        for row in range(20 + right, 30):
            observed = moved(observed, row, 40.0)
        agrees = observed.filter(exact(SCENE), 8.0).agrees
        assert agrees[20:30].tolist() == [right == 3 and row < 3 for row in range(10)]
        assert bool(agrees[:20].all())
        assert bool(agrees[30:].all())


@pytest.mark.parametrize(("degrees", "agrees"), [(0.49, False), (0.51, True)])
def test_points_need_half_a_degree_of_parallax(
    monkeypatch: pytest.MonkeyPatch, degrees: float, agrees: bool
) -> None:
    """Between images that agree: a fourth one, from far away, does not."""
    monkeypatch.setattr(rounds, "MIN_OBSERVATIONS", 1)
    T_cw = EYE.repeat(4, 1, 1)
    T_cw[:, 0, 3] = -5 * math.tan(math.radians(degrees)) * torch.tensor([0.0, 0.5, 1, 9], dtype=torch.float64)
    scene = Recording.of(T_cw, torch.tensor([[0.0, 0, 5]], dtype=torch.float64))
    observed = moved(scene.observed, 3, 5.0)
    assert observed.filter(exact(scene), 8.0).agrees.tolist() == [agrees, agrees, agrees, False]


def lost_in(observed: ObservedTracks, view: int, right: int) -> ObservedTracks:
    """All observations of an image far off, but for some."""
    rows = torch.nonzero(observed.tracks.view == view)[:, 0]
    for row in rows[right:].tolist():
        observed = moved(observed, row, 40.0)
    return observed


@pytest.mark.parametrize("right", [14, 15])
def test_images_need_fifteen_observations(right: int) -> None:
    """With fewer the image counts for nothing; the points are those of the others."""
    observed = lost_in(SCENE.observed, 4, right)
    agrees = observed.filter(exact(SCENE), 8.0).agrees
    own = observed.tracks.view == 4
    assert int(agrees[own].sum()) == (15 if right == 15 else 0)
    assert bool(agrees[~own].all())


def test_an_image_without_a_pose_is_posed_by_the_points_of_others() -> None:
    """The others stay where they are, to the bit."""
    found = exact(SCENE)
    T_cw = found.T_cw.clone()
    T_cw[4] = se3_along(3.0)
    lost = SCENE.observed.filter(replace(found, T_cw=T_cw), 8.0)
    assert not bool(lost.agrees[SCENE.observed.tracks.view == 4].any())
    posed = SCENE.observed.resect(lost)
    torch.testing.assert_close(posed.T_cw, found.T_cw, atol=1e-6, rtol=0)
    others = torch.arange(len(T_cw)) != 4
    assert torch.equal(posed.T_cw[others], T_cw[others])


def test_nothing_is_posed_anew_where_all_images_hold() -> None:
    found = SCENE.observed.filter(exact(SCENE), 8.0)
    assert SCENE.observed.resect(found) is found


def test_an_image_whose_points_nobody_else_agrees_on_stays_where_it_is() -> None:
    found = replace(exact(SCENE), agrees=torch.zeros(len(SCENE.tracks), dtype=torch.bool))
    assert SCENE.observed.resect(found) is found


def test_rounds_pose_a_lost_image_and_keep_it() -> None:
    T_cw = SCENE.T_cw.clone()
    T_cw[4] = se3_along(3.0)
    found = adjust_in_rounds(SCENE.observed, T_cw, None, CAMERA, coarse=False)
    assert bool(found.agrees.all())


@pytest.mark.parametrize(("factor", "agrees"), [(0.9, True), (1.1, False)])
def test_points_are_triangulated_within_the_gate(factor: float, agrees: bool) -> None:
    """By rays, whose tolerance is the gate at the focal length; then the gate holds in pixels."""
    observed = moved(SCENE.observed, 13, factor * 8 * SIGMA_PX)
    found = observed.triangulate(SCENE.T_cw, CAMERA, 8.0)
    assert found.agrees.tolist() == [row != 13 or agrees for row in range(len(observed.tracks))]
    others = torch.arange(100) != 1
    torch.testing.assert_close(found.points_w[others], SCENE.points_w[others], atol=1e-9, rtol=0)
    assert float((found.points_w[1] - SCENE.points_w[1]).norm()) < 0.02
    assert (float((found.points_w[1] - SCENE.points_w[1]).norm()) > 1e-4) == agrees
    assert torch.equal(found.T_cw, SCENE.T_cw)
    assert found.camera is CAMERA


# --- one adjustment --------------------------------------------------------------------------------------------


def start(observed: ObservedTracks, T_cw: Tensor, camera: Camera = CAMERA) -> Reconstruction:
    return observed.triangulate(T_cw, camera, 60.0)


def test_exact_observations_correct_disturbed_poses() -> None:
    """Five cm and half a degree off at a distance of 2.5, which is ten pixels."""
    observed = SCENE.observed
    T_cw = disturbed(SCENE.T_cw, 0.05, 0.5)
    found = start(observed, T_cw)
    adjusted = adjust(observed, found, "cauchy", 20.0, 1e-9, None)
    assert apart(T_cw, SCENE.T_cw)[0] > 0.02
    ate, degrees = apart(adjusted.T_cw, SCENE.T_cw)
    assert ate < 1e-5
    assert degrees < 1e-3
    assert float(observed.errors(adjusted).max()) < 1e-2
    assert adjusted.agrees is found.agrees
    assert torch.equal(adjusted.camera.params, CAMERA.params)


def wrong_focal(std: float) -> CameraMeasurement:
    """A camera whose focal length is 3 % too long, known with an error."""
    return CameraMeasurement.of(Camera.pinhole(412.0, 412.0, 319.5, 239.5, size=CAMERA.size), std)


def test_the_focal_length_is_found_within_its_error() -> None:
    """With an error of 3 % it is right; with one of a millionth it stays, as without; with the others it changes."""
    observed = SCENE.observed
    measured = wrong_focal(0.03)
    found = start(observed, disturbed(SCENE.T_cw, 0.02, 0.2), measured.camera)
    for _ in range(2):
        found = adjust(observed, found, "cauchy", 6.0, 1e-9, measured)
    assert float(found.camera.focal) == pytest.approx(400, rel=2e-3)
    assert apart(found.T_cw, SCENE.T_cw)[0] < 1e-3
    for known in (wrong_focal(1e-6), None):
        fixed = adjust(observed, start(observed, SCENE.T_cw, measured.camera), "cauchy", 6.0, 1e-9, known)
        assert float(fixed.camera.focal) == pytest.approx(412, rel=1e-4)


def test_only_observations_that_agree_are_adjusted() -> None:
    """Wrong ones do not pull; a point that a single image agrees on stays where it was."""
    observed = NOISY.observed
    found = replace(exact(NOISY), agrees=RIGHT.clone())
    found.agrees[observed.tracks.track == 4] = False
    found.agrees[((observed.tracks.track == 4) & RIGHT).nonzero()[0]] = True
    found.agrees[observed.tracks.track == 9] = False
    adjusted = adjust(observed, found, "geman_mcclure", 5.0, 1e-8, None)
    assert apart(adjusted.T_cw, NOISY.T_cw)[0] < 2e-3
    stays = torch.isin(torch.arange(80), torch.tensor([4, 9]))
    assert torch.equal(adjusted.points_w[stays], found.points_w[stays])
    assert bool((adjusted.points_w[~stays] != found.points_w[~stays]).any(-1).all())
    kept = found.agrees & ~stays[observed.tracks.track]
    assert float(observed.errors(adjusted)[kept].median()) < 1
    assert torch.equal(found.points_w, NOISY.points_w)


def test_the_problem_has_the_noise_and_the_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each observation its own weight; the camera is free along the directions of its error, with its prior."""
    calls: list[tuple[BundleProblem, Any]] = []
    solve = rounds.solve_bundle

    def spy(problem: BundleProblem, *, free_camera: Any, **more: Any) -> Any:
        calls.append((problem, free_camera))
        return solve(problem, free_camera=free_camera, **more)

    monkeypatch.setattr(rounds, "solve_bundle", spy)
    scales = 1 + torch.arange(100, dtype=torch.float64) / 100
    observed = ObservedTracks.of(SCENE.tracks, [replace(view, scales=scales) for view in SCENE.views])
    found = replace(exact(SCENE), agrees=torch.arange(len(observed.tracks)) % 3 > 0)
    measured = CameraMeasurement.of(CAMERA, 0.02)
    adjust(observed, replace(found, camera=measured.camera), "cauchy", 6.0, 1e-3, measured)
    ((problem, free),) = calls
    weights = 4 / scales[SCENE.tracks.keypoint[found.agrees]] ** 2
    torch.testing.assert_close(problem.weights, weights.float())
    assert torch.equal(free, measured.directions.float())
    assert problem.camera_prior is not None
    assert torch.equal(problem.camera_prior.params, measured.camera.params.float())


def test_poses_far_from_the_origin_are_adjusted_as_well() -> None:
    """As in coordinates of a map grid, 1,000 km away: they lose what float64 loses, and nothing to float32."""
    away = torch.eye(4, dtype=torch.float64)
    away[:3, 3] = torch.tensor((4e5, 5e6, 300.0))
    near = replace(exact(NOISY), agrees=RIGHT)
    far = replace(near, T_cw=near.T_cw @ se3_inverse(away), points_w=near.points_w + away[:3, 3])
    here, there = (adjust(NOISY.observed, found, *FINE, 1e-8, None) for found in (near, far))
    torch.testing.assert_close(there.T_cw @ away, here.T_cw, rtol=0, atol=1e-4)
    torch.testing.assert_close(there.points_w - away[:3, 3], here.points_w, rtol=0, atol=1e-3)
    R_cw = there.T_cw[:, :3, :3]
    torch.testing.assert_close(R_cw @ R_cw.mT, torch.eye(3).double().expand_as(R_cw), rtol=0, atol=1e-12)


# --- all rounds ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("coarse", "distance", "degrees"), [(True, 0.15, 1.0), (False, 0.004, 0.05)])
def test_a_fifth_of_wrong_observations_is_left_out(coarse: bool, distance: float, degrees: float) -> None:
    """All of them and none of the right ones, from poses tens of pixels off, or about one pixel."""
    words: list[str] = []
    T_cw = disturbed(NOISY.T_cw, distance, degrees)
    found = adjust_in_rounds(NOISY.observed, T_cw, None, CAMERA, coarse, words.append)
    assert torch.equal(found.agrees, RIGHT)
    ate, off = apart(found.T_cw, NOISY.T_cw)
    assert ate < 2e-3
    assert off < 0.1
    assert float(NOISY.observed.errors(found)[RIGHT].median()) < 1
    assert torch.equal(found.camera.params, CAMERA.params)
    before = [f"{kernel} {scale:g}" for kernel, scale, _ in COARSE] if coarse else []
    fine = len(words) - len(before)
    assert [line.split(":")[0] for line in words] == before + [f"round {row + 1}" for row in range(fine)]
    assert words[-1] == f"round {fine}: {int(RIGHT.sum())} observations agree, 0.0% changed"


def test_a_track_that_joins_two_points_becomes_the_one_that_most_see() -> None:
    """The others are left out, in the first images as in the last."""
    tracks, view = SCENE.tracks, SCENE.tracks.view
    joined = ((tracks.track == 0) & (view < 6)) | ((tracks.track == 1) & (view >= 6))
    also = ((tracks.track == 2) & (view < 3)) | ((tracks.track == 3) & (view >= 3))
    kept = joined | also | (tracks.track > 3)
    track = torch.where(joined, 0, torch.where(also, 2, tracks.track))[kept]
    order = torch.argsort(track * 10 + view[kept])
    joined_tracks = Tracks(
        torch.unique(track[order], return_inverse=True)[1], view[kept][order], tracks.keypoint[kept][order]
    )
    observed = ObservedTracks.of(joined_tracks, SCENE.views)
    found = adjust_in_rounds(observed, disturbed(SCENE.T_cw, 0.05, 0.3), None, CAMERA)
    assert found.agrees[:10].tolist() == [True] * 6 + [False] * 4
    assert found.agrees[10:20].tolist() == [False] * 3 + [True] * 7
    assert bool(found.agrees[20:].all())
    pixels, _ = CAMERA.project(transform(found.T_cw, found.points_w[:2].expand(10, 2, 3)))
    for row, (point, other) in enumerate(((0, 1), (3, 2))):
        shown = torch.stack([each.keypoints[SCENE.at(image)] for image, each in enumerate(SCENE.views)])
        assert float((pixels[:, row] - shown[:, point]).norm(dim=-1).max()) < 0.1
        assert float((pixels[:, row] - shown[:, other]).norm(dim=-1).max()) > 10


@pytest.mark.parametrize(
    ("changes", "done"),
    [
        ([0], 1),
        ([29], 1),  # of a thousand
        ([30, 0], 2),
        ([36, 30, 30, 0], 4),
        ([300, 24], 2),
        ([54, 54, 54, 54], 4),
        ([54, 54, 54, 54, 54], 4),
    ],
)
def test_rounds_end_when_little_changes(
    monkeypatch: pytest.MonkeyPatch, changes: list[int], done: int
) -> None:
    """Less than three percent of the observations, or after four."""
    totals = [500]
    for change in changes:
        totals.append(totals[-1] + change)
    agreeing, steps = iter(totals), list[str]()

    def answer(step: str) -> Callable[..., Reconstruction]:
        def do(*arguments: object, **more: object) -> Reconstruction:
            steps.append(step)
            agrees = torch.arange(len(SCENE.tracks)) < next(agreeing)
            return replace(exact(SCENE), agrees=agrees)

        return do

    monkeypatch.setattr(rounds, "adjust", lambda observed, found, *options: found)
    monkeypatch.setattr(ObservedTracks, "complete", answer("complete"))
    monkeypatch.setattr(ObservedTracks, "triangulate", answer("triangulate"))
    words: list[str] = []
    found = adjust_in_rounds(SCENE.observed, SCENE.T_cw, None, CAMERA, False, words.append)
    assert steps == ["triangulate", *["complete"] * done]
    assert int(found.agrees.sum()) == totals[done]
    assert (
        words[-1]
        == f"round {done}: {totals[done]} observations agree, {changes[done - 1] / 1000:.1%} changed"
    )
    assert len(words) == done


def test_points_are_found_anew_only_where_more_observations_agree_with_that() -> None:
    observed = SCENE.observed
    points_w = SCENE.points_w.clone()
    points_w[1:] += 1e-3  # adjusted by something else than rays
    points_w[0] += 1.0
    none = torch.zeros(len(observed.tracks), dtype=torch.bool)
    found = observed.complete(Reconstruction(SCENE.T_cw, CAMERA, points_w, none), 8.0)
    assert bool(found.agrees.all())
    assert torch.equal(found.points_w[1:], points_w[1:])
    torch.testing.assert_close(found.points_w[0], SCENE.points_w[0])


def test_rounds_keep_poses_of_images_without_observations() -> None:
    """They are in no problem, and stay as they were."""
    tracks, _ = SCENE.tracks.select(SCENE.tracks.view != 5)
    observed = ObservedTracks.of(tracks, SCENE.views)
    found = adjust_in_rounds(observed, SCENE.T_cw, None, CAMERA, coarse=False)
    torch.testing.assert_close(found.T_cw[5], SCENE.T_cw[5])
    assert bool(found.agrees.all())


def test_a_walk_along_a_line_is_adjusted() -> None:
    """Points come into view and go: each is seen by some of the images."""
    points_w = torch.tensor([1.0, 0, 4.5]) + 1.5 * ball(150)
    recording = Recording.of(line(12, 0.3), points_w, noise_px=0.2)
    assert int(recording.tracks.lengths.min()) < 12
    found = adjust_in_rounds(recording.observed, disturbed(recording.T_cw, 0.05, 0.5), None, CAMERA)
    assert apart(found.T_cw, recording.T_cw)[0] < 5e-3


@pytest.mark.parametrize(("shared", "held"), [(4, 6), (5, 10)])
def test_five_points_hold_parts_together(shared: int, held: int) -> None:
    """Images 0 to 5 see forty points of their own, 6 to 9 others, and both some: what four hold leaves the map."""
    tracks = SCENE.tracks
    early = tracks.view < 6
    own = torch.where(early, tracks.track < 40, (tracks.track >= 40) & (tracks.track < 80))
    seen, _ = tracks.select(own | ((tracks.track >= 80) & (tracks.track < 80 + shared)))
    found = adjust_in_rounds(ObservedTracks.of(seen, SCENE.views), SCENE.T_cw, None, CAMERA, coarse=False)
    assert torch.unique(seen.view[found.agrees]).tolist() == list(range(held))
