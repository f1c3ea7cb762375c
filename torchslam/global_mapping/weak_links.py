"""Weak links of a view graph: moments across which few matches hold the images together, matched again by poses.

Where few tracks cross, each side may be exact and the scale between them off. By approximate poses a match may lie near
its epipolar line only, so that fewer descriptors compete and the ratio test may be laxer.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.features import match
from torchslam.geometry import Camera, se3_inverse
from torchslam.global_mapping.view_graph import FAR, MIN_MATCHES, THRESHOLD_PX, PairMatcher, ViewPair
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

_ROWS_AT_ONCE = 256
"""Keypoints whose distances from lines are computed at once: they stay in the cache, 3 MB. Tried 128 to 1024."""


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
    found = []
    for one, other in pairs_across(weak_links(pairs)):
        T_21 = T_cw[other] @ se3_inverse(T_cw[one])
        matches = match_guided(matcher, one, other, T_21, camera)
        if len(matches.first) >= MIN_MATCHES:
            found.append((one, other, matches.first, matches.second))
    for pair in matcher.verify(found):
        ends = pair.first, pair.second
        if ends not in best or len(pair) > len(best[ends]):
            best[ends] = pair
    return [best[ends] for ends in sorted(best)]


def weak_links(pairs: Sequence[ViewPair]) -> list[tuple[list[int], list[int]]]:
    """The weak links between images that pairs connect: the images nearest before it, ascending, and after it."""
    rows = sorted({row for pair in pairs for row in (pair.first, pair.second)})
    ends = np.array([(pair.first, pair.second) for pair in pairs]).reshape(-1, 2)
    sizes = np.array([len(pair) for pair in pairs])
    near = ends[:, 1] - ends[:, 0] < FAR
    most = np.array(
        [sizes[near & (ends[:, 0] <= row) & (ends[:, 1] > row)].max(initial=0) for row in rows[:-1]]
    )
    if len(most) == 0:
        return []
    weak = np.flatnonzero(most < WEAK * np.median(most)).tolist()
    return [(rows[max(at + 1 - ACROSS, 0) : at + 1], rows[at + 1 : at + 1 + ACROSS]) for at in weak]


def pairs_across(links: Sequence[tuple[list[int], list[int]]]) -> list[tuple[int, int]]:
    """The pairs of images on both sides of weak links that are matched again, ascending."""
    return sorted(
        {
            (one, other)
            for before, after in links
            for one, other in product(before, after)
            if other - one <= ACROSS
        }
    )


def match_guided(
    matcher: PairMatcher, one: int, other: int, T_21: Float[Tensor, "4 4"], camera: Camera
) -> MatchIndices:
    """Match two images of which the relative pose is known approximately.

    Matchers that are not torchslam's own receive the pose as a prior.
    """
    view_1, view_2 = matcher.views[one], matcher.views[other]
    limit_px = EPIPOLAR_PX * matcher.threshold_px / THRESHOLD_PX
    own = matcher.matcher
    if not isinstance(own, DescriptorMatcher) or not view_1.descriptors.is_floating_point():
        prior = MatchPrior(T_21=T_21, camera=camera, epipolar_px=limit_px)
        return run_matcher(own, view_1, view_2, prior)
    found = match(
        view_1.features,
        view_2.features,
        ratio=GUIDED_RATIO * own.settings.max_ratio,
        max_distance=own.settings.max_cosine_distance,
        allowed=near_epipolar_line(view_1, view_2, T_21, camera, limit_px)[None],
    )
    mask = found.mask[0]
    return MatchIndices(found.indices_1[0, mask], found.indices_2[0, mask])


def near_epipolar_line(
    view_1: FrameFeatures, view_2: FrameFeatures, T_21: Float[Tensor, "4 4"], camera: Camera, limit_px: float
) -> Tensor:
    """(N1, N2) which keypoints of the second view are near the epipolar line of each of the first.

    In single precision, and with the same memory for the products of all parts: writing them to new pages takes most of
    the time. The limit is wide.
    """
    rays = camera.unproject(view_1.keypoints) @ T_21[:3, :3].mT
    normals = torch.nn.functional.normalize(torch.linalg.cross(T_21[:3, 3].expand_as(rays), rays), dim=-1)
    normals, rays_2 = normals.float(), camera.unproject(view_2.keypoints).float().mT
    limit = limit_px / float(camera.focal)
    near = torch.empty(len(normals), rays_2.shape[1], dtype=torch.bool, device=normals.device)
    room = normals.new_empty(_ROWS_AT_ONCE, rays_2.shape[1])
    for part, of_part in zip(normals.split(_ROWS_AT_ONCE), near.split(_ROWS_AT_ONCE), strict=True):
        sines = torch.matmul(part, rays_2, out=room[: len(part)])
        torch.lt(sines.abs_(), limit, out=of_part)
    return near
