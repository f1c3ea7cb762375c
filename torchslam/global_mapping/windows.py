"""Windows of a long recording: parts of its images that are mapped as wholes, and joined by similarities.

Windows overlap, and places are visited again. So the maps of two windows have points in common: those of the same
keypoints of images that are in both, and those of matches between an image of one and an image of the other. Each gives
a similarity between the maps, and the similarities that agree give all maps a common world (Strasdat, Montiel and
Davison, "Scale drift-aware large scale monocular SLAM", 2010, with maps in place of poses).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchslam.geometry import Camera, estimate_similarity, rigid, se3_inverse, so3_log, transform
from torchslam.geometry.lie import sim3_inverse
from torchslam.geometry.transforms import without_scale
from torchslam.global_mapping.rounds import MIN_VIEWS, ObservedTracks, Reconstruction
from torchslam.global_mapping.tracks import held_parts
from torchslam.global_mapping.view_graph import ViewPair
from torchslam.optim.pose_graph import PoseGraph, solve_pose_graph
from torchslam.types import FrameFeatures
from torchslam.utils.indexing import connected_parts

OVERLAP = 0.2
"""Share of a window's images that the next one has as well. Tried at this value only."""
MIN_HOLDING = 25
"""Of the longest tracks, those that must hold an image with its neighbors, so that the map of a window is rigid there.
Tried at this value only."""
MIN_JOINING = 12
"""Points that a pair of images must have in two maps. Tried at 40, with which the loop of office_loop is not found."""
ENOUGH_JOINING = 100
"""Points that determine a similarity as well as `JOINT_STD`; its variance with fewer is larger by their share."""
PAIRS_OF_WINDOWS = 3
"""Pairs of images, those with most points, of which each gives a similarity between two windows; the one that most
points agree with is used. Tried at this value only."""
MAX_ROTATION_ERROR_RAD = 0.1
"""A pair whose rotation differs more from those of its images does not hold. On garden right ones differ by 0.15
degrees in the median and wrong ones by 10 and more; tried 0.05 to 0.2."""
JOINT_STD = 0.01
"""Standard deviation of a similarity between windows of unit extent: radians, and ratios of the scale and the extent.
Those of windows of garden with 50 images differ by .0004 rad, .003 and .005."""


class MappedWindow(NamedTuple):
    """The map of a window.

    Attributes:
        observed: tracks in its images.
        found: poses of these images, camera, points and the observations that agree.
        first: row of its first image among all of the recording.
        kept: images, among all, of the pairs that the map is from, and of those of learned features.
    """

    observed: ObservedTracks
    found: Reconstruction
    first: int
    kept: tuple[frozenset[tuple[int, int]], ...] = ()

    def parts(self) -> list[MappedWindow]:
        """The parts that enough points hold together: where they are few, each side may have a scale of its own."""
        tracks, agrees = self.observed.tracks, self.found.agrees
        part = held_parts(tracks, agrees, len(self.found.T_cw), MIN_HOLDING)
        found = []
        for label in torch.unique(part[tracks.view[agrees]]).tolist():
            own = agrees & (part == label)[tracks.view]
            if len(torch.unique(tracks.view[own])) >= MIN_VIEWS:
                found.append(self._replace(found=replace(self.found, agrees=own)))
        return found


class KnownPoses(NamedTuple):
    """Poses of images by a run frame by frame.

    Attributes:
        T_cw: of all images.
        is_tied: images that have a pose, and that the run and its check do not doubt.
        camera: of the run.
    """

    T_cw: Float[Tensor, "K 4 4"]
    is_tied: Bool[Tensor, " K"]
    camera: Camera

    def of(self, window: range) -> KnownPoses | None:
        """Those of a window that enters as it is; None where an image is doubtful."""
        rows = slice(window.start, window.stop)
        is_tied = self.is_tied[rows]
        return KnownPoses(self.T_cw[rows], is_tied, self.camera) if bool(is_tied.all()) else None


