"""Matches of pairs as tracks, and tracks as the points of a map."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchslam.geometry import Camera, triangulate_many
from torchslam.map.map import Map
from torchslam.refine.pairs import Pair
from torchslam.types import FrameFeatures

VIEWS = 8  # of a track that its point is triangulated from, spread over it
_AT_ONCE = 4096  # tracks


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
    for part in torch.arange(len(length), device=length.device).split(_AT_ONCE):
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
