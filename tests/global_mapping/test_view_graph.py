"""Pairs of images that see the same: which are tried, which hold, and what they determine."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from tests.global_mapping.synthetic import (
    CAMERA,
    EYE,
    Recording,
    arc,
    ball,
    degrees_between,
    rand,
    view_pair,
    wall,
)
from torchslam.config import Config, load_config
from torchslam.geometry import Camera, rigid, se3_exp, so3_exp
from torchslam.global_mapping import view_graph
from torchslam.global_mapping.view_graph import (
    MIN_MATCHES,
    PairMatcher,
    Relation,
    ViewPair,
    build_view_graph,
    connected_views,
    most_samples,
    similar_places,
)
from torchslam.tracking.matcher import DescriptorMatcher, make_matcher, run_matcher
from torchslam.types import FrameFeatures, Matches, MatchPrior

CONFIG = load_config(None, ["matching.max_cosine_distance=0.3"])
RECORDING = Recording.of(arc(4), ball(150), noise_px=0.3, wrong=0.2)
RIGHT_FROM = 30
"""Keypoints before are wrong."""


def matcher_of(recording: Recording, config: Config = CONFIG) -> PairMatcher:
    return PairMatcher(recording.views, CAMERA, make_matcher(config.matching), config)


def with_main_directions(recording: Recording, rank: int = 12) -> Recording:
    """The same with descriptors that differ in few directions, about a common mean."""
    basis = torch.randn(64, 64, generator=torch.Generator().manual_seed(9))[:rank]
    views = []
    for view in recording.views:
        along = 1.0 + view.descriptors[:, :rank] @ basis
        views.append(replace(view, descriptors=torch.nn.functional.normalize(along, dim=-1)))
    return replace(recording, views=views)


# --- matching and verification ---------------------------------------------------------------------------------


def test_sorted_descriptors_match_as_all_against_all(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where images are sorted again, and with pairs of keypoints that may not match."""
    recording = with_main_directions(RECORDING)
    matcher = matcher_of(recording)
    assert matcher._directions is not None
    assert matcher_of(RECORDING)._directions is None
    monkeypatch.setattr(view_graph, "_SORTED_AT_ONCE", 2)
    for one, other in [(0, 1), (1, 2), (0, 2), (2, 3), (0, 3)]:
        found = matcher.match_two(one, other)
        exact = run_matcher(matcher.matcher, recording.views[one], recording.views[other])
        ours, true = (
            set(zip(each.first.tolist(), each.second.tolist(), strict=True)) for each in (found, exact)
        )
        assert len(true) > 50
        assert len(ours ^ true) <= 0.05 * len(true)
        assert len(matcher._sorted) <= 2
        kept = matcher.match_two(
            one, other, 1.25, lambda rows, columns: (rows % 2 == 0)[:, None] & (columns >= 0)
        )
        assert bool((kept.first % 2 == 0).all())
        even = {ends for ends in ours if ends[0] % 2 == 0}
        assert even <= set(zip(kept.first.tolist(), kept.second.tolist(), strict=True))


def test_a_matcher_of_a_user_is_called() -> None:
    """One that extends torchslam's as well, where descriptors could be sorted."""
    asked: list[tuple[int, int]] = []

    class Mine(DescriptorMatcher):
        def __call__(
            self, view_1: FrameFeatures, view_2: FrameFeatures, prior: MatchPrior | None = None
        ) -> Matches:
            asked.append((view_1.index, view_2.index))
            return super().__call__(view_1, view_2, prior)

    views = with_main_directions(RECORDING).views
    PairMatcher(views, CAMERA, Mine(CONFIG.matching), CONFIG).match_two(0, 1)
    assert asked == [(views[0].index, views[1].index)]


def test_the_relative_pose_and_the_right_matches_of_a_pair_are_found() -> None:
    true = RECORDING.pair(1, 3)
    (pair,) = matcher_of(RECORDING).match([(1, 3)])
    assert (pair.first, pair.second, pair.relation) == (1, 3, Relation.GENERAL)
    assert float(degrees_between(pair.T_21[:3, :3], true.T_21[:3, :3])) < 0.5
    assert float(pair.T_21[:3, 3].norm()) == pytest.approx(1)
    assert float(pair.T_21[:3, 3] @ true.T_21[:3, 3]) > math.cos(math.radians(2))
    assert torch.equal(RECORDING.shows[1][pair.keypoints_1], RECORDING.shows[3][pair.keypoints_2])
    right = (true.keypoints_1 >= RIGHT_FROM) & (true.keypoints_2 >= RIGHT_FROM)
    assert set(pair.keypoints_1.tolist()) == set(true.keypoints_1[right].tolist())
    assert len(pair) == len(pair.keypoints_1) == int(right.sum())


