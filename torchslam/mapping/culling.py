"""Keyframes that the map can do without: others see nearly all of what they see, as finely, from nearby.

A camera that goes to and fro in one room makes new keyframes wherever a frame sees less than it might. Without this the
map would grow with the length of the run, not with the size of the room.
Source: Mur-Artal, Montiel and Tardos, "ORB-SLAM: a versatile and accurate monocular SLAM system", 2015, section VI.E.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchslam.config import KeyframesConfig
from torchslam.geometry import transform
from torchslam.geometry.motion import apart
from torchslam.map.compaction import RowRemap, remove_keyframes
from torchslam.map.map import Map
from torchslam.map.submap import Submap

SHARE, OTHERS = 0.9, 3  # of a keyframe's points that so many others must see
COARSER = 1.25  # seen one level of the pyramid (a factor of 1.2) coarser is seen as well
NEWEST = 8  # keyframes that are never asked: their points are still on trial, and the track starts from them
AROUND = 20  # keyframes that are asked around each new one
# Asked every so many keyframes, or every sixteenth of the map: the copies of rows that a removal makes then
# cost a fixed amount for each keyframe.
_LEAST_BATCH, _BATCH_SHARE = 8, 16


def cull_keyframes(world: Submap, settings: KeyframesConfig) -> RowRemap | None:
    """Take redundant keyframes out of the world, a batch at a time; returns where rows went, None if they stay.

    The first keyframe, the newest ones and the track's reference always stay.
    """
    count = world.map.num_keyframes
    if count - world.asked < max(_LEAST_BATCH, count // _BATCH_SHARE):
        return None
    goes = redundant(world, around_new_ones(world), settings)
    renumbering = remove_keyframes(world, torch.nonzero(goes)[:, 0]) if bool(goes.any()) else None
    world.asked = world.map.num_keyframes
    return renumbering


def around_new_ones(world: Submap) -> Tensor:
    """(k,) keyframes that share points with those that were not there at the last culling, the newest first."""
    slam_map = world.map
    candidates = slam_map.around(slam_map.ids(*range(world.asked, slam_map.num_keyframes)), AROUND)
    may_go = (candidates > 0) & (candidates < slam_map.num_keyframes - NEWEST)
    return candidates[may_go & (candidates != world.track.reference)].flip(0)


def redundant(world: Submap, candidates: Tensor, settings: KeyframesConfig) -> Tensor:
    """(K,) bool, which of the candidates (k,) the map can do without, one after the other."""
    goes = torch.zeros(world.map.num_keyframes, dtype=torch.bool, device=candidates.device)
    for keyframe in candidates.tolist():
        goes[keyframe] = is_covered(world.map, keyframe, goes) and has_near(
            world.map, keyframe, goes, settings
        )
    return goes


def is_covered(slam_map: Map, keyframe: int, goes: Tensor) -> bool:
    """Whether enough others that stay see the points of a keyframe as finely, or nearly so."""
    seen = slam_map.observations(slam_map.ids(keyframe))
    observers, scales = slam_map.scales_of(seen.point_index)
    counts = (
        (observers >= 0)
        & (observers != keyframe)
        & ~goes[observers]
        & (scales <= COARSER * seen.scales[:, None])
    )
    return float((counts.sum(1) >= OTHERS).double().mean()) >= SHARE if len(seen) else True


def has_near(slam_map: Map, keyframe: int, goes: Tensor, settings: KeyframesConfig) -> bool:
    """Whether a keyframe that stays is so near that a frame at the place of this one would not become one."""
    near = slam_map.covisible(keyframe, AROUND)
    near = near[~goes[near]]
    T_cw = slam_map.T_cw[keyframe]
    seen = slam_map.points_seen_by(slam_map.ids(keyframe))
    depth = transform(T_cw, slam_map.positions_w[seen])[:, 2].median()
    translation, rotation = apart(T_cw, slam_map.T_cw[near], depth)
    return bool(((translation <= settings.max_translation) & (rotation <= settings.max_rotation_deg)).any())


def drop_covered(world: Submap, covers: Callable[[Tensor], Tensor]) -> None:
    """Forget what the keyframes around the camera saw at pixels that do not belong to the scene.

    covers: (n, 2) pixels -> (n,) bool
    """
    slam_map = world.map
    seen = slam_map.observations(torch.sort(world.track.local_keyframes).values)
    slam_map.drop(seen, covers(seen.pixels))
