"""A check of a map from outside: image pairs, matched and verified by themselves, and triplets of images.

A verified pair determines where each match must lie if the map's relative pose is right: on the part of its epipolar
line in front of both cameras. Two pairs that share an image determine the ratio of their baselines, by the depths of
keypoints of the shared image, each computed by the map's poses from one pair alone: the same depth if the scale of the
map is one. So pairs and triplets contradict a map, or do not. Whether the map ties its parts follows from its own
information (`torchslam.optim.scale_links`): where it does not, the moment is a weak link.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from itertools import pairwise, product
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from torchslam.geometry import Camera, se3_inverse
from torchslam.global_mapping.baselines import (
    MIN_PARALLAX_SIGMAS,
    Array,
    PairDepths,
    ViewRays,
    depth_ratio,
)
from torchslam.global_mapping.view_graph import FAR, THRESHOLD_PX, ViewPair
from torchslam.optim.scale_links import ScaleLinks
from torchslam.types import FrameFeatures

AGREE_PX = 2 * THRESHOLD_PX
"""Median distance of a pair's verified matches from where the map allows them, at the size at which features are found.
Right maps have below 1 px, maps with a loop closed wrongly tens."""
NEAREST = 0.05
"""Depth, as a ratio of the median, from which on matches may lie: the epipolar line ends there."""
MAX_RATIO_STD = 0.04
"""Standard error of the logarithm of a ratio of scales above which a triplet counts as inconclusive."""
MAX_SCALE_ERROR = math.log(1.08)
"""Largest departure of a ratio of scales from one, besides two standard errors. Tried on maps bent by hand, by 10, 20
and 50 %: 20 % is found, and right maps depart by 1 to 3 %."""
MIN_SPANNING = 3
"""Least number of pairs or triplets that decide whether the map fits together at a moment."""
MAX_LINK_STD = 0.02
"""Standard deviation of the logarithm of the scale across a moment, by the map, from which on it is a weak link: four
of them are as much as `MAX_SCALE_ERROR`. Right maps have up to 0.004 but for their first and last keyframes."""
MIN_AGREEING = 0.5
"""Least share of them that agree; single ones may be wrong themselves, by repetitive structure."""

TIED = 0.9
"""Least share of the matches, and of the triplets, between two stretches that must agree so that both are one, as by
loops, or where few told of the break. On a right map of courthouse 98 % and more agree across two breaks, on garden
98 %; where maps were bent by hand by 20 % and more, the halves stay apart."""

PAIR_STD_PX, CHANCE_PX = 1.0, 100.0
"""Standard deviation of the median distance of a pair's matches from where a right map allows them, and the range in
which that of a wrong one lies, in pixels at the size at which features are found. Tried at these values only."""
RATIO_STD, CHANCE_LOG_RATIO = 0.03, 2.0
"""The same of the logarithm of a ratio of scales, besides its own error: right maps depart by 1 to 3 %."""
BY_CHANCE = 0.05
"""Share of pairs and ratios that are wrong themselves. Tried at this value only."""

MIN_SCORE = 0.8
"""Score below which a map counts as wrong even without a break; right ones have 0.98 and more."""


class BreakKind(Enum):
    """How the two sides of a moment do not fit together."""

    POSE = "image pairs contradict the poses"
    SCALE = "the scale differs"
    UNKNOWN = "weak link: the map does not determine the scale"
    LOOP = "images of one place contradict the poses"


@dataclass(frozen=True)
class Break:
    """A moment at which the map does not fit together, or may not.

    Attributes:
        before: last frame before it.
        after: first frame after it.
        kind: what is wrong.
        scale_ratio: scale after to before, as the images have it to the map's; 1 where unknown.
    """

    before: int
    after: int
    kind: BreakKind
    scale_ratio: float = 1.0

    def __str__(self) -> str:
        """The break in words."""
        ratio = f" by {abs(self.scale_ratio - 1):.0%}" if self.kind is BreakKind.SCALE else ""
        return f"between frames {self.before} and {self.after} {self.kind.value}{ratio}"


@dataclass(frozen=True)
class MapCheck:
    """Agreement of image pairs and triplets with a map.

    Attributes:
        images: number of images, those without a pose included.
        pairs: number of verified held-out image pairs, images without a pose included.
        agreeing: number of those that agree with the map.
        triplets: number of triplets that determine a ratio of scales, images without a pose included.
        consistent: number of those that agree with the map.
        used_agreeing: share of all pairs, used or not, that agree.
        distance_px: median distance of the matches of held-out pairs from where the map allows them.
        evidence: of each of these pairs, the logarithm of how much better than chance the map predicts its matches and
            the ratios of scales that it is part of; 0 where it does not.
        breaks: moments at which the map does not fit together, or may not, in the order of time.
        certain: frames of the images in the largest part that nothing contradicts, ascending.
        uncertain: frames of the other images that have a pose.
    """

    images: int
    pairs: int
    agreeing: int
    triplets: int
    consistent: int
    used_agreeing: float
    distance_px: float
    evidence: Float[Tensor, " U"]
    breaks: tuple[Break, ...]
    certain: tuple[int, ...]
    uncertain: tuple[int, ...]

    @property
    def score(self) -> float:
        """Share of pairs and triplets that agree, times that of the images in the largest part without a break.

        Images without a pose count as contradictions.
        """
        scales = self.consistent / self.triplets if self.triplets else 1.0
        return self.used_agreeing * scales * len(self.certain) / max(self.images, 1)

    @property
    def is_right(self) -> bool:
        """Whether nothing contradicts the map."""
        return not self.breaks and self.score > MIN_SCORE

    @property
    def weak_links(self) -> int:
        """Number of moments across which the map does not determine the scale."""
        return sum(each.kind is BreakKind.UNKNOWN for each in self.breaks)

    def doubting(self, frames: Collection[int]) -> MapCheck:
        """The same check with these frames among those that are not certain."""
        doubted = set(self.certain) & set(frames)
        certain = tuple(frame for frame in self.certain if frame not in doubted)
        return replace(self, certain=certain, uncertain=tuple(sorted([*self.uncertain, *doubted])))

    def sentence(self) -> str:
        """The check in a sentence."""
        if not self.pairs:
            return "no held-out image pairs"
        words = f"{self.agreeing / self.pairs:.0%} of {self.pairs} held-out image pairs agree"
        if self.triplets:
            words += f", and {self.consistent / self.triplets:.0%} of {self.triplets} ratios of scales"
        if self.breaks:
            words += f"; {'; '.join(str(each) for each in self.breaks[:3])}"
            words += f"; and at {len(self.breaks) - 3} more" if len(self.breaks) > 3 else ""
        return words


@dataclass(frozen=True)
class _Triplets:
    """Pairs that share an image and determine a ratio of scales.

    Attributes:
        images: the first, the shared and the last one.
        pairs: rows of the earlier and of the later pair.
        log_ratio: of scales, later pair to earlier one, with its standard error `std`.
        untold: number of triplets with an image without a pose.
    """

    images: NDArray[np.int64]
    pairs: NDArray[np.int64]
    log_ratio: Array
    std: Array
    untold: int

    @property
    def agrees(self) -> NDArray[np.bool_]:
        """Which of the scales are the same."""
        return np.abs(self.log_ratio) < MAX_SCALE_ERROR + 2 * self.std


def check_map(
    T_cw: Float[Tensor, "K 4 4"],
    known: Bool[Tensor, " K"],
    views: Sequence[FrameFeatures],
    pairs: Sequence[ViewPair],
    camera: Camera,
    held_back: Collection[int] | None = None,
    reduction: float = 1.0,
    links: ScaleLinks | None = None,
) -> MapCheck:
    """Check the poses of images by verified pairs of them.

    Args:
        T_cw: poses of the images, in the order of time.
        known: which of the images have one.
        views: features of the images.
        pairs: verified pairs of the images.
        camera: of all images.
        held_back: rows of the held-out pairs; None: all.
        reduction: factor by which images are reduced before features are found.
        links: how well the map ties the scale across its moments; None: weak links are not sought.
    """
    posed = known.tolist()
    T_cw = T_cw.to(camera.params)
    rays = ViewRays(camera, views)
    ends = torch.tensor(
        [(pair.first, pair.second) for pair in pairs], dtype=torch.int64, device=T_cw.device
    ).view(-1, 2)
    T_21 = T_cw[ends[:, 1]] @ se3_inverse(T_cw)[ends[:, 0]]
    depths = {
        row: PairDepths.of(T_21[row], rays, pair)
        for row, pair in enumerate(pairs)
        if posed[pair.first] and posed[pair.second]
    }
    depth = _median_depth(depths.values())
    limit = AGREE_PX * reduction
    distances = [
        _distance_px(T_21[row], rays, pair, 1 / (NEAREST * depth)) if row in depths else math.inf
        for row, pair in enumerate(pairs)
    ]
    agrees = [distance < limit for distance in distances]
    unused = range(len(pairs)) if held_back is None else sorted(held_back)
    triplets = _triplets(depths, pairs, posed, agrees)
    breaks, parts = _breaks(posed, pairs, agrees, triplets, views, links)
    evidence = _evidence(np.array(distances) / reduction, triplets)
    largest = max(parts, key=len, default=[])
    others = [row for part in parts if part is not largest for row in part]
    return MapCheck(
        len(views),
        len(unused),
        sum(agrees[row] for row in unused),
        len(triplets.std) + triplets.untold,
        int(triplets.agrees.sum()),
        sum(agrees) / len(agrees) if agrees else 0.0,
        float(np.median([distances[row] for row in unused])) if len(unused) else 0.0,
        torch.from_numpy(evidence[list(unused)]),
        breaks,
        tuple(views[row].index for row in largest),
        tuple(views[row].index for row in others),
    )


def _distance_px(T_21: Tensor, rays: ViewRays, pair: ViewPair, most: float) -> float:
    """Median distance of matches from the epipolar line, from inverse depth 0 to `most`, in pixels."""
    x_1, x_2 = rays.of(pair)
    x_1 = x_1 @ T_21[:3, :3].mT
    across, along = torch.linalg.cross(x_2, T_21[:3, 3].expand_as(x_2)), torch.linalg.cross(x_2, x_1)
    inverse = (-(along * across).sum(-1) / across.square().sum(-1).clamp(min=1e-30)).clamp(0.0, most)
    seen = x_1 + inverse[:, None] * T_21[:3, 3]
    angles = torch.atan2(torch.linalg.cross(x_2, seen).norm(dim=-1), (x_2 * seen).sum(-1))
    return float(angles.median()) * rays.focal


def _median_depth(depths: Collection[PairDepths]) -> float:
    """The median depth of points with parallax, by all pairs; 1 without any."""
    told = [1 / each.inverse[0][each.inverse[0] > MIN_PARALLAX_SIGMAS * each.sigma[0]] for each in depths]
    whole = np.concatenate(told) if told else np.zeros(0)
    return float(np.median(whole)) if len(whole) else 1.0


def _triplets(
    depths: dict[int, PairDepths], pairs: Sequence[ViewPair], posed: Sequence[bool], agrees: Sequence[bool]
) -> _Triplets:
    """The triplets of agreeing pairs that determine a ratio: depths by wrong relative poses are meaningless."""
    before: dict[int, list[int]] = {}
    after: dict[int, list[int]] = {}
    for row, pair in enumerate(pairs):
        after.setdefault(pair.first, []).append(row)
        before.setdefault(pair.second, []).append(row)
    images, rows, ratios, untold = [], [], [], 0
    for middle in sorted(before.keys() & after.keys()):
        for one, other in product(before[middle], after[middle]):
            if one not in depths or other not in depths:
                untold += not (posed[pairs[one].first] and posed[middle] and posed[pairs[other].second])
                continue
            ratio = depth_ratio(depths[one], 1, depths[other], 0) if agrees[one] and agrees[other] else None
            if ratio is not None and ratio.std < MAX_RATIO_STD:
                images.append((pairs[one].first, middle, pairs[other].second))
                rows.append((one, other))
                ratios.append(ratio)
    log_ratio, std = np.array(ratios, dtype=np.float64).reshape(-1, 2).T
    spans = np.array(images, dtype=np.int64).reshape(-1, 3)
    return _Triplets(spans, np.array(rows, dtype=np.int64).reshape(-1, 2), log_ratio, std, untold)


def _evidence(distances_px: Array, triplets: _Triplets) -> Array:
    """For each pair, how much better than chance a map predicts it: logarithms of likelihood ratios, 0 at least.

    distances_px: median distances of the matches of pairs from where the map allows them; infinite without a pose
    """
    found = _likelihood_ratio(distances_px, PAIR_STD_PX, CHANCE_PX)
    ratios = _likelihood_ratio(triplets.log_ratio, np.hypot(RATIO_STD, triplets.std), CHANCE_LOG_RATIO)
    counts = np.bincount(triplets.pairs.ravel(), minlength=len(found))
    sums = np.bincount(triplets.pairs.ravel(), ratios.repeat(2), minlength=len(found))
    return found + sums / np.maximum(counts, 1)


def _likelihood_ratio(errors: Array, std: float | Array, chance: float) -> Array:
    """Logarithm of the likelihood of normal errors among some by chance, to that of errors by chance alone.

    chance: width of the range in which errors by chance are equally probable
    """
    normal = np.exp(-0.5 * np.square(errors / std)) / (math.sqrt(2 * math.pi) * std)
    return np.log1p(normal * chance * (1 - BY_CHANCE) / BY_CHANCE)


def _breaks(
    posed: Sequence[bool],
    pairs: Sequence[ViewPair],
    agrees: Sequence[bool],
    triplets: _Triplets,
    views: Sequence[FrameFeatures],
    links: ScaleLinks | None,
) -> tuple[tuple[Break, ...], list[list[int]]]:
    """The moments at which pairs or triplets disagree, and the posed images in the parts between them."""
    rows = [row for row, known in enumerate(posed) if known]
    told = [row for row, pair in enumerate(pairs) if posed[pair.first] and posed[pair.second]]
    ends = np.array([(pairs[row].first, pairs[row].second) for row in told], dtype=np.int64).reshape(-1, 2)
    good = np.array([agrees[row] for row in told], dtype=bool)
    sizes = np.array([len(pairs[row]) for row in told])
    near = ends[:, 1] - ends[:, 0] < FAR
    spans, right = triplets.images, triplets.agrees

    def disagree(chosen: NDArray[np.bool_], agreeing: NDArray[np.bool_]) -> bool:
        return bool(np.count_nonzero(chosen) >= MIN_SPANNING and agreeing[chosen].mean() < MIN_AGREEING)

    apart: list[Break] = []
    stretch_of = np.zeros(len(posed), dtype=np.int64)
    for before, after in pairwise(rows):
        crossing = near & (ends[:, 0] <= before) & (ends[:, 1] >= after)
        around = spans[:, 1] == before
        if np.count_nonzero(around) < MIN_SPANNING:
            around = (spans[:, 0] <= before) & (spans[:, 2] >= after)
        kind, ratio = None, 1.0
        if disagree(crossing, good):
            kind = BreakKind.POSE
        elif links is not None and links.weakest(views[before].index, views[after].index) > MAX_LINK_STD:
            kind = BreakKind.UNKNOWN
        elif disagree(around, right):
            kind, ratio = BreakKind.SCALE, math.exp(float(np.median(triplets.log_ratio[around])))
        if kind is not None:
            apart.append(Break(views[before].index, views[after].index, kind, ratio))
        stretch_of[after] = len(apart)
    label = _tied(stretch_of, len(apart) + 1, ends, good * sizes, sizes, triplets)
    breaks = [found for number, found in enumerate(apart) if label[number] != label[number + 1]]
    if disagree(~near, good):
        first, last = ends[~near & ~good][0].tolist()
        breaks.append(Break(views[first].index, views[last].index, BreakKind.LOOP))
    parts: dict[int, list[int]] = {}
    for row in rows:
        parts.setdefault(int(label[stretch_of[row]]), []).append(row)
    return tuple(sorted(breaks, key=lambda each: each.before)), list(parts.values())


def _tied(
    stretch_of: NDArray[np.int64],
    count: int,
    ends: NDArray[np.int64],
    agreeing: NDArray[np.int64],
    matches: NDArray[np.int64],
    triplets: _Triplets,
) -> NDArray[np.int64]:
    """The part that each stretch belongs to: two are one where nearly all pairs and triplets between them agree.

    The two parts that the most right triplets tie are joined first; then all is counted anew.

    Args:
        stretch_of: stretch of each image, of `count` ones.
        ends: images of pairs, both in some stretch, with the numbers of their `matches` and of those `agreeing`.
        triplets: of which each tells of both of its pairs.
    """

    def between(images: NDArray[np.int64], values: NDArray[Any]) -> Array:
        """(count, count) sums over pairs of images between two stretches."""
        one, other = stretch_of[images].T
        cells = one * count + other
        sums = np.bincount(cells, values, count * count).reshape(count, count)
        return np.asarray(sums + sums.T, dtype=np.float64)

    sides = np.concatenate([triplets.images[:, :2], triplets.images[:, 1:]])
    right = np.tile(triplets.agrees, 2)
    sums = np.stack(
        [between(ends, agreeing), between(sides, right), between(ends, matches), between(sides, right | True)]
    )
    label = np.arange(count)
    while True:
        shares = np.divide(sums[:2], sums[2:], out=np.zeros((2, count, count)), where=sums[2:] > 0)
        able = np.triu((shares >= TIED).all(axis=0) & (sums[1] >= MIN_SPANNING), 1)
        if not able.any():
            return label
        one, other = np.unravel_index(np.where(able, sums[1], -1.0).argmax(), able.shape)
        label[label == other] = one
        sums[:, one] += sums[:, other]
        sums[:, :, one] += sums[:, :, other]
        sums[:, other] = sums[:, :, other] = 0