def test_the_order_is_the_given_one_and_pairs_do_not_change_each_other() -> None:
    """Each pair is what it is alone, also if it is padded for one with more matches."""
    both = [RECORDING.pair(*ends) for ends in ((2, 3), (0, 1), (1, 3))]
    found = [
        (pair.first, pair.second, pair.keypoints_1[:count], pair.keypoints_2[:count])
        for pair, count in zip(both, (150, 90, 120), strict=True)
    ]
    matcher = matcher_of(RECORDING)
    together = matcher.verify(found)
    assert [(pair.first, pair.second) for pair in together] == [(2, 3), (0, 1), (1, 3)]
    for pair, each in zip(together, found, strict=True):
        (alone,) = matcher.verify([each])
        assert torch.equal(pair.keypoints_1, alone.keypoints_1)
        assert torch.equal(pair.keypoints_2, alone.keypoints_2)
        # A padded batch adds up in another order, and the refinement ends at a step, not at the last digit.
        torch.testing.assert_close(pair.T_21, alone.T_21, atol=1e-8, rtol=0)
        assert pair.relation is alone.relation


@pytest.mark.parametrize(
    ("matches", "samples"), [(20, 64), (24, 64), (30, 66), (40, 291), (50, 500), (400, 500)]
)
def test_no_more_samples_are_drawn_than_a_pair_that_just_holds_needs(matches: int, samples: int) -> None:
    """Of 40 matches 20 must agree: one of log 1e-4 / log(1 - .5^5) = 290.1 samples has no other, at 99.99 %."""
    assert most_samples(matches) == samples


def test_pairs_of_few_matches_are_searched_with_few_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    estimate = FakeEstimate(lambda count: count)
    monkeypatch.setattr("torchslam.global_mapping.view_graph.estimate_relative_pose", estimate)
    keypoints = torch.arange(40)
    matcher_of(RECORDING).verify([(0, 1, keypoints, keypoints), (1, 2, keypoints[:24], keypoints[:24])])
    (options,) = estimate.options
    assert options["max_samples"] == most_samples(40)


def test_a_camera_that_only_turns_gives_a_rotation() -> None:
    R = so3_exp(torch.tensor([0.02, -0.1, 0.03], dtype=torch.float64))
    T_cw = torch.stack([arc(1)[0], rigid(R, torch.zeros(3, dtype=torch.float64)) @ arc(1)[0]])
    recording = Recording.of(T_cw, ball(150), noise_px=0.3)
    (pair,) = matcher_of(recording).match([(0, 1)])
    assert pair.relation is Relation.ROTATION
    assert pair.T_21[:3, 3].tolist() == [0, 0, 0]
    assert float(degrees_between(pair.T_21[:3, :3], R)) < 0.1


@pytest.mark.parametrize(("step", "relation"), [(0.3, Relation.PLANE), (0.0, Relation.GENERAL)])
def test_a_plane_may_leave_two_directions(step: float, relation: Relation) -> None:
    """A wall before a camera that comes nearer as it walks along it; if it does not, one motion is in front of it."""
    points_w = torch.cat([3 * rand(0, 150, 2) - 1.5, torch.zeros(150, 1, dtype=torch.float64)], 1)
    move = se3_exp(torch.tensor([-0.4, 0, step, 0, 0, 0], dtype=torch.float64))
    recording = Recording.of(torch.stack([arc(1)[0], move @ arc(1)[0]]), points_w, noise_px=0.3)
    (pair,) = matcher_of(recording).match([(0, 1)])
    assert pair.relation is relation
    assert float(pair.T_21[:3, 3].norm()) == pytest.approx(1)


