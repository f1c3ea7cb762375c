"""Frames from which the next ones are followed: what the map knows of them, while that is needed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchslam.geometry import Camera, se3_inverse, transform
from torchslam.map.compaction import Renumbering
from torchslam.map.submap import World
from torchslam.tracking.match_selection import SENIOR, evenly
from torchslam.types import Anchor, Followed, Frame, Tracked, View

LEAST = 20  # points: with fewer there is nothing to follow


@dataclass(frozen=True)
class Anchored:
    """An anchor in its world.

    point_ids: (n,) rows of its points in the map; scales: (n,) and information: (n, I) of their keypoints
    T_ar:      (4, 4) from keyframe `reference`
    """

    point_ids: Tensor
    scales: Tensor
    information: Tensor
    T_ar: Tensor
    reference: int


class Anchors:
    """The newest anchors in the world that is followed, by the index of their frame.

    keep: how many: frames that are being followed may refer to any of them
    """

    def __init__(self, camera: Camera, count: int, keep: int) -> None:
        self.camera, self.count, self.keep = camera, count, keep
        self._known: dict[int, Anchored] = {}

    def __contains__(self, index: int) -> bool:
        return index in self._known

    def clear(self) -> None:
        """Nothing can be followed any more: the camera is elsewhere, or the map has moved."""
        self._known = {}

    def add(self, world: World, view: View, tracked: Tracked) -> Anchor | None:
        """Make the last frame of a world an anchor; None where it sees too little."""
        slam_map, track = world.map, world.track
        ids, keypoints = seen_by(world, view, tracked)
        alive = slam_map.points["alive"][ids]
        ids, keypoints = ids[alive], keypoints[alive]
        if len(ids) < LEAST or track.velocity is None:
            return None
        chosen = evenly(view.keypoints[keypoints], self.camera.size, self.count)
        ids, keypoints = ids[chosen], keypoints[chosen]
        T_aw, newest = world.T_cw, track.local_keyframes.new_tensor([slam_map.num_keyframes - 1])
        around = torch.cat([track.local_keyframes, newest])
        scales, information = view.scales[keypoints], view.information[keypoints]
        self._known[view.index] = Anchored(ids, scales, information, track.T_cr, track.reference)
        self._known = dict(list(self._known.items())[-self.keep :])
        return Anchor(
            index=view.index,
            points_a=transform(T_aw, slam_map.positions_w[ids]),
            pixels=view.keypoints[keypoints],
            scales=scales,
            senior=slam_map.points["times_found"][ids] >= SENIOR,
            T_ka=slam_map.T_cw[around] @ se3_inverse(T_aw),
            velocity=track.velocity,
            overlap=min(1.0, tracked.inliers / max(track.reference_size, 1)),
            information=information,
        )

    def renumber(self, renumbering: Renumbering) -> None:
        """Rows of the map went elsewhere; anchors whose reference keyframe is gone go as well."""
        kept = {}
        for index, anchored in self._known.items():
            reference = int(renumbering.keyframes[anchored.reference])
            if reference >= 0:
                ids = renumbering.points[anchored.point_ids]
                kept[index] = replace(anchored, point_ids=ids, reference=reference)
        self._known = kept

    def pose(self, world: World, followed: Followed) -> Tensor | None:
        """(4, 4) of a followed frame, world to camera; None where that is not known."""
        if followed.T_ca is None or followed.anchor not in self._known:
            return None
        anchored = self._known[followed.anchor]
        return followed.T_ca @ anchored.T_ar @ world.map.T_cw[anchored.reference]

    def place(self, world: World, frame: Frame, session: int, followed: Followed) -> tuple[View, Tracked]:
        """A followed frame as one of the world: the world's track goes on to it."""
        assert followed.T_ca is not None
        slam_map, track, anchored = world.map, world.track, self._known[followed.anchor]
        before = world.T_cw
        ids = anchored.point_ids[followed.rows]
        ids = torch.where(ids >= 0, slam_map.resolve(ids.clamp(min=0)), -1)
        used = torch.nonzero((ids >= 0) & slam_map.points["alive"][ids])[:, 0]
        ids, pixels, rows = ids[used], followed.pixels[used], followed.rows[used]
        scales, information = anchored.scales[rows], anchored.information[rows]
        track.T_cr, track.reference = followed.T_ca @ anchored.T_ar, anchored.reference
        track.velocity, track.seen_last = world.T_cw @ se3_inverse(before), ids
        nothing = torch.zeros(len(ids), 0, dtype=slam_map.points["descriptors"].dtype, device=ids.device)
        mask = torch.ones(len(ids), dtype=torch.bool, device=ids.device)
        angles = torch.zeros_like(scales)
        view = View(
            frame.index,
            frame.timestamp,
            *(pixels, scales, angles, nothing, mask),
            session=session,
            information=information,
        )
        rows = torch.arange(len(ids), device=ids.device)
        depth = float(transform(world.T_cw, slam_map.positions_w[ids])[:, 2].median()) if len(ids) else 0.0
        return view, Tracked(world.T_cw, ids, rows, followed.expected, followed.covariance, depth)


def seen_by(world: World, view: View, tracked: Tracked) -> tuple[Tensor, Tensor]:
    """(m,), (m,) points that a frame sees, and its keypoints: of a keyframe the new ones, too."""
    slam_map = world.map
    keyframe = slam_map.num_keyframes - 1
    kept = slam_map.keyframes
    if (int(kept["frame_index"][keyframe]), int(kept["session"][keyframe])) != (view.index, view.session):
        return tracked.point_ids, tracked.keypoints
    point_ids = kept["point_ids"][keyframe]
    keypoints = torch.nonzero(point_ids >= 0)[:, 0]
    return point_ids[keypoints], keypoints
