"""Compaction of a submap: remove keyframes and the rows of invalid points.

All rows that the submap refers to are renumbered; rows kept elsewhere follow by the `RowRemap`.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from torchslam.geometry import se3_inverse
from torchslam.map.atlas import Submap
from torchslam.map.map import NO_POINT, Map

MIN_INVALID_ROWS = 4096  # fewer are not worth a compaction
_MAX_REWRITTEN = 64  # rows of frame observations that may be rewritten per row of an invalid point


@dataclass(frozen=True)
class RowRemap:
    """The new rows after a removal."""

    keyframes: Int[Tensor, " K"]  # of every old keyframe; -1 if removed
    points: Int[Tensor, " L"]  # of every old point; -1 if removed
    replacement: Int[Tensor, " K"]  # of the keyframe that replaces a removed one; its own for the others

    def then(self, later: RowRemap) -> RowRemap:
        """Return the new rows after a later removal as well."""
        return RowRemap(
            torch.where(self.keyframes >= 0, later.keyframes[self.keyframes], -1),
            torch.where(self.points >= 0, later.points[self.points], -1),
            later.replacement[self.replacement],
        )


def remove_keyframes(submap: Submap, keyframes: Int[Tensor, " R"]) -> RowRemap:
    """Remove keyframes from the map; they become posed frames that keep the observations of the keyframe.

    Frames that referred to one of them refer to the nearest covisible keyframe, without moving. Points follow the first
    keyframe that still observes them; those that fewer than two observe become invalid.

    Raises:
        ValueError: The reference keyframe of tracking is among them.
    """
    slam_map, posed_frames = submap.map, submap.posed_frames
    count, device = slam_map.num_keyframes, slam_map.T_cw.device
    removed = torch.zeros(count, dtype=torch.bool, device=device)
    removed[keyframes] = True
    if submap.tracking.reference >= 0 and bool(removed[submap.tracking.reference]):
        raise ValueError("the reference keyframe of tracking cannot be removed")
    replacement = torch.arange(count, device=device)
    for keyframe in torch.nonzero(removed)[:, 0].tolist():
        replacement[keyframe] = replacement_keyframe(slam_map, keyframe, removed)
    if len(posed_frames):
        posed_frames.absorb_keyframes(slam_map, torch.nonzero(removed)[:, 0])
        posed_frames.reassign_reference(replacement, slam_map)
    _leave_points(slam_map, removed, replacement)
    kept = torch.nonzero(~removed)[:, 0]
    rows = torch.where(removed, -1, torch.cumsum(~removed, 0) - 1)
    slam_map.keyframes.keep(kept)
    slam_map.points["first_keyframe"][:] = rows[replacement][slam_map.points["first_keyframe"]]
    slam_map.mark_renumbered()
    if len(posed_frames):
        posed_frames.frames["reference_keyframe"][:] = rows[posed_frames.frames["reference_keyframe"]]
    points = torch.arange(len(slam_map.points), device=device)
    submap.tracking = submap.tracking.renumbered(rows, points.where(slam_map.points["is_valid"], NO_POINT))
    return RowRemap(rows, points, rows[replacement])


def replacement_keyframe(slam_map: Map, keyframe: int, removed: Bool[Tensor, " K"]) -> int:
    """Return the nearest of the most covisible keyframes, without the removed ones."""
    seen = slam_map.keyframes["point_ids"][keyframe]
    shared = slam_map.count_observed(seen[seen >= 0]).masked_fill(removed, -1)
    best = torch.sort(shared, descending=True, stable=True).indices[:8]  # the most covisible ones
    best = best[~removed[best]]
    centers_w = se3_inverse(slam_map.T_cw[torch.cat([best.new_tensor([keyframe]), best])])[:, :3, 3]
    return int(best[torch.linalg.vector_norm(centers_w[1:] - centers_w[0], dim=-1).argmin()])


def _leave_points(slam_map: Map, removed: Bool[Tensor, " K"], replacement: Int[Tensor, " K"]) -> None:
    """Remove the observations of removed keyframes and reassign the points that they created."""
    gone = torch.nonzero(removed)[:, 0]
    seen = slam_map.observations(gone)
    slam_map.remove_masked_observations(seen, torch.ones_like(seen.point_index, dtype=torch.bool))
    orphans = torch.nonzero(removed[slam_map.points["first_keyframe"]])[:, 0]
    observers, _ = slam_map.observers_and_scales(orphans)
    first = torch.where(observers >= 0, observers, len(removed)).amin(1)
    first_keyframe = slam_map.points["first_keyframe"][orphans]
    slam_map.points["first_keyframe"][orphans] = torch.where(
        first < len(removed), first, replacement[first_keyframe]
    )


def compact(submap: Submap) -> RowRemap | None:
    """Remove invalid rows if they are so many that it costs O(1) for each; return the new rows, or None."""
    valid = submap.map.num_points
    invalid = len(submap.map.points) - valid
    rewritten = len(submap.posed_frames.observations)
    if invalid <= max(MIN_INVALID_ROWS, valid) or _MAX_REWRITTEN * invalid <= rewritten:
        return None
    return remove_invalid_rows(submap)


def remove_invalid_rows(submap: Submap) -> RowRemap:
    """Remove the rows of invalid points; observations of merged points become those of their replacements."""
    slam_map = submap.map
    alive = slam_map.points["is_valid"]
    kept = torch.nonzero(alive)[:, 0]
    rows = torch.where(alive, torch.cumsum(alive, 0) - 1, NO_POINT)
    submap.posed_frames.renumber_points(slam_map, rows)
    slam_map.points.keep(kept)
    for column in (slam_map.keyframes["point_ids"], slam_map.points["replaced_by"]):
        column[:] = torch.where(column >= 0, rows[column], NO_POINT)
    slam_map.mark_renumbered()
    everyone = torch.arange(slam_map.num_keyframes, device=rows.device)
    submap.tracking = submap.tracking.renumbered(everyone, rows)
    return RowRemap(everyone, rows, everyone)