class FakeEstimate:
    """In place of the estimation of relative poses: chosen matches are inliers."""

    def __init__(self, inliers: Callable[[int], int], success: bool = True, model: str = "essential") -> None:
        self.inliers, self.success, self.model = inliers, success, model
        self.pixels: list[tuple[Tensor, Tensor]] = []
        self.masks: list[Tensor] = []
        self.options: list[dict[str, object]] = []

    def __call__(
        self,
        pixels_1: Tensor,
        pixels_2: Tensor,
        *,
        camera_1: Camera,
        camera_2: Camera,
        mask: Tensor,
        **options: object,
    ) -> SimpleNamespace:
        assert (camera_1, camera_2) == (CAMERA, CAMERA)
        self.pixels.append((pixels_1, pixels_2))
        self.masks.append(mask)
        self.options.append(options)
        counts = torch.tensor([self.inliers(int(count)) for count in mask.sum(1)])
        count = len(mask)
        return SimpleNamespace(
            inliers=torch.arange(mask.shape[1]) < counts[:, None],
            success=torch.full((count,), self.success),
            model=(self.model,) * count,
            T_21=torch.arange(count).double()[:, None, None].expand(count, 4, 4),
        )


def fake(
    monkeypatch: pytest.MonkeyPatch, inliers: Callable[[int], int] = int, **answer: object
) -> FakeEstimate:
    estimate = FakeEstimate(inliers, **answer)  # type: ignore[arg-type]
    monkeypatch.setattr(view_graph, "estimate_relative_pose", estimate)
    return estimate


@pytest.mark.parametrize(
    ("matches", "inliers", "holds"),
    [
        (MIN_MATCHES, MIN_MATCHES, True),
        (MIN_MATCHES, MIN_MATCHES - 1, False),
        (120, 30, True),
        (121, 30, False),
        (124, 31, True),
        (125, 31, False),
    ],
)
def test_enough_matches_and_a_quarter_of_all_must_hold(
    monkeypatch: pytest.MonkeyPatch, matches: int, inliers: int, holds: bool
) -> None:
    fake(monkeypatch, lambda count: inliers)
    pair = RECORDING.pair(0, 1)
    found = [(0, 1, pair.keypoints_1[:matches], pair.keypoints_2[:matches])]
    held = matcher_of(RECORDING).verify(found)
    assert len(held) == holds
    if held:
        assert torch.equal(held[0].keypoints_1, pair.keypoints_1[:inliers])
        assert torch.equal(held[0].keypoints_2, pair.keypoints_2[:inliers])


@pytest.mark.parametrize(
    ("success", "model", "relation"),
    [
        (True, "essential", Relation.GENERAL),
        (True, "homography", Relation.GENERAL),
        (False, "homography", Relation.PLANE),
        (False, "rotation", Relation.ROTATION),
    ],
)
def test_the_model_of_the_matches_gives_the_relation(
    monkeypatch: pytest.MonkeyPatch, success: bool, model: str, relation: Relation
) -> None:
    fake(monkeypatch, success=success, model=model)
    assert matcher_of(RECORDING).match([(0, 1)])[0].relation is relation


def test_the_threshold_is_one_and_a_half_pixels_of_the_reduced_image(monkeypatch: pytest.MonkeyPatch) -> None:
    """The truncated kernel sets it for all of the search, which is a short one and has the seed of the run."""
    estimate = fake(monkeypatch)
    small = load_config(None, [f"features.max_image_pixels={320 * 240}", "seed=7"])
    for config, threshold in ((CONFIG, 1.5), (small, 3.0)):
        matcher = matcher_of(RECORDING, config)
        assert matcher.threshold_px == pytest.approx(threshold)
        pair = RECORDING.pair(0, 1)
        matcher.verify([(0, 1, pair.keypoints_1, pair.keypoints_2)])
        options = estimate.options[-1]
        assert (options["threshold"], options["seed"]) == (matcher.threshold_px, config.seed)
        assert (options["kernel"], options["min_samples"], options["max_samples"]) == ("truncated", 64, 500)


