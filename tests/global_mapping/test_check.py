"""The check of a map by image pairs and triplets: right maps agree, and what was bent by hand is found where it is."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.global_mapping.synthetic import (
    CAMERA,
    EYE,
    Recording,
    arc,
    ball,
    disturbed,
    line,
    rand,
    randn,
    wall,
)
from torchslam.geometry import se3_exp, se3_inverse, so3_exp
from torchslam.global_mapping.check import MAX_LINK_STD, Break, BreakKind, MapCheck, check_map
from torchslam.global_mapping.view_graph import ViewPair
from torchslam.optim.model_choice import predictive_gain
from torchslam.optim.scale_links import ScaleLinks

WALK = Recording.of(line(24), wall(300, 6.0), noise_px=0.5, first=0)
TURN = Recording.of(arc(24, 120.0), ball(100), noise_px=0.5, first=0)
NEAR = 1, 2, 3


def check(
    recording: Recording,
    T_cw: Tensor | None = None,
    pairs: Sequence[ViewPair] | None = None,
    unposed: Collection[int] = (),
    held_back: Collection[int] | None = None,
    reduction: float = 1.0,
    links: ScaleLinks | None = None,
) -> MapCheck:
    """Check the true poses or others by all pairs at distances up to three or by others."""
    return check_map(
        recording.T_cw if T_cw is None else T_cw,
        torch.tensor([row not in unposed for row in range(len(recording))]),
        recording.views,
        recording.pairs(*NEAR) if pairs is None else pairs,
        CAMERA,
        held_back,
        reduction,
        links,
    )


def loose(recording: Recording, *moments: int, std: float = math.inf) -> ScaleLinks:
    """Scale links as the map of a recording has them that ties all its images but after some of them."""
    frames = tuple(view.index for view in recording.views)
    return ScaleLinks(frames, tuple(std if frame in moments else 1e-3 for frame in frames[:-1]))


def bent(T_cw: Tensor, at: int, factor: float) -> Tensor:
    """The poses after an image moved so that all distances from it are larger by a factor."""
    T_wc = se3_inverse(T_cw)
    T_wc[at + 1 :, :3, 3] = T_wc[at, :3, 3] + factor * (T_wc[at + 1 :, :3, 3] - T_wc[at, :3, 3])
    return se3_inverse(T_wc)


def bent_pose(T_cw: Tensor, row: int) -> Tensor:
    """The poses with one image moved sideways."""
    T_cw = T_cw.clone()
    T_cw[row, 1, 3] += 0.3
    return T_cw


def contradicting(recording: Recording, first: int, second: int) -> ViewPair:
    """A pair whose matches are wrong, each point with the next one."""
    pair = recording.pair(first, second)
    return replace(pair, keypoints_2=pair.keypoints_2.roll(1))


def of_points(pair: ViewPair, recording: Recording, low: int, high: int) -> ViewPair:
    """The matches of points low to high."""
    point = recording.shows[pair.first][pair.keypoints_1]
    own = (point >= low) & (point < high)
    return replace(pair, keypoints_1=pair.keypoints_1[own], keypoints_2=pair.keypoints_2[own])


# --- right maps ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("recording", [WALK, TURN])
def test_a_right_map_agrees(recording: Recording) -> None:
    found = check(recording)
    assert found.is_right
    assert found.breaks == ()
    assert (found.images, found.pairs, found.agreeing) == (24, 66, 66)
    assert (found.triplets, found.consistent) == (180, 180)  # of 1, 2, 3 before and after, but for the ends
    assert found.used_agreeing == found.score == 1
    assert (found.certain, found.uncertain) == (tuple(range(24)), ())
    assert found.sentence() == ("100% of 66 held-out image pairs agree, and 100% of 180 ratios of scales")


def test_frames_are_those_of_the_images() -> None:
    """Not the rows: images of a video may be every tenth frame."""
    views = [replace(view, index=10 * view.index + 3) for view in WALK.views]
    found = check(replace(WALK, views=views), bent(WALK.T_cw, 14, 1.5), WALK.pairs(*NEAR))
    assert found.certain == tuple(range(3, 143, 10))
    assert found.uncertain == tuple(range(143, 243, 10))
    assert [(each.before, each.after) for each in found.breaks] == [(133, 143), (143, 153), (153, 163)]


def test_right_maps_give_no_false_alarm() -> None:
    """Fifty of them: walks and turns of all sorts, of few images and points, with a pixel of noise at most."""
    for seed in range(50):
        draw = rand(seed, 4)
        if seed % 2:
            T_cw = line(9, 0.15 + 0.3 * float(draw[0]))
            T_cw = se3_exp(0.03 * randn(seed, 9, 6)) @ T_cw
            points_w = wall(80, float(-T_cw[-1, 0, 3]), seed)
        else:
            T_cw = arc(9, 30 + 90 * float(draw[1]), 3 + 3 * float(draw[2]))
            points_w = ball(60, seed)
        found = check(Recording.of(T_cw, points_w, noise_px=0.3 + 0.4 * float(draw[3]), seed=seed))
        assert found.is_right, (seed, found)
        assert found.score > 0.97


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_the_frame_and_the_unit_of_the_map_do_not_matter(scale: float) -> None:
    """A map that is right or wrong is it in any other frame, too."""
    T = se3_exp(torch.tensor([1.0, -2.0, 0.5, 0.3, -0.4, 0.2], dtype=torch.float64))
    for T_cw in (WALK.T_cw, bent(WALK.T_cw, 9, 0.7)):
        other = T_cw @ T
        other[:, :3, 3] *= scale
        before, found = check(WALK, T_cw), check(WALK, other)
        assert (found.agreeing, found.consistent) == (before.agreeing, before.consistent)
        assert [each.kind for each in found.breaks] == [each.kind for each in before.breaks]
        for one, another in zip(found.breaks, before.breaks, strict=True):
            assert one.scale_ratio == pytest.approx(another.scale_ratio)


# --- breaks ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("recording", [WALK, TURN])
@pytest.mark.parametrize("factor", [0.5, 0.8, 1.2, 1.5])
def test_a_bent_scale_is_found_where_it_is(recording: Recording, factor: float) -> None:
    """The ratio is what would make it right. Pairs that go across tell of it as well, one image before and after."""
    found = check(recording, bent(recording.T_cw, 14, factor))
    assert not found.is_right
    assert {each.kind for each in found.breaks} == {BreakKind.SCALE}
    where = {each.before for each in found.breaks}
    assert 14 in where
    assert where <= {13, 14, 15}
    (here,) = (each for each in found.breaks if each.before == 14)
    assert here.after == 15
    assert here.scale_ratio == pytest.approx(1 / factor, rel=0.02)
    assert {20, 21, 22, 23} <= set(found.uncertain)
    assert set(range(14)) <= set(found.certain) <= set(range(15))  # the longer part
    assert sorted(found.certain + found.uncertain) == list(range(24))
    assert found.score < 0.6
    assert found.agreeing > 63  # directions hardly change


def test_a_camera_that_is_moved_sideways_contradicts_the_image_pairs() -> None:
    """Where most pairs that go across a moment are of that image: before it and after it."""
    found = check(WALK, bent_pose(WALK.T_cw, 10), WALK.pairs(1, 2))
    assert [(each.before, each.after, each.kind) for each in found.breaks] == [
        (9, 10, BreakKind.POSE),
        (10, 11, BreakKind.POSE),
    ]
    assert [each.scale_ratio for each in found.breaks] == [1, 1]
    # Only that image: pairs that go past it tie what is before and after.
    assert (found.certain, found.uncertain) == ((*range(10), *range(11, 24)), (10,))
    assert (found.pairs, found.agreeing) == (45, 41)
    assert not found.is_right


def test_most_pairs_across_a_moment_must_agree() -> None:
    """Two of five are too few, a half is enough; of two pairs nothing follows, and pairs of far images do not count."""
    wrong = [of_points(contradicting(WALK, *ends), WALK, 0, 90) for ends in ((10, 12), (11, 12), (9, 12))]
    right = [WALK.pair(*ends) for ends in ((10, 13), (11, 13), (11, 14))]
    others = [pair for pair in WALK.pairs(*NEAR) if pair.second <= 11 or pair.first >= 12]
    for bad, good, kinds in (
        (wrong, right[:2], [BreakKind.POSE]),
        (wrong, right, []),
        (wrong[:2], right[:2], []),
        (wrong, [], [BreakKind.POSE]),
        (wrong[:2], [], []),
    ):
        found = check(WALK, pairs=[*others, *bad, *good])
        assert [each.kind for each in found.breaks] == kinds
        assert all((each.before, each.after) == (11, 12) for each in found.breaks)
    still = Recording.of(arc(40, 30.0), ball(60), first=0)
    far = [contradicting(still, row, row + 16) for row in (10, 11)]
    assert check(still, pairs=[*still.pairs(*NEAR), *far]).breaks == ()
    near = [contradicting(still, row, row + 15) for row in range(8, 16)]
    assert {each.kind for each in check(still, pairs=[*still.pairs(*NEAR), *near]).breaks} == {BreakKind.POSE}


def there_and_back() -> Recording:
    """A walk whose second half sees the places of the first one again."""
    steps = torch.cat([torch.arange(12.0), torch.arange(11.0, -1, -1)]).double()
    T_cw = EYE.repeat(24, 1, 1)
    T_cw[:, 0, 3] = -0.25 * steps
    T_cw[12:, 2, 3] = -0.1  # not the same poses, which had no parallax
    return Recording.of(T_cw, wall(300, 3.0), noise_px=0.3, first=0)


def tied_by_loops(*apart: tuple[int, int]) -> tuple[Recording, list[ViewPair], list[ViewPair]]:
    """A walk there and back, its neighbors without those across some moments, and pairs of the same places."""
    recording = there_and_back()
    near = [
        pair
        for pair in recording.pairs(*NEAR)
        if not any(pair.first <= before and pair.second >= after for before, after in apart)
    ]
    loops = [recording.pair(row, 23 - row) for row in range(4)]
    return recording, near, loops


def test_loops_tie_what_a_moment_does_not() -> None:
    """The two ends of a walk that returns; where the camera turns around, nothing ties them."""
    recording, near, loops = tied_by_loops((11, 12))
    links = loose(recording, 11)
    found = check(recording, pairs=near, links=links)
    assert found.breaks == (Break(11, 12, BreakKind.UNKNOWN),)
    assert len(found.uncertain) == 12
    found = check(recording, pairs=[*near, *loops], links=links)
    assert found.is_right
    assert (found.breaks, found.certain, found.uncertain) == ((), tuple(range(24)), ())
    # Both ends tied, and the middle by nothing: only that hangs on weak links.
    recording, near, loops = tied_by_loops((7, 8), (15, 16))
    found = check(recording, pairs=[*near, *loops], links=loose(recording, 7, 15))
    assert found.breaks == (Break(7, 8, BreakKind.UNKNOWN), Break(15, 16, BreakKind.UNKNOWN))
    assert (found.certain, found.uncertain) == ((*range(8), *range(16, 24)), tuple(range(8, 16)))
    assert found.score == pytest.approx(16 / 24)


@pytest.mark.parametrize("factor", [0.7, 1.3])
def test_loops_that_contradict_the_scale_tie_nothing(factor: float) -> None:
    """The way back has another scale: its depths by pairs of the way there are others."""
    recording, near, loops = tied_by_loops((11, 12))
    T_wc = se3_inverse(recording.T_cw)
    center = T_wc[23, :3, 3].clone()
    T_wc[12:, :3, 3] = center + factor * (T_wc[12:, :3, 3] - center)
    found = check(recording, se3_inverse(T_wc), [*near, *loops], links=loose(recording, 11))
    assert Break(11, 12, BreakKind.UNKNOWN) in found.breaks
    assert len(found.uncertain) == 12


@pytest.mark.parametrize(("wrong", "matches", "uncertain"), [(1, 60, 0), (4, 200, 12)])
def test_nine_in_ten_matches_must_agree(wrong: int, matches: int, uncertain: int) -> None:
    """A small wrong pair is outvoted by the loops, and wrong ones with many matches are not."""
    recording, near, loops = tied_by_loops((11, 12))
    bad = [
        of_points(contradicting(recording, row, 23 - row), recording, 0, matches)
        for row in range(4, 4 + wrong)
    ]
    found = check(recording, pairs=[*near, *loops, *bad], links=loose(recording, 11))
    assert len(found.uncertain) == uncertain


def test_contradicting_loops_are_found() -> None:
    """A drift of a twelfth of a degree per image is nothing between neighbors, and ten pixels where the walk ends."""
    recording = there_and_back()
    loops = [recording.pair(row, 23 - row) for row in range(4)]
    pairs = [*recording.pairs(*NEAR), *loops]
    assert check(recording, pairs=pairs).is_right
    pitch = torch.zeros(24, 3, dtype=torch.float64)
    pitch[:, 0] = math.radians(1 / 12) * torch.arange(24)
    drifted = recording.T_cw.clone()
    drifted[:, :3] = so3_exp(pitch) @ drifted[:, :3]
    found = check(recording, drifted, pairs)
    assert found.breaks == (Break(0, 23, BreakKind.LOOP),)
    assert (found.pairs, found.agreeing) == (67 + 3, 66)
    assert found.certain == tuple(range(24))
    assert not found.is_right
    # One of the loops is right, two wrong ones are too few, a half is right.
    assert check(recording, drifted, pairs[:-2]).breaks == ()
    right = contradicting(recording, 0, 23)
    assert check(recording, pairs=[*pairs[:-3], right, right]).breaks == (Break(0, 23, BreakKind.LOOP),)
    assert check(recording, pairs=[*pairs[:-2], right, right]).breaks == ()
    # Where they begin, those that agree are passed over.
    last = [contradicting(recording, 2, 21), contradicting(recording, 1, 22)]
    assert check(recording, pairs=[*pairs[:-3], *last]).breaks == (Break(2, 21, BreakKind.LOOP),)


@pytest.mark.parametrize("std", [math.inf, 1.01 * MAX_LINK_STD])
def test_parts_that_the_map_does_not_tie_are_unknown(std: float) -> None:
    """A weak link is named, by the frames on both sides of it."""
    apart = [pair for pair in WALK.pairs(*NEAR) if pair.second <= 9 or pair.first >= 10]
    found = check(WALK, pairs=apart, links=loose(WALK, 9, std=std))
    assert found.breaks == (Break(9, 10, BreakKind.UNKNOWN),)
    assert found.weak_links == 1
    assert str(found.breaks[0]) in found.sentence()
    assert (found.certain, found.uncertain) == (tuple(range(10, 24)), tuple(range(10)))
    assert found.used_agreeing == 1
    assert not found.is_right
    assert found.score == pytest.approx(14 / 24)


def test_a_map_that_ties_its_parts_needs_no_pairs_across() -> None:
    """As one in which the camera stands still: no pair has parallax there."""
    apart = [pair for pair in WALK.pairs(*NEAR) if pair.second <= 9 or pair.first >= 10]
    for links in (None, loose(WALK), loose(WALK, 9, std=0.99 * MAX_LINK_STD)):
        found = check(WALK, pairs=apart, links=links)
        assert found.breaks == ()
        assert found.certain == tuple(range(24))


def test_a_weak_link_is_sought_at_the_moments_of_the_map() -> None:
    """Its keyframes are other frames than the images, and an image without a pose is passed over."""
    apart = [pair for pair in WALK.pairs(*NEAR) if pair.second <= 9 or pair.first >= 11]
    dense = ScaleLinks(
        tuple(range(-5, 30)), tuple(1.0 if frame in (-3, 10) else 0.0 for frame in range(-5, 29))
    )
    sparse = ScaleLinks((0, 8, 12, 23), (0.0, 1.0, 0.0))
    found = check(WALK, pairs=apart, unposed=[10], links=dense)
    assert found.breaks == (Break(9, 11, BreakKind.UNKNOWN),)
    # Where keyframes are further apart than images, pairs that agree join what is on one side.
    found = check(WALK, pairs=apart, unposed=[10], links=sparse)
    assert found.breaks == (Break(9, 11, BreakKind.UNKNOWN),)


def test_two_triplets_tell_nothing_and_three_do() -> None:
    """Those around an image first; if there are too few, all that go across."""
    T_cw = bent(WALK.T_cw, 9, 1.5)
    inside = [pair for pair in WALK.pairs(*NEAR) if pair.second <= 9 or pair.first >= 10]
    across = WALK.pair(9, 10)
    kinds = {}
    for name, before in (("two", (7, 8)), ("three", (6, 7, 8))):
        pairs = [pair for pair in inside if pair.second != 9 or pair.first in before]
        found = check(WALK, T_cw, [of_points(across, WALK, 0, 300), *pairs])
        kinds[name] = [each.kind for each in found.breaks if each.before == 9]
    # With two around the image, those of the next one go across as well: three more, which agree.
    assert kinds == {"two": [], "three": [BreakKind.SCALE]}
    first = [WALK.pair(0, 1), WALK.pair(1, 2), WALK.pair(0, 2)]
    found = check(WALK, pairs=first, unposed=range(3, 24))
    assert found.consistent == 1
    assert found.breaks == ()


# --- what agrees -----------------------------------------------------------------------------------------------


def moved_keypoints(recording: Recording, row: int, dx: float, dy: float, share: float = 1.0) -> Recording:
    """The recording, keypoints of an image elsewhere: of a share of the points."""
    views = list(recording.views)
    chosen = recording.shows[row] < share * len(recording.points_w)
    step = torch.tensor([dx, dy], dtype=torch.float64)
    views[row] = replace(views[row], keypoints=views[row].keypoints + step * chosen[:, None])
    return replace(recording, views=views)


SHORT = Recording.of(line(3), wall(120, 0.5), first=0)


@pytest.mark.parametrize(
    ("dx", "dy", "share", "reduction", "agreeing"),
    [
        (0.0, 2.9, 1.0, 1.0, 3),
        (0.0, 3.25, 1.0, 1.0, 1),  # at the edge of the image a pixel is a smaller angle
        (0.0, 40.0, 0.45, 1.0, 3),
        (0.0, 40.0, 0.6, 1.0, 1),
        (0.0, 5.9, 1.0, 2.0, 3),
        (0.0, 6.5, 1.0, 2.0, 1),
        (8.0, 0.0, 1.0, 1.0, 3),  # along the epipolar lines: nearer or further away
        (-8.0, 0.0, 1.0, 1.0, 3),
    ],
)
def test_the_median_match_must_be_near_its_epipolar_line(
    dx: float, dy: float, share: float, reduction: float, agreeing: int
) -> None:
    """Up to three pixels of the reduced image."""
    recording = moved_keypoints(SHORT, 2, dx, dy, share)
    found = check(recording, reduction=reduction)
    assert found.agreeing == agreeing
    if share == 1:  # the median of three pairs, of which two have the image
        assert found.distance_px == pytest.approx(dy, rel=0.1, abs=0.01)
    assert check(recording, reduction=reduction, held_back=[0]).distance_px < 0.01
    assert check(recording, unposed=[2]).distance_px == math.inf


def plane(
    count: int = 60, ratio: Tensor | float = 1.0, baseline: float = 0.4, width: float = 0.4
) -> Recording:
    """Three cameras a baseline apart and a wall 4 ahead; disparities between the last two are larger by a ratio."""
    flat = torch.tensor([width, width, 0.0], dtype=torch.float64) * (rand(5, count, 3) - 0.5)
    made = Recording.of(
        line(3, baseline), flat + torch.tensor([baseline, 0, 4], dtype=torch.float64), first=0
    )
    views = list(made.views)
    disparity = 400 * baseline / 4
    factor = torch.as_tensor(ratio, dtype=torch.float64).expand(count)[made.shows[2]]
    keypoints = views[2].keypoints.clone()
    keypoints[:, 0] -= disparity * (factor - 1)
    views[2] = replace(views[2], keypoints=keypoints)
    return replace(made, views=views)


@pytest.mark.parametrize(
    ("disparity", "agrees"), [(-2.5, True), (-3.5, False), (0.0, True), (780.0, True), (830.0, False)]
)
def test_matches_lie_before_the_cameras_and_not_too_near(disparity: float, agrees: bool) -> None:
    """The epipolar line begins at infinity, and ends at a twentieth of the median depth, here at 800 pixels."""
    baseline = 0.4
    pairs = [(0, 1)] * 3 + [(1, 2)]
    recording = plane(ratio=disparity / (400 * baseline / 4))
    found = check(recording, pairs=[recording.pair(*ends) for ends in pairs])
    assert found.agreeing == 3 + agrees


@pytest.mark.parametrize(
    ("ratio", "consistent"), [(1.079, 1), (1.081, 0), (1 / 1.079, 1), (1 / 1.081, 0), (0.5, 0), (2.0, 0)]
)
def test_a_ratio_of_scales_agrees_within_eight_percent(ratio: float, consistent: int) -> None:
    recording = plane(ratio=ratio)
    found = check(recording, pairs=recording.pairs(1))
    assert (found.triplets, found.consistent) == (1, consistent)


@pytest.mark.parametrize(
    ("center", "spread", "told", "consistent"),
    [
        (0.0, 0.085, 1, 1),
        (0.0, 0.088, 0, 0),
        (0.120, 0.05, 1, 1),  # 0.0770 and two standard errors of 0.0232
        (0.127, 0.05, 1, 0),
        (-0.120, 0.05, 1, 1),
        (-0.127, 0.05, 1, 0),
    ],
)
def test_uncertain_ratios_tell_less_or_nothing(
    center: float, spread: float, told: int, consistent: int
) -> None:
    """Sixteen keypoints, half of them larger and half smaller by the spread: its error is 0.4645 of that."""
    logarithm = center + spread * (1 - 2 * (torch.arange(16) % 2)).double()
    recording = plane(16, torch.exp(logarithm))
    found = check(recording, pairs=recording.pairs(1))
    assert (found.triplets, found.consistent) == (told, consistent)


# --- evidence --------------------------------------------------------------------------------------------------


def times(recording: Recording, pairs: Sequence[ViewPair]) -> Tensor:
    return torch.tensor([float(pair.first + pair.second) for pair in pairs])


@pytest.mark.parametrize("recording", [WALK, TURN])
def test_a_right_map_predicts_pairs_better_than_a_bent_one(recording: Recording) -> None:
    """One that has another scale from a moment on, one that is off a little everywhere, and one that turns too far."""
    pairs = recording.pairs(*NEAR)
    right = check(recording, pairs=pairs).evidence
    assert len(right) == len(pairs)
    assert float(right.min()) > 0
    worse = {
        "bent": bent(recording.T_cw, 12, 1.5),
        "disturbed": disturbed(recording.T_cw, 0.05, 0.3),
        "turned": se3_exp(torch.tensor([0, 0, 0, 0, 0, 0.02]).double() * torch.arange(24)[:, None])
        @ recording.T_cw,
    }
    for name, T_cw in worse.items():
        evidence = check(recording, T_cw, pairs).evidence
        gain = predictive_gain(right, evidence, times(recording, pairs))
        assert gain.total > 5, name
        assert gain.is_sure or name == "bent"  # only the pairs across a bend tell of it
        assert not predictive_gain(evidence, right, times(recording, pairs)).is_sure


def test_pairs_that_a_map_does_not_predict_have_no_evidence() -> None:
    """None below chance, however far they are off, and none of images without a pose."""
    pairs = WALK.pairs(1)
    pairs[4] = contradicting(WALK, 4, 5)
    found = check(WALK, pairs=pairs, unposed=[10]).evidence
    known = torch.tensor([row not in (4, 9, 10) for row in range(len(pairs))])
    assert bool((found[known] > 1).all())
    assert float(found[~known].max()) < 0.01
    assert float(found.min()) >= 0


def test_evidence_is_of_the_pairs_that_mapping_did_not_use() -> None:
    """At the size at which features are found, and with the ratios of scales that the others give."""
    pairs = WALK.pairs(*NEAR)
    every = check(WALK, pairs=pairs).evidence
    torch.testing.assert_close(check(WALK, pairs=pairs, held_back={20, 3, 7}).evidence, every[[3, 7, 20]])
    alone = check(WALK, pairs=pairs[:1]).evidence
    assert float(every[0]) > float(alone[0]) + 1
    moved = moved_keypoints(WALK, 5, 0.0, 4.0)
    own = [row for row, pair in enumerate(pairs) if 5 in (pair.first, pair.second)]
    small, large = (check(moved, pairs=pairs, reduction=reduction).evidence[own] for reduction in (1.0, 4.0))
    assert float(large.min()) > float(small.max())


# --- what is counted -------------------------------------------------------------------------------------------


def test_images_without_a_pose_lower_the_score() -> None:
    """Their pairs and triplets count, and agree with nothing; where they are, the rest is still tied together."""
    found = check(WALK, unposed=[10])
    assert (found.pairs, found.agreeing) == (66, 60)
    assert found.used_agreeing == pytest.approx(60 / 66)
    assert (found.triplets, found.consistent) == (180, 180 - 9 - 18)
    assert found.breaks == ()
    assert (10 not in found.certain, len(found.certain), found.uncertain) == (True, 23, ())
    assert found.score == pytest.approx(60 / 66 * 153 / 180 * 23 / 24)
    assert not found.is_right
    nothing = check(WALK, unposed=range(24))
    assert (nothing.score, nothing.certain, nothing.uncertain, nothing.breaks) == (0, (), (), ())
    assert nothing.triplets == 180
    one = check(WALK, unposed=range(1, 24))
    assert (one.certain, one.uncertain) == ((0,), ())


def test_only_pairs_that_mapping_did_not_use_are_counted() -> None:
    """All count for the breaks and the score."""
    pairs = WALK.pairs(1, 2)
    pairs[3] = contradicting(WALK, pairs[3].first, pairs[3].second)
    found = check(WALK, pairs=pairs, held_back=frozenset({0, 3, 7}))
    assert (found.pairs, found.agreeing) == (3, 2)
    assert found.used_agreeing == pytest.approx(44 / 45)
    everything = check(WALK, pairs=pairs)
    assert (everything.pairs, everything.agreeing) == (45, 44)
    assert everything.score == found.score
    assert check(WALK, pairs=pairs, held_back=()).sentence() == "no held-out image pairs"


def test_nothing_to_check_is_not_right() -> None:
    found = check(WALK, pairs=[])
    assert (found.pairs, found.used_agreeing, found.score, found.is_right) == (0, 0, 0, False)
    assert found.breaks == ()
    assert len(found.evidence) == 0
    assert found.distance_px == 0
    empty = replace(a_check(), images=0, certain=())
    assert (empty.score, empty.is_right) == (0, False)


def a_check(
    images: int = 10,
    agreeing: int = 9,
    consistent: int = 8,
    triplets: int = 8,
    breaks: int = 0,
    certain: int = 10,
) -> MapCheck:
    return MapCheck(
        images=images,
        pairs=10,
        agreeing=agreeing,
        triplets=triplets,
        consistent=consistent,
        used_agreeing=agreeing / 10,
        distance_px=0.5,
        evidence=torch.zeros(10, dtype=torch.float64),
        breaks=tuple(Break(row, row + 1, BreakKind.SCALE, 1.25 - 0.5 * (row % 2)) for row in range(breaks)),
        certain=tuple(range(certain)),
        uncertain=(),
    )


def test_the_score_is_a_product_of_shares() -> None:
    assert a_check().score == pytest.approx(0.9)
    assert a_check(consistent=4).score == pytest.approx(0.45)
    assert a_check(certain=5).score == pytest.approx(0.45)
    assert a_check(triplets=0, consistent=0).score == pytest.approx(0.9)
    assert a_check().is_right
    assert not a_check(breaks=1).is_right
    assert a_check(agreeing=10, certain=9).is_right
    assert not a_check(agreeing=10, certain=8).is_right  # a score of 0.8 is not enough
    assert not a_check(agreeing=10, certain=10, consistent=6).is_right


def test_frames_can_be_doubted() -> None:
    check = MapCheck(5, 4, 4, 3, 3, 1.0, 0.2, torch.zeros(4), (), (0, 2, 4, 6), (8,))
    doubted = check.doubting({4, 8, 10})
    assert (doubted.certain, doubted.uncertain) == ((0, 2, 6), (4, 8))
    assert doubted.score == pytest.approx(3 / 4 * check.score)
    assert check.doubting(frozenset()) == check
