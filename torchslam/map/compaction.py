"""A world without what it no longer needs: keyframes that others replace, and the rows of dead points.

Rows are renumbered wherever a world refers to them. Whoever keeps rows elsewhere follows by the `RowRemap`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchslam.geometry import se3_inverse
from torchslam.map.map import NO_POINT, Map
from torchslam.map.submap import Submap

LEAST_DEAD = 4096  # rows of dead points that are not worth the trouble
_PRICE = 64  # rows of the history that may be rewritten per row of a dead point


@dataclass(frozen=True)
class RowRemap:
    """Where rows went.

    keyframes: (K,) new row of every old keyframe; points: (L,) likewise; -1 where it is gone
    heirs:     (K,) new row of the keyframe that stands in for a keyframe that is gone; of itself for the others
    """

    keyframes: Tensor
    points: Tensor
    heirs: Tensor

    def then(self, later: RowRemap) -> RowRemap:
        """Both, one after the other."""
        return RowRemap(
            torch.where(self.keyframes >= 0, later.keyframes[self.keyframes], -1),
            torch.where(self.points >= 0, later.points[self.points], -1),
            later.heirs[self.heirs],
        )


def remove_keyframes(world: Submap, keyframes: Tensor) -> RowRemap:
    """Take keyframes (k,) out of the map; their frames stay in the history, with what the map knew of them last.

    A frame that referred to one of them refers to the nearest keyframe that shares points with it, at the same place.
    Points follow the first keyframe that still sees them; those that fewer than two still see are dead.
    Raises ValueError for the first keyframe, which holds the world in place, and for the track's reference.
    """
    slam_map, history = world.map, world.history
    count, device = slam_map.num_keyframes, slam_map.T_cw.device
    goes = torch.zeros(count, dtype=torch.bool, device=device)
    goes[keyframes] = True
    if bool(goes[0]) or (world.track.reference >= 0 and bool(goes[world.track.reference])):
        raise ValueError("the first keyframe and the reference of the track cannot be removed")
    heirs = torch.arange(count, device=device)
    for keyframe in torch.nonzero(goes)[:, 0].tolist():
        heirs[keyframe] = stand_in(slam_map, keyframe, goes)
    if len(history):
        history.take_over(slam_map, torch.nonzero(goes)[:, 0])
        history.refer(heirs, slam_map)
    _leave_points(slam_map, goes, heirs)
    kept = torch.nonzero(~goes)[:, 0]
    rows = torch.where(goes, -1, torch.cumsum(~goes, 0) - 1)
    slam_map.keyframes.keep(kept)
    slam_map.points["first_keyframe"][:] = rows[heirs][slam_map.points["first_keyframe"]]
    slam_map.reindex()
    if len(history):
        history.frames["reference_keyframe"][:] = rows[history.frames["reference_keyframe"]]
    alive, track = slam_map.points["is_valid"], world.track
    local = rows[track.local_keyframes]
    world.track = replace(
        track,
        reference=int(rows[track.reference]) if track.reference >= 0 else -1,
        local_keyframes=local[local >= 0],
        local_points=track.local_points[alive[track.local_points]],
        seen_last=track.seen_last[alive[track.seen_last]],
    )
    return RowRemap(rows, torch.arange(len(slam_map.points), device=device), rows[heirs])


def stand_in(slam_map: Map, keyframe: int, goes: Tensor, count: int = 8) -> int:
    """The nearest of the keyframes that share most points with a keyframe and stay; goes: (K,) bool."""
    seen = slam_map.keyframes["point_ids"][keyframe]
    shared = slam_map.observers(seen[seen >= 0]).masked_fill(goes, -1)
    best = torch.sort(shared, descending=True, stable=True).indices[:count]
    best = best[~goes[best]]
    centres_w = se3_inverse(slam_map.T_cw[torch.cat([best.new_tensor([keyframe]), best])])[:, :3, 3]
    return int(best[torch.linalg.vector_norm(centres_w[1:] - centres_w[0], dim=-1).argmin()])


def _leave_points(slam_map: Map, goes: Tensor, heirs: Tensor) -> None:
    """Drop what keyframes see that go (K,) bool; their points are left to the others."""
    gone = torch.nonzero(goes)[:, 0]
    seen = slam_map.observations(gone)
    slam_map.drop(seen, torch.ones_like(seen.point_index, dtype=torch.bool))
    orphans = torch.nonzero(goes[slam_map.points["first_keyframe"]])[:, 0]
    observers, _ = slam_map.scales_of(orphans)
    first = torch.where(observers >= 0, observers, len(goes)).amin(1)
    first_keyframe = slam_map.points["first_keyframe"][orphans]
    slam_map.points["first_keyframe"][orphans] = torch.where(first < len(goes), first, heirs[first_keyframe])


def compact(world: Submap) -> RowRemap | None:
    """Give back the rows of dead points where that is worth it; returns where rows went, None if they stay."""
    return drop_dead_points(world) if is_worth_compacting(world) else None


def is_worth_compacting(world: Submap) -> bool:
    """Whether so many rows are dead that dropping them costs a fixed amount for each of them."""
    rows, living = len(world.map.points), world.map.num_points
    dead = rows - living
    return dead > LEAST_DEAD and dead > living and _PRICE * dead > len(world.history.observations)


def drop_dead_points(world: Submap) -> RowRemap:
    """Give back the rows of dead points; what the history saw of merged points is seen of their heirs from now on."""
    slam_map, track = world.map, world.track
    alive = slam_map.points["is_valid"]
    kept = torch.nonzero(alive)[:, 0]
    rows = torch.where(alive, torch.cumsum(alive, 0) - 1, NO_POINT)
    world.history.renumber_points(slam_map, rows)
    slam_map.points.keep(kept)
    for column in (slam_map.keyframes["point_ids"], slam_map.points["replaced_by"]):
        column[:] = torch.where(column >= 0, rows[column], NO_POINT)
    slam_map.reindex()
    local, last = rows[track.local_points], rows[track.seen_last]
    world.track = replace(track, local_points=local[local >= 0], seen_last=last[last >= 0])
    everyone = torch.arange(slam_map.num_keyframes, device=rows.device)
    return RowRemap(everyone, rows, everyone)
