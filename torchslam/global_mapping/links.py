"""Links of the view graph that few matches hold: matched again by approximate poses, and tied by learned features.

Where few tracks cross a moment, each side may be exact and the scale between them off. By approximate poses a match may
lie near its epipolar line only, so that fewer descriptors compete and the ratio test may be laxer.

Links that SIFT does not hold are tied by XFeat, matched by LightGlue, where asked for. Their keypoints are other points
than those of SIFT. So images near such a link get them in addition, with the noise of their own, and the points that
they see have tracks of their own in the same map.

Sources: Potje et al., "XFeat: accelerated features for lightweight image matching", CVPR 2024; Lindenberger, Sarlin and
Pollefeys, "LightGlue: local feature matching at light speed", ICCV 2023.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize, pad

from torchslam.config import Config
from torchslam.errors import ConfigError
from torchslam.features.weights import weights_file
from torchslam.geometry import Camera, se3_inverse
from torchslam.global_mapping.baselines import ViewRays
from torchslam.global_mapping.rounds import ObservedTracks, Reconstruction
from torchslam.global_mapping.view_graph import FAR, MIN_MATCHES, THRESHOLD_PX, PairMatcher, ViewPair
from torchslam.map.map import KEYPOINT_COLUMNS
from torchslam.tracking.matcher import DescriptorMatcher, run_matcher
from torchslam.types import FrameFeatures, MatchIndices, MatchPrior

WEAK = 2 / 3
"""A link is weak if its best pair of neighbors has fewer matches than this share of the median over all moments. With a
half, garden is 7.1 mm off, with two thirds 6.4, with none 9.1."""
ACROSS = 3
"""Largest distance in images of the pairs across a weak link that are matched again. Up to 6, images see so little in
common that chance matches win: garden 7.2 mm off, and one image of courthouse lost."""
GUIDED_RATIO = 1.25
"""Factor on the ratio test: fewer descriptors compete. Without the laxer test garden is 8.1 mm off in place of 6.4,
without any test 6 to 24."""
EPIPOLAR_PX = 12.0
"""Largest distance of a match from its epipolar line, at the size at which features are found: poses are still off. 6
gives the same."""

WEIGHTS = "xfeat-lighterglue"
"""Name of the weights of both networks, which were trained together."""
NUM_KEYPOINTS = 1000
"""Learned keypoints of an image, of which those with verified matches are kept. Neighbors then have 199 to 467 verified
matches between the bare walls of office_loop (every second image), where SIFT has 20 to 27 or none. Tried at this value
only."""
MIN_LEARNED_MATCHES = 80
"""Least number of verified matches of a pair. LightGlue finds some between images that share nothing as well, and they
verify each other: of pairs one to three images apart (courthouse, office_loop, every second image) with 20 to 79
verified matches 66 % have a rotation that is off by more than 5 degrees, of those with more 3 %. Tried at 50 and 80."""
HELD = 50
"""Points that images on both sides of a moment must agree on so that SIFT holds the link. On office_loop, whose every
image is posed, the fewest are 68. Tried at 30 and 50."""

Links = Sequence[tuple[list[int], list[int]]]
"""The images nearest before each link, ascending, and those after it."""


def strengthen(
    matcher: PairMatcher, pairs: list[ViewPair], T_cw: Float[Tensor, "K 4 4"], camera: Camera
) -> list[ViewPair]:
    """The pairs with those across weak links matched again, where that gives more matches.

    Args:
        matcher: of the images.
        pairs: verified, by first, then second image.
        T_cw: approximate poses of the images.
        camera: of all images.
    """
    best = {(pair.first, pair.second): pair for pair in pairs}
    found, rays = [], ViewRays(camera, matcher.views)
    for one, other in pairs_around(weak_links(pairs)):
        T_21 = T_cw[other] @ se3_inverse(T_cw[one])
        matches = match_guided(matcher, one, other, T_21, rays)
        if len(matches.first) >= MIN_MATCHES:
            found.append((one, other, matches.first, matches.second))
    for pair in matcher.verify(found):
        ends = pair.first, pair.second
        if ends not in best or len(pair) > len(best[ends]):
            best[ends] = pair
    return [best[ends] for ends in sorted(best)]


def weak_links(pairs: Sequence[ViewPair]) -> Links:
    """The weak links between images that pairs connect."""
    rows = sorted({row for pair in pairs for row in (pair.first, pair.second)})
    ends = np.array([(pair.first, pair.second) for pair in pairs]).reshape(-1, 2)
    sizes = np.array([len(pair) for pair in pairs])
    near = ends[:, 1] - ends[:, 0] < FAR
    most = np.array(
        [sizes[near & (ends[:, 0] <= row) & (ends[:, 1] > row)].max(initial=0) for row in rows[:-1]]
    )
    if len(most) == 0:
        return []
    return _around(rows, np.flatnonzero(most < WEAK * np.median(most)).tolist())


def _around(rows: Sequence[int], links: Sequence[int]) -> Links:
    return [
        (list(rows[max(at + 1 - ACROSS, 0) : at + 1]), list(rows[at + 1 : at + 1 + ACROSS])) for at in links
    ]


def pairs_around(links: Links) -> list[tuple[int, int]]:
    """The pairs of images on both sides of links that are matched again, ascending."""
    pairs = {ends for before, after in links for ends in product(before, after)}
    return sorted((one, other) for one, other in pairs if other - one <= ACROSS)


def match_guided(
    matcher: PairMatcher, one: int, other: int, T_21: Float[Tensor, "4 4"], rays: ViewRays
) -> MatchIndices:
    """Match two images of which the relative pose is known approximately.

    Matchers that are not torchslam's own receive the pose as a prior.
    """
    view_1, view_2 = matcher.views[one], matcher.views[other]
    limit_px = EPIPOLAR_PX * matcher.threshold_px / THRESHOLD_PX
    if type(matcher.matcher) is not DescriptorMatcher or not view_1.descriptors.is_floating_point():
        prior = MatchPrior(T_21=T_21, camera=rays.camera, epipolar_px=limit_px)
        return run_matcher(matcher.matcher, view_1, view_2, prior)
    near = near_epipolar_line(rays[one], rays[other], T_21, limit_px / rays.focal)
    return matcher.match_two(one, other, GUIDED_RATIO, near)


def near_epipolar_line(
    rays_1: Float[Tensor, "N 3"], rays_2: Float[Tensor, "M 3"], T_21: Float[Tensor, "4 4"], limit: float
) -> Callable[[Int[Tensor, " R"], Int[Tensor, " C"]], Bool[Tensor, "R C"]]:
    """Which of some rays of the second view are within an angle of the epipolar line of each of some of the first.

    In single precision, as the limit, in radians, is wide.
    """
    turned = rays_1 @ T_21[:3, :3].mT
    normals = normalize(torch.linalg.cross(T_21[:3, 3].expand_as(turned), turned), dim=-1).float()
    rays_2 = rays_2.float()

    def near(rows: Tensor, columns: Tensor) -> Tensor:
        return (normals[rows] @ rays_2[columns].mT).abs_() < limit

    return near


class LearnedPairs(NamedTuple):
    """All images, some with learned keypoints after those that they had, and verified pairs of the learned ones."""

    views: list[FrameFeatures]
    pairs: list[ViewPair]


def learned_config(config: Config) -> Config | None:
    """The configuration of the mapper with learned features in place of SIFT; None if they are not asked for.

    Raises ConfigError if the weights are not on this machine, or the features are not SIFT with its own matcher.
    """
    if not config.global_mapping.learned_links:
        return None
    if config.features.kind != "sift" or config.matching.matcher != "descriptors":
        raise ConfigError(
            "global_mapping.learned_links requires the default features and matcher, not "
            f"{config.features.kind} and {config.matching.matcher}"
        )
    try:
        weights_file(WEIGHTS)
    except ConfigError as error:
        raise ConfigError(f"global_mapping.learned_links: {error}") from None
    return replace(
        config,
        global_mapping=replace(config.global_mapping, learned_links=False),
        features=replace(config.features, kind="xfeat", weights=WEIGHTS, num_keypoints=NUM_KEYPOINTS),
        matching=replace(config.matching, matcher="lightglue", weights=WEIGHTS),
    )


def open_links(observed: ObservedTracks, found: Reconstruction) -> Links:
    """The links that a map does not hold."""
    few = torch.nonzero(points_across(observed, found) < HELD)[:, 0].tolist()
    return _around(range(len(found.T_cw)), few)


def points_across(observed: ObservedTracks, found: Reconstruction) -> Int[Tensor, " M"]:
    """The number of points that hold together what is before and after each moment between two images.

    A point counts if two images that agree on it, one on either side, are less than `FAR` apart and no image between
    them sees it: loops hold places together, not the moments between.
    """
    track, view = observed.tracks.track[found.agrees], observed.tracks.view[found.agrees]
    before, after = view[:-1], view[1:]
    near = (track[1:] == track[:-1]) & (after - before < FAR)
    begun, ended = (torch.bincount(rows[near], minlength=len(found.T_cw)) for rows in (before, after))
    return (begun - ended).cumsum(0)[:-1]


def with_learned(
    views: Sequence[FrameFeatures], learned: Mapping[int, FrameFeatures], pairs: Sequence[ViewPair]
) -> LearnedPairs:
    """Append learned keypoints that are in pairs to images, after their own.

    views: all images; learned: features of some of them, by row
    """
    matched = {row: torch.zeros_like(view.mask) for row, view in learned.items()}
    for pair in pairs:
        matched[pair.first][pair.keypoints_1] = True
        matched[pair.second][pair.keypoints_2] = True
    begin = {
        row: 1 + int(torch.nonzero(views[row].mask).amax()) if views[row].mask.any() else 0 for row in learned
    }
    place = {row: begin[row] - 1 + chosen.cumsum(0) for row, chosen in matched.items()}
    more = list(views)
    for row, own in learned.items():
        more[row] = _in_rows(views[row], max(len(views[row].mask), begin[row] + int(matched[row].sum())))
        for name in KEYPOINT_COLUMNS:
            column, new = getattr(more[row], name), getattr(own, name)[matched[row]]
            if name == "descriptors":
                new = pad(new, (0, column.shape[1] - new.shape[1]))  # what they lack in width is zero
            column[begin[row] : begin[row] + len(new)] = new
    moved = [
        replace(
            pair,
            keypoints_1=place[pair.first][pair.keypoints_1],
            keypoints_2=place[pair.second][pair.keypoints_2],
        )
        for pair in pairs
    ]
    return LearnedPairs(more, moved)


def _in_rows(view: FrameFeatures, count: int) -> FrameFeatures:
    """A copy of the view with rows that are no keypoints after its own, `count` in all."""
    new = count - len(view.mask)
    columns: dict[str, Any] = {}
    for name in KEYPOINT_COLUMNS:
        column = getattr(view, name)
        rest = (0, 0) * (column.ndim - 1)
        columns[name] = pad(column, (*rest, 0, new), value=float(name in ("scales", "information")))
    return replace(view, **columns)