def split(count: int, size: int) -> list[range]:
    """Windows of `size` of `count` images, evenly spread, that overlap by `OVERLAP` or more; one if they are few."""
    if count <= size:
        return [range(count)]
    number = math.ceil((count - size) / max(round((1 - OVERLAP) * size), 1)) + 1
    starts = [round(number_of * (count - size) / (number - 1)) for number_of in range(number)]
    return [range(start, start + size) for start in starts]


def pairs_within(pairs: Sequence[ViewPair], window: range) -> list[ViewPair]:
    """The pairs of images of a window, by their rows in it."""
    return [
        replace(pair, first=pair.first - window.start, second=pair.second - window.start)
        for pair in pairs
        if pair.first in window and pair.second in window
    ]


def rotations_hold(pairs: Sequence[ViewPair], R_cw: Float[Tensor, "K 3 3"]) -> list[bool]:
    """Which pairs have the relative rotations of images."""
    if not pairs:
        return []
    ends = torch.tensor([(pair.first, pair.second) for pair in pairs], dtype=torch.int64, device=R_cw.device)
    R_21 = torch.stack([pair.T_21[:3, :3] for pair in pairs])
    off = so3_log(R_21 @ R_cw[ends[:, 0]] @ R_cw[ends[:, 1]].mT).norm(dim=-1)
    return (off < MAX_ROTATION_ERROR_RAD).tolist()


def pairs_kept(
    pairs: Sequence[ViewPair], windows: Sequence[range], kept: Iterable[frozenset[tuple[int, int]]]
) -> list[ViewPair]:
    """The pairs that the map of some window is from, and those of which no window has both images."""
    held = frozenset[tuple[int, int]]().union(*kept)
    return [
        pair
        for pair in pairs
        if (pair.first, pair.second) in held
        or not any(pair.first in each and pair.second in each for each in windows)
    ]


def pairs_that_hold(
    pairs: Sequence[ViewPair], T_cw: Float[Tensor, "K 4 4"], known: Bool[Tensor, " K"]
) -> list[ViewPair]:
    """The pairs that poses of images agree with; `known`: which images have one."""
    told = [pair for pair in pairs if bool(known[[pair.first, pair.second]].all())]
    return list(compress(told, rotations_hold(told, T_cw[:, :3, :3])))


def join_windows(
    windows: Sequence[MappedWindow], pairs: Sequence[ViewPair], views: Sequence[FrameFeatures]
) -> tuple[Float[Tensor, "K 4 4"], Bool[Tensor, " K"]]:
    """Give the maps of windows a common world.

    Args:
        windows: one or more, in the order of their images.
        pairs: verified ones of all images.
        views: all images.

    Returns:
        Poses of all images, the identity for those without one, and which have one: those of the windows that are tied
        to each other, the largest set of them. An image of two windows has the pose in which it is further inside.
    """
    worlds = [_World.of(part) for window in windows for part in window.parts()]
    edges, S_ba, strengths = _similarities(worlds, pairs, views)
    label = connected_parts(edges, len(worlds))
    posed = torch.tensor([len(world.rows) for world in worlds], device=label.device)
    sizes = torch.zeros_like(posed).index_add(0, label, posed)
    is_held = label == sizes.argmax()
    S_aw = _solved(edges, S_ba, strengths, is_held)
    like = windows[0].found.T_cw
    T_cw = torch.eye(4, dtype=like.dtype, device=like.device).repeat(len(views), 1, 1)
    inside = torch.full((len(views),), -1, device=like.device)
    for world, S, is_joined in zip(worlds, S_aw, is_held.tolist(), strict=True):
        if not is_joined:
            continue
        depth = torch.minimum(world.rows - world.rows[0], world.rows[-1] - world.rows)
        better = depth > inside[world.rows]
        own = world.rows[better]
        T_cw[own] = without_scale(world.T_ca[better] @ S)
        inside[own] = depth[better]
    return T_cw, inside >= 0