def test_too_few_matches_are_not_even_verified(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing to verify is no error; with enough of them it is tried, in the given order."""

    def first_matches(one: FrameFeatures, other: FrameFeatures, prior: MatchPrior | None) -> Matches:
        assert prior is None
        count = one.index - 100 + MIN_MATCHES - 1
        rows, columns = torch.arange(count)[None], torch.arange(50, 50 + count)[None]
        return Matches(rows, columns, rows.float(), torch.ones(1, count, dtype=torch.bool))

    estimate = fake(monkeypatch)
    matcher = PairMatcher(RECORDING.views, CAMERA, first_matches, CONFIG)
    assert matcher.match([(0, 1)]) == matcher.match([]) == []
    assert estimate.masks == []
    held = matcher.match([(2, 3), (0, 3), (1, 2)])
    assert [(pair.first, pair.second, len(pair)) for pair in held] == [
        (2, 3, MIN_MATCHES + 1),
        (1, 2, MIN_MATCHES),
    ]
    assert held[0].keypoints_1.tolist() == list(range(MIN_MATCHES + 1))
    assert held[0].keypoints_2.tolist() == list(range(50, 51 + MIN_MATCHES))


# --- which pairs are tried -------------------------------------------------------------------------------------


class FakeMatcher(PairMatcher):
    """Answers at once whether a pair holds, and notes what it was asked."""

    def __init__(self, count: int, holds: Callable[[int, int], bool] = lambda first, second: True) -> None:
        self.views = [replace(RECORDING.views[0], index=index) for index in range(count)]
        self.holds = holds
        self.asked: list[tuple[int, int]] = []

    def match(self, pairs: Iterable[tuple[int, int]]) -> list[ViewPair]:
        asked = list(pairs)
        self.asked += asked
        return [view_pair(*pair, (0, 0)) for pair in asked if self.holds(*pair)]

    def firsts(self, distance: int) -> list[int]:
        """The first images of the pairs that were asked for at a distance, in order."""
        return [first for first, second in self.asked if second - first == distance]

    @property
    def distances(self) -> list[int]:
        """The distances that were asked for, ascending."""
        return sorted({second - first for first, second in self.asked})


@pytest.fixture
def _without_places(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(view_graph, "similar_places", lambda views: [])


@pytest.mark.usefixtures("_without_places")
@pytest.mark.parametrize(
    ("count", "distances"),
    [
        (1, []),
        (2, [1]),
        (4, [1, 2, 3]),
        (8, [1, 2, 3, 5]),
        (9, [1, 2, 3, 5, 8]),
        (16, [1, 2, 3, 5, 8]),
        (17, [1, 2, 3, 5, 8, 16]),
        (32, [1, 2, 3, 5, 8, 16]),
        (70, [1, 2, 3, 5, 8, 16, 32, 64]),
    ],
)
def test_neighbors_are_tried_at_a_few_distances(count: int, distances: list[int]) -> None:
    """Every pair at these, once; they are given by first, then second image."""
    matcher = FakeMatcher(count)
    pairs = build_view_graph(matcher)
    assert matcher.distances == distances
    for distance in distances:
        assert matcher.firsts(distance) == list(range(count - distance))
    ends = [(pair.first, pair.second) for pair in pairs]
    assert ends == sorted(set(matcher.asked))
    assert len(matcher.asked) == len(ends)


@pytest.mark.usefixtures("_without_places")
def test_far_pairs_are_tried_where_the_nearer_ones_held() -> None:
    """At 16 after 8, at 32 after 16; what holds at 5 or fails at 1 to 5 does not matter."""
    held = {8: [3, 20, 40, 55], 16: [20, 40], 32: [20]}
    matcher = FakeMatcher(80, lambda first, second: first in held.get(second - first, []))
    pairs = build_view_graph(matcher)
    assert [matcher.firsts(distance) for distance in (16, 32, 64)] == [[3, 20, 40, 55], [20, 40], []]
    assert [(pair.first, pair.second) for pair in pairs] == [
        (3, 11),
        (20, 28),
        (20, 36),
        (20, 52),
        (40, 48),
        (40, 56),
        (55, 63),
    ]
    never = FakeMatcher(80, lambda first, second: False)
    assert build_view_graph(never) == []
    assert never.distances == [1, 2, 3, 5, 8]


def test_similar_places_are_tried_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those that held as neighbors are not tried again, those that failed are."""
    matcher = FakeMatcher(20, lambda first, second: (first, second) != (1, 17))
    monkeypatch.setattr(view_graph, "similar_places", lambda views: [(0, 16), (0, 18), (1, 17), (2, 19)])
    pairs = build_view_graph(matcher)
    assert matcher.asked[-3:] == [(0, 18), (1, 17), (2, 19)]
    ends = [(pair.first, pair.second) for pair in pairs]
    assert ends == sorted(set(ends))
    assert [pair for pair in ends if pair[1] - pair[0] > 15] == [(0, 16), (0, 18), (2, 18), (2, 19), (3, 19)]


class FakePlaces:
    """A database in which the similarity of images is given, zero where it is not."""

    def __init__(self, scores: dict[tuple[int, int], float]) -> None:
        self.scores = scores | {(second, first): score for (first, second), score in scores.items()}
        self.added: list[tuple[int, Tensor, Tensor]] = []

    def add(self, key: int, descriptors: Tensor, mask: Tensor) -> None:
        self.added.append((key, descriptors, mask))

    def query_by_key(self, key: int) -> tuple[Tensor, Tensor]:
        """All images, the best first, as the database does."""
        scores = torch.tensor([self.scores.get((key, other), 0.0) for other in range(len(self.added))])
        ranked = torch.sort(scores, descending=True, stable=True)
        return ranked.indices, ranked.values


def similar(
    monkeypatch: pytest.MonkeyPatch, count: int, scores: dict[tuple[int, int], float]
) -> list[tuple[int, int]]:
    database = FakePlaces(scores)
    monkeypatch.setattr(view_graph, "KeyframeDatabase", lambda: database)
    views = FakeMatcher(count).views
    found = similar_places(views)
    for row, (key, descriptors, mask) in enumerate(database.added):
        assert key == row
        assert descriptors is views[row].descriptors
        assert mask is views[row].mask
    assert len(database.added) == count
    return found


def test_similar_places_are_no_near_neighbors(monkeypatch: pytest.MonkeyPatch) -> None:
    """At a distance of 15 images it is a neighbor, at 16 a place seen again; in either order of time."""
    assert similar(monkeypatch, 40, {(2, 17): 0.5}) == []
    assert similar(monkeypatch, 40, {(2, 18): 0.5}) == [(2, 18)]
    assert similar(monkeypatch, 40, {(5, 20): 0.5, (4, 20): 0.5, (3, 20): 0.5}) == [(3, 20), (4, 20)]


def test_the_two_most_similar_places_of_every_other_image_are_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """An image with an odd number does not ask, but may be the answer; one that is alike in nothing is none."""
    scores = {(0, 17): 0.2, (0, 19): 0.4, (0, 21): 0.3, (0, 39): 0.1}
    assert similar(monkeypatch, 40, scores) == [(0, 19), (0, 21)]
    assert similar(monkeypatch, 40, {(1, 39): 0.9, (3, 38): 1e-6}) == [(3, 38)]
    # What is asked from both sides is one pair, and neighbors that are more alike take no place.
    scores = {(0, 1): 0.9, (0, 2): 0.9, (0, 3): 0.9, (0, 30): 0.1, (4, 30): 0.2, (2, 30): 0.3}
    assert similar(monkeypatch, 40, scores) == [(0, 30), (2, 30), (4, 30)]


def test_a_place_that_is_seen_again_is_found() -> None:
    """By its descriptors, of which those that are masked do not count."""
    walk = [0.3 * row for row in range(40)] + [3.0]  # the last image is where the eleventh was
    T_cw = EYE.repeat(41, 1, 1)
    T_cw[:, 0, 3] = -torch.tensor(walk, dtype=torch.float64)
    views = Recording.of(T_cw, wall(600, 12.0)).views
    found = similar_places(views)
    assert (10, 40) in found
    assert (9, 40) in found or (11, 40) in found
    assert found == sorted(set(found))
    blind = [replace(view, mask=torch.zeros_like(view.mask)) for view in views]
    assert similar_places(blind) == similar_places([]) == []


# --- connected images ------------------------------------------------------------------------------------------


def test_the_largest_connected_component_of_views() -> None:
    """Of equal ones that with the lowest image; images without pairs are components as well."""
    pairs = [view_pair(first, second, (0, 0)) for first, second in ((0, 3), (1, 5), (4, 5), (2, 4))]
    assert connected_views(pairs, 7).tolist() == [1, 2, 4, 5]
    assert connected_views(pairs[:2], 7).tolist() == [0, 3]
    assert connected_views([], 3).tolist() == [0]
    assert connected_views([], 0).tolist() == []


@given(st.integers(2, 30), st.data())
@settings(max_examples=60, deadline=None)
def test_connected_components_are_right(count: int, data: st.DataObject) -> None:
    rows = st.integers(0, count - 1)
    ends = data.draw(st.lists(st.tuples(rows, rows).filter(lambda pair: pair[0] < pair[1]), max_size=count))
    parts = [{row} for row in range(count)]
    for first, second in ends:
        joined = parts[first] | parts[second]
        for row in joined:
            parts[row] = joined
    size = max(len(part) for part in parts)
    expected = next(sorted(part) for part in parts if len(part) == size)
    pairs = [view_pair(first, second, (0, 0)) for first, second in ends]
    assert connected_views(pairs, count).tolist() == expected
