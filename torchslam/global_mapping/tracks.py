"""Tracks: observations of one point by many images, joined from the matches of pairs, and their points.

A wrong match joins two points in one track. So a track's point is found by consensus among its observations, and
observations that disagree are left out, not forgotten: with better poses they are tried again.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchslam.global_mapping.view_graph import ViewPair
from torchslam.map.map import KEYPOINT_COLUMNS, Map
from torchslam.types import FrameFeatures
from torchslam.utils.indexing import connected_parts

MIN_PARALLAX = math.radians(0.5)
"""Least angle between rays to a point. Points of 0.25 to 1 degree give the same poses; without any limit, far points
with wrong depths disturb what comes after."""
_HYPOTHESES = (0.0, 1.0), (0.0, 0.5), (0.5, 1.0), (0.25, 0.75), (0.0, 0.25), (0.75, 1.0)
"""Pairs of observations, as shares of a track, that propose its point."""
_SAME_RAY = 1e-12
"""Squared sine of the angle between two rays below which their intersection is not computed: that of rounding."""


@dataclass(frozen=True)
class Tracks:
    """Observations of points, ordered by track, then image; an image observes a track at most once.

    Attributes:
        track: number of the track of each observation, from 0 without gaps.
        view, keypoint: rows of its image, and among the keypoints of that.
    """

    track: Int[Tensor, " O"]
    view: Int[Tensor, " O"]
    keypoint: Int[Tensor, " O"]

    @property
    def count(self) -> int:
        """The number of tracks."""
        return int(self.track[-1]) + 1 if len(self.track) else 0

    @property
    def lengths(self) -> Int[Tensor, " N"]:
        """Number of observations of each track."""
        return torch.bincount(self.track, minlength=self.count)

    def __len__(self) -> int:
        """The number of observations."""
        return len(self.track)

    def select(self, keep: Bool[Tensor, " O"], least: int = 2) -> tuple[Tracks, Int[Tensor, " M"]]:
        """The tracks that keep at least some observations of a mask, renumbered, and their former numbers."""
        counts = torch.bincount(self.track[keep], minlength=self.count)
        rows = keep & (counts >= least)[self.track]
        former, renumbered = torch.unique(self.track[rows], return_inverse=True)
        return Tracks(renumbered, self.view[rows], self.keypoint[rows]), former


def join_matches(pairs: list[ViewPair], views: int, keypoints: int) -> Tracks:
    """Join matches to tracks, their connected components, without observations by two keypoints of one image.

    `views` and `keypoints`: number of images, and the largest number of keypoints of one.
    """
    none = torch.zeros(0, dtype=torch.int64, device=pairs[0].keypoints_1.device if pairs else "cpu")
    one = torch.cat([none, *(pair.first * keypoints + pair.keypoints_1 for pair in pairs)])
    other = torch.cat([none, *(pair.second * keypoints + pair.keypoints_2 for pair in pairs)])
    label = connected_parts(torch.stack([one, other], dim=1), views * keypoints)
    nodes = torch.unique(torch.cat([one, other]))
    nodes = nodes[torch.argsort(label[nodes], stable=True)]  # within a track by image
    _, track = torch.unique(label[nodes], return_inverse=True)
    view = nodes // keypoints
    _, which, counts = torch.unique(track * views + view, return_inverse=True, return_counts=True)
    return Tracks(track, view, nodes % keypoints).select(counts[which] == 1)[0]


def held_parts(
    tracks: Tracks, agrees: Bool[Tensor, " O"], views: int, least_shared: int
) -> Int[Tensor, " {views}"]:
    """The lowest image of the part of each image: of those that points hold together, by observations that agree.

    least_shared: points that two images must share, each seen by no image between them, to hold together
    """
    track, view = tracks.track[agrees], tracks.view[agrees]
    follows = track[1:] == track[:-1]
    links, counts = torch.unique((view[:-1] * views + view[1:])[follows], return_counts=True)
    links = links[counts >= least_shared]
    return connected_parts(torch.stack([links // views, links % views], dim=1), views)


def longest_tracks(tracks: Tracks, per_view: int) -> Bool[Tensor, " N"]:
    """The tracks that are among the `per_view` longest ones of some image: they tie all images together."""
    length = tracks.lengths[tracks.track]
    order = (
        torch.argsort(tracks.view * (int(length.max()) + 1) - length, stable=True) if len(tracks) else length
    )
    view = tracks.view[order]
    first = torch.searchsorted(view, view)  # where the image's observations begin
    is_long = torch.arange(len(order), device=view.device) - first < per_view
    chosen = torch.zeros(tracks.count, dtype=torch.bool, device=view.device)
    chosen[tracks.track[order[is_long]]] = True
    return chosen


def triangulate_tracks(
    tracks: Tracks,
    rays_w: Float[Tensor, "O 3"],
    centers_w: Float[Tensor, "O 3"],
    tolerance_rad: Float[Tensor, " O"],
) -> tuple[Float[Tensor, "N 3"], Bool[Tensor, " O"]]:
    """Find the point of each track by consensus of its rays, and the observations that agree with it.

    Where nothing agrees, the point is that of the best hypothesis.

    Args:
        tracks: N of them.
        rays_w, centers_w: unit directions of the observations, and where they begin.
        tolerance_rad: angle to the point up to which an observation agrees.
    """
    length = tracks.lengths
    start = length.cumsum(0) - length
    best_points = rays_w.new_zeros(tracks.count, 3)
    best_score = rays_w.new_full((tracks.count,), -1.0)
    for shares in _HYPOTHESES:
        first, second = (start + ((length - 1).double() * share).round().long() for share in shares)
        points_w = _intersections(rays_w, centers_w, first, second)
        errors = ray_errors(rays_w, centers_w, points_w[tracks.track])
        gains = (1 - (errors / tolerance_rad).square()).clamp(min=0.0)  # truncated, as MSAC scores
        score = _sums(tracks, gains)
        is_better = score > best_score
        best_points = torch.where(is_better[:, None], points_w, best_points)
        best_score = torch.where(is_better, score, best_score)
    agrees = ray_errors(rays_w, centers_w, best_points[tracks.track]) < tolerance_rad
    points_w = _nearest_to_rays(tracks, rays_w, centers_w, agrees, best_points)
    return points_w, ray_errors(rays_w, centers_w, points_w[tracks.track]) < tolerance_rad


def ray_errors(
    rays_w: Float[Tensor, "O 3"], centers_w: Float[Tensor, "O 3"], points_w: Float[Tensor, "O 3"]
) -> Float[Tensor, " O"]:
    """Angles between rays and the directions to points, radians; pi / 2 and more for points behind or at the center."""
    seen = points_w - centers_w
    across = torch.linalg.cross(rays_w, seen).norm(dim=-1)
    angles = torch.atan2(across, (rays_w * seen).sum(-1))
    return angles.where((seen != 0).any(-1), torch.pi)


def parallax(
    tracks: Tracks,
    centers_w: Float[Tensor, "O 3"],
    points_w: Float[Tensor, "N 3"],
    agrees: Bool[Tensor, " O"],
) -> Float[Tensor, " N"]:
    """Angle at each point between the first and the most different agreeing observation, radians."""
    seen = torch.nn.functional.normalize(points_w[tracks.track] - centers_w, dim=-1)
    rows = torch.arange(len(tracks), device=seen.device)
    first = rows.new_full((tracks.count,), len(rows)).scatter_reduce(
        0, tracks.track[agrees], rows[agrees], "amin"
    )
    reference = seen[first.clamp(max=max(len(rows) - 1, 0))][tracks.track]
    angles = torch.atan2(torch.linalg.cross(seen, reference).norm(dim=-1), (seen * reference).sum(-1))
    return seen.new_zeros(tracks.count).scatter_reduce(0, tracks.track[agrees], angles[agrees], "amax")


def _intersections(
    rays_w: Tensor, centers_w: Tensor, first: Int[Tensor, " N"], second: Int[Tensor, " N"]
) -> Float[Tensor, "N 3"]:
    """The midpoints between two rays each; a point ahead on the first one where they are parallel."""
    a, b = rays_w[first], rays_w[second]
    base = centers_w[second] - centers_w[first]
    cosine = (a * b).sum(-1)
    sine2 = 1 - cosine.square()
    along_a, along_b = (base * a).sum(-1), (base * b).sum(-1)
    crossing = sine2 > _SAME_RAY
    safe = torch.where(crossing, sine2, 1.0)
    at_a = torch.where(crossing, (along_a - cosine * along_b) / safe, base.norm(dim=-1) / _SAME_RAY**0.5)
    at_b = torch.where(crossing, (cosine * along_a - along_b) / safe, at_a)
    return 0.5 * (centers_w[first] + at_a[:, None] * a + centers_w[second] + at_b[:, None] * b)


def _nearest_to_rays(
    tracks: Tracks, rays_w: Tensor, centers_w: Tensor, agrees: Tensor, otherwise: Float[Tensor, "N 3"]
) -> Float[Tensor, "N 3"]:
    """The points nearest to the agreeing rays, weighted by inverse squared distance as angles are."""
    weight = agrees / (otherwise[tracks.track] - centers_w).square().sum(-1).clamp(min=1e-30)
    eye = torch.eye(3, dtype=rays_w.dtype, device=rays_w.device)
    across = weight[:, None, None] * (eye - rays_w[:, :, None] * rays_w[:, None])
    A = _sums(tracks, across)
    b = _sums(tracks, (across @ centers_w[..., None])[..., 0])
    size = A.diagonal(dim1=1, dim2=2).sum(-1)
    determined = torch.linalg.det(A / size.clamp(min=1e-300)[:, None, None]) > _SAME_RAY
    points_w = torch.linalg.solve(torch.where(determined[:, None, None], A, eye), b)
    return torch.where(determined[:, None], points_w, otherwise)


def _sums(tracks: Tracks, values: Float[Tensor, "O *n"]) -> Float[Tensor, "N *n"]:
    """Sums over the observations of each track, in their order: the same bytes on every run."""
    flat = values.reshape(len(values), math.prod(values.shape[1:]))
    total = torch.segment_reduce(flat, "sum", lengths=tracks.lengths, unsafe=True)
    return total.view(tracks.count, *values.shape[1:])


def without_empty_rows(view: FrameFeatures) -> FrameFeatures:
    """The view without the rows after its last keypoint, in memory of its own: extractors pad all to the same number,
    and descriptors are most of the memory."""
    used = view.mask.nonzero()
    most = 1 + int(used.amax()) if len(used) else 0
    if most == len(view.mask):
        return view
    return replace(view, **{name: getattr(view, name)[:most].clone() for name in KEYPOINT_COLUMNS})


def keypoints_of_tracks(views: Sequence[FrameFeatures], tracks: Tracks) -> tuple[list[FrameFeatures], Tracks]:
    """The views without the keypoints that no track has, in as many rows each, and the tracks with these rows.

    Of the keypoints of an image that was matched, one in six to one in thirty belongs to a point.
    """
    rows = _rows_of(tracks.view, len(views))
    most, kept, moved = max(map(len, rows)), list[FrameFeatures](), torch.empty_like(tracks.keypoint)
    for view, own in zip(views, rows, strict=True):
        chosen, moved[own] = torch.unique(tracks.keypoint[own], return_inverse=True)
        filled = torch.cat((chosen, chosen.new_zeros(most - len(chosen))))
        columns: dict[str, Any] = {name: getattr(view, name)[filled] for name in KEYPOINT_COLUMNS}
        columns["mask"][len(chosen) :] = False
        kept.append(replace(view, **columns))
    return kept, replace(tracks, keypoint=moved)


def make_map(
    views: list[FrameFeatures],
    T_cw: Float[Tensor, "K 4 4"],
    tracks: Tracks,
    points_w: Float[Tensor, "N 3"],
) -> Map:
    """Create a map of images with the points of their tracks."""
    made = Map()
    for view, T in zip(views, T_cw, strict=True):
        made.add_keyframe(view, T)
    first = torch.searchsorted(tracks.track, torch.arange(tracks.count, device=points_w.device))
    first_view = tracks.view[first]
    ids = torch.full_like(first_view, -1)
    for row, (view, own) in enumerate(zip(views, _rows_of(first_view, len(views)), strict=True)):
        descriptors = view.descriptors[tracks.keypoint[first[own]]]
        ids[own] = made.add_points(points_w[own], descriptors, row)
    for row, own in enumerate(_rows_of(tracks.view, len(views))):
        made.add_observations(row, tracks.keypoint[own], ids[tracks.track[own]])
    made.update_appearance(torch.arange(len(views), device=points_w.device))
    return made


def _rows_of(view: Int[Tensor, " O"], views: int) -> tuple[Int[Tensor, " n"], ...]:
    """The rows of each of `views` images, ascending."""
    return torch.argsort(view, stable=True).split(torch.bincount(view, minlength=views).tolist())
