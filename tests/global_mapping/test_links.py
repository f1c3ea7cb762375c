"""Weak links are found by their matches, and matched again near the epipolar lines of approximate poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from torch import Tensor

from tests.global_mapping.synthetic import CAMERA, Recording, disturbed, line, wall
from torchslam.config import Config
from torchslam.geometry import se3_inverse
from torchslam.global_mapping.baselines import ViewRays
from torchslam.global_mapping.links import (
    ACROSS,
    match_guided,
    near_epipolar_line,
    pairs_around,
    strengthen,
    weak_links,
)
from torchslam.global_mapping.mapper import mapping_config
from torchslam.global_mapping.view_graph import PairMatcher, ViewPair
from torchslam.tracking.matcher import make_matcher
from torchslam.types import FrameFeatures, Matches, MatchPrior

WALK = Recording.of(line(10), wall(200, 2.5), noise_px=0.3, first=0)


def matcher_of(recording: Recording) -> PairMatcher:
    config = mapping_config(Config())
    return PairMatcher(recording.views, CAMERA, make_matcher(config.matching), config)


def of_size(first: int, second: int, count: int) -> ViewPair:
    """A pair with so many matches."""
    rows = torch.arange(count)
    return ViewPair(first, second, rows, rows, torch.eye(4).double(), WALK.pair(0, 1).relation)


def links(sizes: Sequence[int], *others: ViewPair) -> list[tuple[list[int], list[int]]]:
    """The weak links of images of which neighbors have so many matches."""
    return weak_links([*(of_size(row, row + 1, size) for row, size in enumerate(sizes)), *others])


def test_links_with_few_matches_are_weak() -> None:
    """Less than two thirds of the median: 67 of 100 are enough, 66 are not."""
    sizes = [100] * 10
    assert links(sizes) == []
    sizes[4], sizes[8] = 66, 67
    assert links(sizes) == [([2, 3, 4], [5, 6, 7])]
    sizes[0] = 10
    assert links(sizes) == [([0], [1, 2, 3]), ([2, 3, 4], [5, 6, 7])]
    sizes[9] = 10
    assert links(sizes)[-1] == ([7, 8, 9], [10])


def test_the_best_pair_of_near_images_counts() -> None:
    """One that goes across from further away; but not from another time."""
    sizes = [100] * 40
    sizes[4] = 20
    assert links(sizes, of_size(2, 6, 80)) == []
    assert links(sizes, of_size(0, 15, 80)) == []
    assert links(sizes, of_size(0, 16, 80)) == [([2, 3, 4], [5, 6, 7])]


def test_images_that_no_pair_has_are_passed_over() -> None:
    """As those of another part: a link is between the images before and after them."""
    pairs = [of_size(one, other, 100) for one, other in pairwise((0, 1, 2, 3, 7, 8, 9, 10))]
    assert weak_links(pairs) == []
    pairs[3] = of_size(3, 7, 50)
    assert weak_links(pairs) == [([1, 2, 3], [7, 8, 9])]
    assert pairs_around(weak_links(pairs)) == []  # further apart than three
    assert weak_links([]) == []


def test_pairs_around_links_are_up_to_three_apart() -> None:
    assert ACROSS == 3
    assert pairs_around([([2, 3, 4], [5, 6, 7])]) == [(2, 5), (3, 5), (3, 6), (4, 5), (4, 6), (4, 7)]
    assert pairs_around([([2, 3, 4], [5, 6, 7]), ([3, 4, 5], [6, 7, 8])]) == [
        (2, 5), (3, 5), (3, 6), (4, 5), (4, 6), (4, 7), (5, 6), (5, 7), (5, 8),
    ]  # fmt: skip


def repetitive(recording: Recording) -> Recording:
    """Each two points look the same, but for little: few matches pass the ratio test."""
    views = []
    for shows, view in zip(recording.shows, recording.views, strict=True):
        of_point = view.descriptors[torch.argsort(shows)]
        alike = of_point[2 * (torch.arange(len(shows)) // 2)]
        mixed = torch.nn.functional.normalize(alike + 0.1 * of_point, dim=-1)
        views.append(replace(view, descriptors=mixed[shows]))
    return replace(recording, views=views)


def test_repetitive_structure_is_matched_by_the_poses() -> None:
    """Where all against all finds little, the epipolar line tells two points apart that look the same."""
    recording = repetitive(WALK)
    matcher = matcher_of(recording)
    free = matcher.match([(4, 5)])
    T_21 = recording.T_cw[5] @ se3_inverse(recording.T_cw[4])
    found = match_guided(matcher, 4, 5, T_21, ViewRays(CAMERA, recording.views))
    right = recording.shows[4][found.first] == recording.shows[5][found.second]
    assert float(right.double().mean()) > 0.95
    assert len(right) > 3 * sum(map(len, free))


@pytest.mark.parametrize(("limit_px", "near"), [(11.0, False), (13.0, True)])
def test_matches_are_near_their_epipolar_line(limit_px: float, near: bool) -> None:
    """A keypoint twelve pixels above the line; along the line it may be anywhere."""
    T_21 = WALK.T_cw[5] @ se3_inverse(WALK.T_cw[4])

    def at(*pixels: tuple[float, float]) -> Tensor:
        return CAMERA.unproject(torch.tensor(pixels, dtype=torch.float64))

    is_near = near_epipolar_line(
        at((320, 240), (330, 250)),
        at((320, 228), (260, 228), (600, 250)),
        T_21,
        limit_px / float(CAMERA.focal),
    )
    allowed = is_near(torch.arange(2), torch.arange(3))
    assert torch.equal(is_near(torch.tensor([1]), torch.tensor([2, 0])), allowed[1:][:, [2, 0]])
    assert allowed.tolist() == [[near, near, True], [False, False, True]]


def test_weak_links_get_more_matches() -> None:
    """Those of the view graph stay where they are more, and what is far from a weak link is as it was."""
    pairs = WALK.pairs(1, 2)
    few = [
        replace(pair, keypoints_1=pair.keypoints_1[:30], keypoints_2=pair.keypoints_2[:30])
        if pair.first <= 4 < pair.second
        else pair
        for pair in pairs
    ]
    found = strengthen(matcher_of(WALK), few, disturbed(WALK.T_cw, 0.01, 0.3), CAMERA)
    ends = {(pair.first, pair.second): pair for pair in found}
    assert list(ends) == sorted({(pair.first, pair.second) for pair in few} | {(2, 5), (3, 6), (4, 7)})
    for pair in few:
        after = ends[pair.first, pair.second]
        if pair.first <= 4 < pair.second:
            assert len(after) > 60
            assert bool(
                (
                    WALK.shows[pair.first][after.keypoints_1] == WALK.shows[pair.second][after.keypoints_2]
                ).all()
            )
        else:
            assert after is pair
    strong = WALK.pairs(1, 2)
    assert strengthen(matcher_of(WALK), strong, WALK.T_cw, CAMERA) == strong


def test_other_matchers_receive_the_pose() -> None:
    """And the limit at the size of the images."""
    asked: list[MatchPrior | None] = []

    def first_three(view_1: FrameFeatures, view_2: FrameFeatures, prior: MatchPrior | None) -> Matches:
        asked.append(prior)
        rows = torch.arange(3)[None]
        return Matches(rows, rows, torch.zeros(1, 3), torch.ones(1, 3, dtype=torch.bool))

    matcher = PairMatcher(WALK.views, CAMERA, first_three, Config())
    T_21: Tensor = WALK.T_cw[1]
    views = [replace(view, mask=torch.ones_like(view.mask)) for view in WALK.views]
    matcher.views = views
    assert match_guided(matcher, 0, 1, T_21, ViewRays(CAMERA, views)).first.tolist() == [0, 1, 2]
    (prior,) = asked
    assert prior is not None
    assert prior.T_21 is T_21
    assert prior.camera is CAMERA
    assert prior.epipolar_px == 12
