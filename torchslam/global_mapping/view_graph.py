"""The view graph: pairs of images that see the same, with their verified matches and relative poses.

Pairs are neighbors in time, near ones always, far ones where nearer ones held, and images of similar places.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import Enum
from functools import cached_property, partial

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchslam.config import Config
from torchslam.features import match
from torchslam.features.matching.brute_force import match_sorted
from torchslam.features.matching.cosine import Directions, SortedDescriptors
from torchslam.geometry import Camera, estimate_relative_pose
from torchslam.geometry.ransac import CONFIDENCE, samples_needed
from torchslam.loop_closing.keyframe_database import KeyframeDatabase
from torchslam.tracking.matcher import DescriptorMatcher, max_distance, run_matcher
from torchslam.types import FrameFeatures, Matcher, MatchIndices
from torchslam.utils.indexing import connected_parts

NEAR = 1, 2, 3, 5, 8
"""Distances in images at which all neighbors in time are matched: a blurred image breaks no chain. On garden all of 1
to 8 give the same poses, for half more time."""
FAR = 16
"""Distance from which on, doubling, neighbors are matched where those at the distance before held."""
PLACES = 2
"""Images of similar places that each image is matched with, beyond its neighbors in time."""
MIN_MATCHES = 20
"""Least number of verified matches of a pair. On a phone's walk (garden, SIFT) 1.7 % of the relative rotations of pairs
with 20 or more are off by more than 5 degrees, 0.3 % with 30 or more, 3.5 % with 15 or more; averaging tolerates a
third. Between bare walls there are no more. Tried 15 to 50."""
MIN_RATIO = 0.25
"""Least ratio of verified to all matches: below, repetitive structure or chance explains them; tried 0.15 to 0.4."""
THRESHOLD_PX = 1.5
"""Distance from the epipolar line, at the size at which features are found: twice the noise of SIFT. Tried 1 to 3."""
_IMAGES_AT_ONCE = 32
"""Images that are matched with their near neighbors, and saved, together. Tried at this value only."""
_PAIRS_AT_ONCE, _MIN_SAMPLES, _MAX_SAMPLES = 32, 64, 500
"""Pairs that are verified in one batch, which bounds the memory; least and largest number of samples of each.
Tried at these values only."""
_DIRECTIONS_OF = 16
"""Most images whose descriptors determine the directions in which they differ. Tried at this value only."""
_SORTED_AT_ONCE = 16
"""Sorted descriptors of images that are kept, 1 KB for each keypoint: near neighbors are among them. Images further
apart are sorted again, which takes a tenth of the time of a match."""
_SAMPLE = 5
"""Matches in a sample, which determine an essential matrix."""


class Relation(Enum):
    """What the matches of a pair determine."""

    GENERAL = "rotation and direction"
    PLANE = "rotation; two directions are possible"
    ROTATION = "rotation; a rotation alone explains the matches"


@dataclass(frozen=True)
class ViewPair:
    """Two images that see the same.

    Attributes:
        first: row of an image.
        second: row of a later one.
        keypoints_1: keypoints of the first image, verified.
        keypoints_2: matching keypoints of the second image.
        T_21: from the first to the second camera, translation of length one, zero for a rotation.
        relation: what the matches determine.
    """

    first: int
    second: int
    keypoints_1: Int[Tensor, " M"]
    keypoints_2: Int[Tensor, " M"]
    T_21: Float[Tensor, "4 4"]
    relation: Relation

    def __len__(self) -> int:
        """The number of verified matches."""
        return len(self.keypoints_1)


MatchedPair = tuple[int, int, Int[Tensor, " _"], Int[Tensor, " _"]]
"""Rows of two images, and the keypoints of either that match."""


class PairMatcher:
    """Matches pairs of images and verifies them by two-view geometry.

    Args:
        views: features of all images.
        camera: of all images.
        matcher: of two views.
        config: reduction of the images, and the seed.
    """

    def __init__(self, views: list[FrameFeatures], camera: Camera, matcher: Matcher, config: Config) -> None:
        self.views, self.camera, self.matcher, self.config = views, camera, matcher, config
        self.threshold_px = THRESHOLD_PX * config.features.reduction(camera.size)
        self._sorted: dict[int, SortedDescriptors] = {}

    def match(self, pairs: Iterable[tuple[int, int]]) -> list[ViewPair]:
        """The pairs that hold, in the given order."""
        found = []
        for one, other in pairs:
            matches = self.match_two(one, other)
            if len(matches.first) >= MIN_MATCHES:
                found.append((one, other, matches.first, matches.second))
        return self.verify(found)

    def match_two(
        self,
        one: int,
        other: int,
        laxer: float = 1.0,
        near: Callable[[Tensor, Tensor], Tensor] | None = None,
    ) -> MatchIndices:
        """The matches of two images, not verified.

        Args:
            one, other: rows of the images.
            laxer: factor on the ratio test of torchslam's own matcher.
            near: which of some rows and columns, (R, C), its matches may join; None: all.
        """
        view_1, view_2 = self.views[one], self.views[other]
        if type(self.matcher) is not DescriptorMatcher:
            return run_matcher(self.matcher, view_1, view_2)
        settings = self.matcher.settings
        ratio = None if settings.max_ratio is None else laxer * settings.max_ratio
        limit = max_distance(view_1.descriptors, settings)
        if self._directions is not None:
            found = match_sorted(self._sorted_row(one), self._sorted_row(other), ratio, limit, near)
        else:
            rows = (torch.arange(len(view.mask), device=view.mask.device) for view in (view_1, view_2))
            allowed = None if near is None else near(*rows)[None]
            found = match(view_1.features, view_2.features, ratio, max_distance=limit, allowed=allowed)
        mask = found.mask[0]
        return MatchIndices(found.indices_1[0, mask], found.indices_2[0, mask])

    @cached_property
    def _directions(self) -> Directions | None:
        """Those by which torchslam's own matcher chooses, of images spread over all; None: it does not."""
        if type(self.matcher) is not DescriptorMatcher:
            return None
        chosen = self.views[:: -(-len(self.views) // _DIRECTIONS_OF)]
        return Directions.of_images([view.descriptors for view in chosen], [view.mask for view in chosen])

    def _sorted_row(self, row: int) -> SortedDescriptors:
        """The descriptors of an image along the directions; some are kept, since pairs follow each other in time."""
        if row not in self._sorted:
            assert self._directions is not None
            if len(self._sorted) == _SORTED_AT_ONCE:
                del self._sorted[next(iter(self._sorted))]
            self._sorted[row] = self._directions.sort(self.views[row].descriptors, self.views[row].mask)
        return self._sorted[row]

    def verify(self, found: list[MatchedPair]) -> list[ViewPair]:
        """The matched pairs that hold, verified."""
        # Those with about as many matches together, so that little is padded.
        order = sorted(range(len(found)), key=lambda row: len(found[row][2]))
        held: dict[int, ViewPair] = {}
        for start in range(0, len(order), _PAIRS_AT_ONCE):
            rows = order[start : start + _PAIRS_AT_ONCE]
            held |= {rows[at]: pair for at, pair in self._verified([found[row] for row in rows]).items()}
        return [held[row] for row in sorted(held)]

    def _verified(self, found: list[MatchedPair]) -> dict[int, ViewPair]:
        """The pairs that hold, by their place in a batch."""
        pixels_1, pixels_2, mask = padded_matches(self.views, found, self.camera.params)
        relative = estimate_relative_pose(
            pixels_1,
            pixels_2,
            camera_1=self.camera,
            camera_2=self.camera,
            threshold=self.threshold_px,
            mask=mask,
            seed=self.config.seed,
            max_samples=most_samples(mask.shape[1]),
            kernel="truncated",
            min_samples=_MIN_SAMPLES,
        )
        pairs = {}
        for row, (one, other, at_1, at_2) in enumerate(found):
            inliers = relative.inliers[row, : len(at_1)]
            if int(inliers.sum()) < least_verified(len(at_1)):
                continue
            relation = Relation.GENERAL if bool(relative.success[row]) else Relation.PLANE
            relation = Relation.ROTATION if relative.model[row] == "rotation" else relation
            pairs[row] = ViewPair(one, other, at_1[inliers], at_2[inliers], relative.T_21[row], relation)
        return pairs


def padded_matches(
    views: list[FrameFeatures], found: list[MatchedPair], like: Tensor
) -> tuple[Float[Tensor, "B N 2"], Float[Tensor, "B N 2"], Bool[Tensor, "B N"]]:
    """The matching keypoints of pairs in as many rows each, of the type of `like`, and which rows are filled."""
    size = max(len(at_1) for _, _, at_1, _ in found)
    pixels = like.new_zeros(2, len(found), size, 2)
    mask = torch.zeros(len(found), size, dtype=torch.bool, device=pixels.device)
    for row, (one, other, at_1, at_2) in enumerate(found):
        mask[row, : len(at_1)] = True
        pixels[0, row, : len(at_1)] = views[one].keypoints[at_1]
        pixels[1, row, : len(at_1)] = views[other].keypoints[at_2]
    return pixels[0], pixels[1], mask


def least_verified(matches: int) -> float:
    """The number of verified ones of so many matches from which on a pair holds."""
    return max(MIN_MATCHES, MIN_RATIO * matches)


def most_samples(matches: int) -> int:
    """Samples that find the motion of a pair that just holds: of few matches nearly all must agree."""
    least, of = (torch.tensor([round(count)], device="cpu") for count in (least_verified(matches), matches))
    needed = float(samples_needed(least, of, _SAMPLE, CONFIDENCE))
    return math.ceil(min(max(needed, _MIN_SAMPLES), _MAX_SAMPLES))


def build_view_graph(
    matcher: PairMatcher,
    progress: Callable[[int, int], None] = lambda done, most: None,
    match: Callable[[PairMatcher, Iterable[tuple[int, int]]], list[ViewPair]] | None = None,
) -> list[ViewPair]:
    """Match every image with its neighbors in time and with images of similar places.

    Args:
        matcher: of the images, which are in the order of time.
        progress: called with the number of steps done, and of all.
        match: matches pairs by the matcher, or knows the result; None: `PairMatcher.match`.

    Returns:
        The pairs that hold, by first, then second image.
    """
    find = partial(match, matcher) if match else matcher.match
    count = len(matcher.views)
    far = [FAR << doubled for doubled in range(count.bit_length()) if FAR << doubled < count]
    groups = range(0, count, _IMAGES_AT_ONCE)
    steps = len(groups) + len(far) + 1
    pairs: list[ViewPair] = []
    for done, start in enumerate(groups):
        progress(done, steps)
        rows = range(start, min(start + _IMAGES_AT_ONCE, count))
        pairs += find((row, row + distance) for row in rows for distance in NEAR if row + distance < count)
    held = [pair.first for pair in pairs if pair.second - pair.first == NEAR[-1]]
    for done, distance in enumerate(far, len(groups)):
        progress(done, steps)
        found = find((row, row + distance) for row in held if row + distance < count)
        pairs += found
        held = [pair.first for pair in found]
    progress(steps - 1, steps)
    known = {(pair.first, pair.second) for pair in pairs}
    pairs += find(pair for pair in similar_places(matcher.views) if pair not in known)
    return sorted(pairs, key=lambda pair: (pair.first, pair.second))


def similar_places(views: list[FrameFeatures]) -> list[tuple[int, int]]:
    """The pairs of images that look most alike, further apart than neighbors; the best of every other image."""
    places = KeyframeDatabase()
    for row, view in enumerate(views):
        places.add(row, view.descriptors, view.mask)
    pairs = set()
    for row in range(0, len(views), 2):
        keys, scores = places.query_by_key(row)
        alike = keys[(scores > 0) & ((keys - row).abs() >= FAR)][:PLACES]
        pairs |= {(min(row, other), max(row, other)) for other in alike.tolist()}
    return sorted(pairs)


def connected_views(pairs: list[ViewPair], count: int) -> Int[Tensor, " K"]:
    """The rows of the largest set of `count` views that pairs connect, ascending; of equal ones the lowest."""
    ends = torch.tensor([(pair.first, pair.second) for pair in pairs], dtype=torch.int64, device="cpu")
    label = connected_parts(ends.view(-1, 2), count)
    return (label == torch.bincount(label).argmax()).nonzero()[:, 0] if count else label
