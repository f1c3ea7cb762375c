"""Keyframes, verified pairs of keyframes, and the tracks that the matches of all pairs form.

The given poses may be degrees off. They only rule out pairs of views that look in different directions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchslam.config import Config
from torchslam.geometry import Camera, estimate_relative_pose, se3_inverse, so3_log, triangulate_many
from torchslam.loop_closing.keyframe_database import KeyframeDatabase
from torchslam.map.map import Map
from torchslam.tracking.correspondences import match_views
from torchslam.types import FrameFeatures

# A view becomes a keyframe where its matches with the last one moved by this share of the image's width, or where
# this share of the matches is lost that the first view after it had.
MOTION, KEPT = 0.08, 0.6
IN_TIME = 4  # keyframes before it that each is compared with
ALIKE = 8  # others that look most like it
MAX_TURN_DEG = 60.0  # between views that look alike, by their given poses
# What a relative rotation may be off from the given poses': a place that only looks alike is seldom seen so alike.
MAX_OFF_DEG = 15.0
THRESHOLD_PX = (
    2.0  # of an image that is not reduced: about the noise, and what a focal length that is 5 % off bends
)
MIN_MATCHES = 20
_PAIRS_AT_ONCE, _MAX_SAMPLES = 16, 500


@dataclass(frozen=True)
class Pair:
    """Two keyframes that see the same: rows of their views, and matching keypoints (m,), (m,).

    R_21: (3, 3) relative rotation by the matches; None where these leave two motions
    """

    first: int
    second: int
    keypoints_1: Tensor
    keypoints_2: Tensor
    R_21: Tensor | None


def choose_keyframes(views: list[FrameFeatures], width: int, config: Config) -> list[int]:
    """Rows of the views that are apart enough, in their order: told by the images alone."""
    chosen, first_matches = [0], 0
    for row in range(1, len(views)):
        last = views[chosen[-1]]
        at_1, at_2 = match_views(last, views[row], config.matching)
        first_matches = max(first_matches, len(at_1))
        motion = torch.linalg.vector_norm(last.keypoints[at_1] - views[row].keypoints[at_2], dim=-1)
        is_far = len(at_1) < KEPT * first_matches or float(motion.median()) > MOTION * width
        if is_far or len(at_1) < MIN_MATCHES:
            chosen.append(row)
            first_matches = 0
    return chosen


def find_pairs(views: list[FrameFeatures], T_cw: Tensor, camera: Camera, config: Config) -> list[Pair]:
    """The pairs of keyframes that see the same things.

    T_cw: (K, 4, 4) of the views, as given
    """
    found = [
        (one, other, *match_views(views[one], views[other], config.matching))
        for one, other in candidates(views, T_cw)
    ]
    found = [pair for pair in found if len(pair[2]) >= MIN_MATCHES]
    pairs: list[Pair] = []
    for start in range(0, len(found), _PAIRS_AT_ONCE):
        pairs += _verified(found[start : start + _PAIRS_AT_ONCE], views, T_cw, camera, config)
    return pairs


def candidates(views: list[FrameFeatures], T_cw: Tensor) -> list[tuple[int, int]]:
    """Pairs (lower row first, ascending) near in time, or alike and turned to the same side by the given poses."""
    places = KeyframeDatabase()
    for row, view in enumerate(views):
        places.add(row, view.descriptors, view.mask)
    axes_w = T_cw[:, 2, :3]  # viewing directions
    near = axes_w @ axes_w.mT > math.cos(math.radians(MAX_TURN_DEG))
    pairs = set()
    for row, view in enumerate(views):
        pairs |= {(other, row) for other in range(max(0, row - IN_TIME), row)}
        keys, scores = places.query(view.descriptors, view.mask)
        alike = keys[scores > 0]
        alike = alike[near[row, alike] & ((alike - row).abs() > IN_TIME)][:ALIKE]
        pairs |= {(min(row, other), max(row, other)) for other in alike.tolist()}
    return sorted(pairs)


def _verified(
    found: list[tuple[int, int, Tensor, Tensor]],
    views: list[FrameFeatures],
    T_cw: Tensor,
    camera: Camera,
    config: Config,
) -> list[Pair]:
    """Those of several pairs whose matches have a relative pose in common that the given ones do not rule out."""
    size = max(len(at_1) for _, _, at_1, _ in found)
    pixels = T_cw.new_zeros(2, len(found), size, 2)
    mask = torch.zeros(len(found), size, dtype=torch.bool, device=T_cw.device)
    for row, (one, other, at_1, at_2) in enumerate(found):
        mask[row, : len(at_1)] = True
        pixels[0, row, : len(at_1)] = views[one].keypoints[at_1]
        pixels[1, row, : len(at_1)] = views[other].keypoints[at_2]
    relative = estimate_relative_pose(
        pixels[0],
        pixels[1],
        camera,
        camera,
        threshold=THRESHOLD_PX * config.features.reduction(camera.size),
        mask=mask,
        seed=config.seed,
        max_samples=_MAX_SAMPLES,
        kernel="truncated",
        min_samples=64,
    )
    pairs = []
    for row, (one, other, at_1, at_2) in enumerate(found):
        inliers = relative.inliers[row, : len(at_1)]
        if int(inliers.sum()) < MIN_MATCHES:
            continue
        is_known = bool(relative.success[row]) or relative.model[row] == "rotation"
        R_21 = relative.T_21[row, :3, :3] if is_known else None
        given = (T_cw[other] @ se3_inverse(T_cw[one]))[:3, :3]
        if R_21 is None or float(so3_log(R_21 @ given.mT).norm()) < math.radians(MAX_OFF_DEG):
            pairs.append(Pair(one, other, at_1[inliers], at_2[inliers], R_21))
    return pairs


VIEWS = 8  # of a track that its point is triangulated from, spread over it
_TRACKS_AT_ONCE = 4096  # tracks


@dataclass(frozen=True)
class Tracks:
    """Which keypoints are one point: O rows, ordered by track, then keyframe; a keyframe sees a track once.

    track: (O,) from 0 on, without gaps; keyframe, keypoint: (O,)
    """

    track: Tensor
    keyframe: Tensor
    keypoint: Tensor

    @property
    def count(self) -> int:
        return int(self.track[-1]) + 1 if len(self.track) else 0

    def of(self, keep: Tensor) -> Tracks:
        """The rows of a mask (O,), of tracks that are left with two or more of them."""
        track, keyframe, keypoint = self.track[keep], self.keyframe[keep], self.keypoint[keep]
        _, which, counts = torch.unique(track, return_inverse=True, return_counts=True)
        lives = counts[which] >= 2
        _, renamed = torch.unique(track[lives], return_inverse=True)
        return Tracks(renamed, keyframe[lives], keypoint[lives])


def join_matches(pairs: list[Pair], keyframes: int, keypoints: int) -> Tracks:
    """The connected parts of all matches; what two keypoints of a keyframe contradict is left out of them.

    keypoints: how many a keyframe has room for
    """
    one = torch.cat([pair.first * keypoints + pair.keypoints_1 for pair in pairs])
    other = torch.cat([pair.second * keypoints + pair.keypoints_2 for pair in pairs])
    label = _lowest_connected(one, other, keyframes * keypoints)
    nodes = torch.unique(torch.cat([one, other]))
    order = torch.argsort(label[nodes], stable=True)  # within a track by keyframe
    nodes = nodes[order]
    track, keyframe = label[nodes], nodes // keypoints
    _, which, counts = torch.unique(track * keyframes + keyframe, return_inverse=True, return_counts=True)
    return Tracks(track, keyframe, nodes % keypoints).of(counts[which] == 1)


def _lowest_connected(one: Tensor, other: Tensor, count: int) -> Tensor:
    """(count,) the lowest node that edges (E,), (E,) connect each node with."""
    label = torch.arange(count, device=one.device)
    while True:
        lower = torch.minimum(label[one], label[other])
        new = label.scatter_reduce(0, torch.cat([one, other]), torch.cat([lower, lower]), "amin")
        new = torch.minimum(new, new[new])
        if torch.equal(new, label):
            return label
        label = new


def triangulate_tracks(
    tracks: Tracks, pixels: Tensor, T_cw: Tensor, camera: Camera, min_parallax_deg: float
) -> tuple[Tensor, Tensor]:
    """(T, 3) points of the tracks and (T,) whether they are in front of their keyframes, with enough parallax.

    pixels: (O, 2); T_cw: (K, 4, 4)
    """
    length = torch.bincount(tracks.track)
    start = length.cumsum(0) - length
    slot = torch.arange(VIEWS, device=length.device)
    used = length.clamp(max=VIEWS)[:, None]
    mask = slot < used
    # Evenly over the track, its ends included.
    step = (length[:, None] - 1).double() / (used - 1).clamp(min=1).double()
    rows = start[:, None] + torch.where(mask, (slot * step).round().long(), 0)
    points, good = [], []
    for part in torch.arange(len(length), device=length.device).split(_TRACKS_AT_ONCE):
        seen = rows[part]
        found = triangulate_many(
            T_cw[tracks.keyframe[seen]], pixels[seen][:, None], camera, mask[part][:, None]
        )
        points.append(found.points_w[:, 0])
        good.append(found.mask[:, 0] & (found.angles[:, 0] > math.radians(min_parallax_deg)))
    return torch.cat(points), torch.cat(good)


def make_map(views: list[FrameFeatures], T_cw: Tensor, tracks: Tracks, points_w: Tensor) -> Map:
    """A map of keyframes at T_cw (K, 4, 4) and points (T, 3) that they see as the tracks say."""
    made = Map()
    for view, T in zip(views, T_cw, strict=True):
        made.add_keyframe(view, T)
    first = torch.searchsorted(tracks.track, torch.arange(tracks.count, device=points_w.device))
    born = tracks.keyframe[first]
    ids = torch.full_like(born, -1)
    for keyframe, view in enumerate(views):
        own = torch.nonzero(born == keyframe)[:, 0]
        descriptors = view.descriptors[tracks.keypoint[first[own]]]
        ids[own] = made.add_points(points_w[own], descriptors, keyframe)
    for keyframe in range(len(views)):
        own = torch.nonzero(tracks.keyframe == keyframe)[:, 0]
        made.observe(keyframe, tracks.keypoint[own], ids[tracks.track[own]])
    made.refresh(torch.arange(len(views), device=points_w.device))
    return made