@dataclass(frozen=True)
class _World:
    """The map of a window, in a unit in which it has the extent one, and the points of its keypoints.

    Attributes:
        rows: of the images with a pose.
        T_ca: their poses.
        keys: of keypoints that have a point, image times `_KEYS` plus keypoint, ascending.
        points_a: their points; sigmas: their standard deviations, pixels.
    """

    rows: Int[Tensor, " K"]
    T_ca: Float[Tensor, "K 4 4"]
    keys: Int[Tensor, " O"]
    points_a: Float[Tensor, "O 3"]
    sigmas: Float[Tensor, " O"]
    camera: Camera

    @classmethod
    def of(cls, window: MappedWindow) -> _World:
        observed, found = window.observed, window.found
        agrees = found.agrees
        rows = torch.unique(observed.tracks.view[agrees])
        T_ca = found.T_cw[rows]
        centers_a = se3_inverse(T_ca)[:, :3, 3]
        extent = (centers_a - centers_a.mean(0)).norm(dim=-1).square().mean().sqrt()
        unit = extent.where(extent > 0, 1.0)
        T_ca = rigid(T_ca[:, :3, :3], T_ca[:, :3, 3] / unit)
        tracks = observed.tracks
        keys = _keys(tracks.view[agrees] + window.first, tracks.keypoint[agrees])
        order = torch.argsort(keys)
        points_a = found.points_w[tracks.track[agrees]] / unit
        sigmas = observed.noise.sigmas[agrees]
        return cls(rows + window.first, T_ca, keys[order], points_a[order], sigmas[order], found.camera)

    def rows_of(self, keys: Int[Tensor, " M"]) -> tuple[Int[Tensor, " M"], Bool[Tensor, " M"]]:
        """Where keypoints are in this map, and whether they are."""
        at = torch.searchsorted(self.keys, keys).clamp(max=len(self.keys) - 1)
        return at, self.keys[at] == keys

    def pose(self, view: int) -> Float[Tensor, "4 4"]:
        """The pose of an image."""
        return self.T_ca[int(torch.searchsorted(self.rows, view))]


_KEYS = 1 << 20
"""More than there are keypoints in an image."""


def _keys(view: Int[Tensor, " M"] | int, keypoint: Int[Tensor, " M"]) -> Int[Tensor, " M"]:
    return view * _KEYS + keypoint


class _Joint(NamedTuple):
    """An image of one window, one of another, and the rows of common points in either map."""

    view_a: int
    view_b: int
    in_a: Int[Tensor, " M"]
    in_b: Int[Tensor, " M"]


def _similarities(
    worlds: Sequence[_World], pairs: Sequence[ViewPair], views: Sequence[FrameFeatures]
) -> tuple[Int[Tensor, "E 2"], Float[Tensor, "E 4 4"], Float[Tensor, " E"]]:
    """Windows (a, b), the similarities from the first to the second map, and how many points agree with each."""
    edges, found, strengths = [], [], []
    for a, world_a in enumerate(worlds):
        for b in range(a + 1, len(worlds)):
            best = _similarity(world_a, worlds[b], pairs, views)
            if best is not None:
                edges.append((a, b))
                found.append(best[0])
                strengths.append(best[1])
    like = worlds[0].T_ca
    ends = torch.tensor(edges, dtype=torch.int64, device=like.device).view(-1, 2)
    S_ba = torch.stack(found) if found else like.new_zeros(0, 4, 4)
    return ends, S_ba, like.new_tensor(strengths)


