"""Keyframes, verified pairs of keyframes, and the tracks that the matches of all pairs form.

The given poses may be degrees off. They only rule out pairs of views that look in different directions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchslam.config import Config
from torchslam.geometry import Camera, estimate_relative_pose, se3_inverse, so3_log, triangulate_many
from torchslam.loop_closing.keyframe_database import KeyframeDatabase
from torchslam.map.map import Map
from torchslam.tracking.data_association import match_views
from torchslam.types import FrameFeatures

# A view becomes a keyframe if its matches with the last one moved by this fraction of the image width, or if fewer than
# this fraction of the matches of the first view after it are left.
MIN_MOTION, MIN_MATCH_RATIO = 0.08, 0.6
NUM_RECENT = 4  # previous keyframes that each is matched with
NUM_SIMILAR = 8  # most similar other keyframes that each is matched with
MAX_TURN_DEG = 60.0  # between similar views, by their given poses
MAX_DISAGREEMENT_DEG = 15.0  # of a relative rotation with the given poses: larger for lookalike places
THRESHOLD_PX = 2.0  # at full size: about the noise plus the effect of a focal length that is 5 % off
MIN_MATCHES = 20
_PAIRS_AT_ONCE, _MAX_SAMPLES = 16, 500


@dataclass(frozen=True)
class Pair:
    """Two overlapping keyframes.

    Attributes:
        first: Row of a view.
        second: Row of another one.
        keypoints_1: Keypoints of the first view.
        keypoints_2: Matching keypoints of the second view.
        R_21: Relative rotation by the matches; None if it is ambiguous.
    """

    first: int
    second: int
    keypoints_1: Int[Tensor, " M"]
    keypoints_2: Int[Tensor, " M"]
    R_21: Float[Tensor, "3 3"] | None


def choose_keyframes(views: list[FrameFeatures], width: int, config: Config) -> list[int]:
    """Select the rows of views with enough motion between them, by the images alone."""
    chosen, first_matches = [0], 0
    for row in range(1, len(views)):
        last = views[chosen[-1]]
        at_1, at_2 = match_views(last, views[row], config.matching)
        first_matches = max(first_matches, len(at_1))
        motion = torch.linalg.vector_norm(last.keypoints[at_1] - views[row].keypoints[at_2], dim=-1)
        is_far = len(at_1) < MIN_MATCH_RATIO * first_matches or float(motion.median()) > MIN_MOTION * width
        if is_far or len(at_1) < MIN_MATCHES:
            chosen.append(row)
            first_matches = 0
    return chosen


def find_pairs(
    views: list[FrameFeatures], T_cw: Float[Tensor, "K 4 4"], camera: Camera, config: Config
) -> list[Pair]:
    """Match keyframes with given poses and verify the pairs by their epipolar geometry."""
    found = [
        (one, other, *match_views(views[one], views[other], config.matching))
        for one, other in candidates(views, T_cw)
    ]
    found = [pair for pair in found if len(pair[2]) >= MIN_MATCHES]
    pairs: list[Pair] = []
    for start in range(0, len(found), _PAIRS_AT_ONCE):
        pairs += _verified(found[start : start + _PAIRS_AT_ONCE], views, T_cw, camera, config)
    return pairs


def candidates(views: list[FrameFeatures], T_cw: Float[Tensor, "K 4 4"]) -> list[tuple[int, int]]:
    """Return pairs (lower row first, ascending) close in time, or similar and with similar viewing directions."""
    places = KeyframeDatabase()
    for row, view in enumerate(views):
        places.add(row, view.descriptors, view.mask)
    axes_w = T_cw[:, 2, :3]  # viewing directions
    near = axes_w @ axes_w.mT > math.cos(math.radians(MAX_TURN_DEG))
    pairs = set()
    for row, view in enumerate(views):
        pairs |= {(other, row) for other in range(max(0, row - NUM_RECENT), row)}
        keys, scores = places.query(view.descriptors, view.mask)
        alike = keys[scores > 0]
        alike = alike[near[row, alike] & ((alike - row).abs() > NUM_RECENT)][:NUM_SIMILAR]
        pairs |= {(min(row, other), max(row, other)) for other in alike.tolist()}
    return sorted(pairs)


def _verified(
    found: list[tuple[int, int, Tensor, Tensor]],
    views: list[FrameFeatures],
    T_cw: Tensor,
    camera: Camera,
    config: Config,
) -> list[Pair]:
    """The pairs whose matches agree on a relative pose that is compatible with the given ones."""
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
        if R_21 is None or float(so3_log(R_21 @ given.mT).norm()) < math.radians(MAX_DISAGREEMENT_DEG):
            pairs.append(Pair(one, other, at_1[inliers], at_2[inliers], R_21))
    return pairs


MAX_VIEWS = 8  # for the triangulation of a track, spread over it
_TRACKS_AT_ONCE = 4096  # tracks


@dataclass(frozen=True)
class Tracks:
    """Observations of points, ordered by track, then keyframe; a keyframe observes a track at most once.

    Attributes:
        track: Number of the track of each observation, from 0 without gaps.
        keyframe: Row of the keyframe.
        keypoint: Row among its keypoints.
    """

    track: Int[Tensor, " O"]
    keyframe: Int[Tensor, " O"]
    keypoint: Int[Tensor, " O"]

    @property
    def count(self) -> int:
        """The number of tracks."""
        return int(self.track[-1]) + 1 if len(self.track) else 0

    def select(self, keep: Bool[Tensor, " O"]) -> Tracks:
        """Select the observations of a mask, without tracks that have fewer than two of them."""
        track, keyframe, keypoint = self.track[keep], self.keyframe[keep], self.keypoint[keep]
        _, which, counts = torch.unique(track, return_inverse=True, return_counts=True)
        is_track = counts[which] >= 2
        _, renumbered = torch.unique(track[is_track], return_inverse=True)
        return Tracks(renumbered, keyframe[is_track], keypoint[is_track])


def join_matches(pairs: list[Pair], keyframes: int, keypoints: int) -> Tracks:
    """Join matches to tracks, their connected components, without observations by two keypoints of one keyframe.

    Args:
        pairs: Of keyframes, with matches.
        keyframes: Number of keyframes.
        keypoints: Number of keypoints of a keyframe.
    """
    one = torch.cat([pair.first * keypoints + pair.keypoints_1 for pair in pairs])
    other = torch.cat([pair.second * keypoints + pair.keypoints_2 for pair in pairs])
    label = _lowest_connected(one, other, keyframes * keypoints)
    nodes = torch.unique(torch.cat([one, other]))
    order = torch.argsort(label[nodes], stable=True)  # within a track by keyframe
    nodes = nodes[order]
    track, keyframe = label[nodes], nodes // keypoints
    _, which, counts = torch.unique(track * keyframes + keyframe, return_inverse=True, return_counts=True)
    return Tracks(track, keyframe, nodes % keypoints).select(counts[which] == 1)


def _lowest_connected(one: Int[Tensor, " M"], other: Int[Tensor, " M"], count: int) -> Int[Tensor, " R"]:
    """The lowest node of the connected component of each of `count` nodes with the given edges."""
    label = torch.arange(count, device=one.device)
    while True:
        lower = torch.minimum(label[one], label[other])
        new = label.scatter_reduce(0, torch.cat([one, other]), torch.cat([lower, lower]), "amin")
        new = torch.minimum(new, new[new])
        if torch.equal(new, label):
            return label
        label = new


def triangulate_tracks(
    tracks: Tracks,
    pixels: Float[Tensor, "O 2"],
    T_cw: Float[Tensor, "K 4 4"],
    camera: Camera,
    min_parallax_deg: float,
) -> tuple[Float[Tensor, "N 3"], Bool[Tensor, " N"]]:
    """Triangulate the points of tracks.

    Args:
        tracks: N of them.
        pixels: Of the observations.
        T_cw: Poses of the keyframes.
        camera: Of all keyframes.
        min_parallax_deg: Least angle between two rays.

    Returns:
        The points, and whether they are in front of their keyframes with enough parallax.
    """
    length = torch.bincount(tracks.track)
    start = length.cumsum(0) - length
    slot = torch.arange(MAX_VIEWS, device=length.device)
    used = length.clamp(max=MAX_VIEWS)[:, None]
    mask = slot < used
    # Evenly over the track, including its ends.
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


def make_map(
    views: list[FrameFeatures],
    T_cw: Float[Tensor, "K 4 4"],
    tracks: Tracks,
    points_w: Float[Tensor, "N 3"],
) -> Map:
    """Create a map of keyframes with the points of their tracks."""
    made = Map()
    for view, T in zip(views, T_cw, strict=True):
        made.add_keyframe(view, T)
    first = torch.searchsorted(tracks.track, torch.arange(tracks.count, device=points_w.device))
    first_keyframe = tracks.keyframe[first]
    ids = torch.full_like(first_keyframe, -1)
    for keyframe, view in enumerate(views):
        own = torch.nonzero(first_keyframe == keyframe)[:, 0]
        descriptors = view.descriptors[tracks.keypoint[first[own]]]
        ids[own] = made.add_points(points_w[own], descriptors, keyframe)
    for keyframe in range(len(views)):
        own = torch.nonzero(tracks.keyframe == keyframe)[:, 0]
        made.add_observations(keyframe, tracks.keypoint[own], ids[tracks.track[own]])
    made.update_appearance(torch.arange(len(views), device=points_w.device))
    return made