def _similarity(
    world_a: _World, world_b: _World, pairs: Sequence[ViewPair], views: Sequence[FrameFeatures]
) -> tuple[Float[Tensor, "4 4"], int] | None:
    """The similarity from one map to another that most points agree with, and their number; None without any."""
    joints = sorted(_joints(world_a, world_b, pairs), key=lambda joint: -len(joint.in_a))[:PAIRS_OF_WINDOWS]
    if not joints:
        return None
    most = len(joints[0].in_a)
    like = world_a.points_a
    points = [like.new_zeros(len(joints), most, 3) for _ in range(2)]
    pixels = [like.new_zeros(len(joints), most, 2) for _ in range(2)]
    sigmas = [like.new_ones(len(joints), most) for _ in range(2)]
    mask = torch.zeros(len(joints), most, dtype=torch.bool, device=like.device)
    for number, joint in enumerate(joints):
        mask[number, : len(joint.in_a)] = True
        for side, (world, view, rows) in enumerate(
            ((world_a, joint.view_a, joint.in_a), (world_b, joint.view_b, joint.in_b))
        ):
            own = slice(len(rows))
            points[side][number, own] = transform(world.pose(view), world.points_a[rows])
            pixels[side][number, own] = views[view].keypoints[world.keys[rows] % _KEYS].to(like.dtype)
            sigmas[side][number, own] = world.sigmas[rows]
    similarity = estimate_similarity(
        *points,
        *pixels,
        camera_1=world_a.camera,
        camera_2=world_b.camera,
        sigmas_1=sigmas[0],
        sigmas_2=sigmas[1],
        mask=mask,
    )
    agree = torch.where(similarity.success, similarity.inliers.sum(-1), 0)
    best = int(agree.argmax())
    if int(agree[best]) < MIN_JOINING:
        return None
    joint = joints[best]
    S_ba = se3_inverse(world_b.pose(joint.view_b)) @ similarity.S_21[best] @ world_a.pose(joint.view_a)
    return S_ba, int(agree[best])


def _joints(world_a: _World, world_b: _World, pairs: Sequence[ViewPair]) -> list[_Joint]:
    """All pairs of images of two windows, an image of both included, with enough points in common."""
    in_a, in_b = set(world_a.rows.tolist()), set(world_b.rows.tolist())
    found = []
    at, known = world_b.rows_of(world_a.keys)
    mine = known.nonzero()[:, 0]
    views = world_a.keys[mine] // _KEYS
    for view in sorted(in_a & in_b):
        own = mine[views == view]
        found.append(_Joint(view, view, own, at[own]))
    for pair in pairs:
        sides = (pair.first, pair.keypoints_1), (pair.second, pair.keypoints_2)
        for (one, own), (other, others) in (sides, sides[::-1]):
            if one in in_a and other in in_b and not (one in in_b or other in in_a):
                at_a, known_a = world_a.rows_of(_keys(one, own))
                at_b, known_b = world_b.rows_of(_keys(other, others))
                both = known_a & known_b
                found.append(_Joint(one, other, at_a[both], at_b[both]))
    return [joint for joint in found if len(joint.in_a) >= MIN_JOINING]


def _solved(
    edges: Int[Tensor, "E 2"],
    S_ba: Float[Tensor, "E 4 4"],
    strengths: Float[Tensor, " E"],
    is_held: Bool[Tensor, " W"],
) -> Float[Tensor, "W 4 4"]:
    """The similarities from the world to the maps of the windows that are held, the first of which is the world.

    They begin along the strongest similarities that tie all of them.
    """
    eye = torch.eye(4, dtype=S_ba.dtype, device=S_ba.device)
    S_aw = eye.repeat(len(is_held), 1, 1)
    reached = torch.zeros_like(is_held)
    first = int(is_held.nonzero()[0])
    reached[first] = True
    while True:
        leads = reached[edges[:, 0]] != reached[edges[:, 1]]
        if not bool(leads.any()):
            break
        edge = int(torch.where(leads, strengths, -1.0).argmax())
        a, b = edges[edge].tolist()
        if bool(reached[a]):
            S_aw[b] = S_ba[edge] @ S_aw[a]
            reached[b] = True
        else:
            S_aw[a] = sim3_inverse(S_ba[edge]) @ S_aw[b]
            reached[a] = True
    counted = is_held[edges].all(-1)
    if int(counted.sum()) < int(is_held.sum()):  # a tree: nothing to compromise on
        return S_aw
    information = JOINT_STD**-2 * (strengths / ENOUGH_JOINING).clamp(max=1.0)
    return solve_pose_graph(PoseGraph(S_aw, edges, S_ba, information, fixed=(first,), mask=counted)).S_cw
