"""Keyframe culling: remove keyframes whose points other, nearby keyframes observe at a similar scale.

It bounds the map by the size of the explored space instead of the length of the run.
Source: Mur-Artal, Montiel and Tardos, "ORB-SLAM: a versatile and accurate monocular SLAM system", 2015, section VI.E.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchslam.config import KeyframesConfig
from torchslam.geometry import transform
from torchslam.geometry.transforms import pose_distance
from torchslam.map.atlas import Submap
from torchslam.map.compaction import RowRemap, remove_keyframes
from torchslam.map.map import Map

MIN_COVERED_RATIO = 0.9
"""Ratio of a keyframe's points that other keyframes must observe."""
MIN_OBSERVERS = 3
"""Number of other keyframes that must observe each of these points."""
MAX_SCALE_RATIO = 1.25
"""Ratio of scales up to which an observation counts: one pyramid level (a factor of 1.2) coarser is accepted."""
NUM_NEWEST_KEPT = 8
"""Newest keyframes, which are never culled: their points are recent, and tracking continues from them."""
NUM_COVISIBLE = 20
"""Keyframes that are checked around each new one."""
_LEAST_BATCH, _BATCH_SHARE = 8, 16
"""Culling runs after this many new keyframes, or this part of the map: copying rows then costs O(1) per keyframe."""


def cull_keyframes(submap: Submap, settings: KeyframesConfig) -> RowRemap | None:
    """Remove redundant keyframes, a batch at a time; return where rows went, or None if nothing was removed.

    The first keyframe, the newest ones and the reference keyframe of tracking always stay.
    """
    count = submap.map.num_keyframes
    if count - submap.num_cull_checked < max(_LEAST_BATCH, count // _BATCH_SHARE):
        return None
    removed = redundant_keyframes(submap, cull_candidates(submap), settings)
    renumbering = remove_keyframes(submap, torch.nonzero(removed)[:, 0]) if bool(removed.any()) else None
    submap.num_cull_checked = submap.map.num_keyframes
    return renumbering


def cull_candidates(submap: Submap) -> Int[Tensor, " R"]:
    """Return keyframes covisible with those inserted since the last culling, the newest first."""
    slam_map = submap.map
    candidates = slam_map.covisibility_union(
        slam_map.index_tensor(*range(submap.num_cull_checked, slam_map.num_keyframes)), NUM_COVISIBLE
    )
    may_go = (candidates > 0) & (candidates < slam_map.num_keyframes - NUM_NEWEST_KEPT)
    return candidates[may_go & (candidates != submap.tracking.reference)].flip(0)


def redundant_keyframes(
    submap: Submap, candidates: Int[Tensor, " R"], settings: KeyframesConfig
) -> Bool[Tensor, " K"]:
    """Return which keyframes, of the candidates, are redundant, decided one after the other."""
    removed = torch.zeros(submap.map.num_keyframes, dtype=torch.bool, device=candidates.device)
    for keyframe in candidates.tolist():
        removed[keyframe] = is_covered(submap.map, keyframe, removed) and has_keyframe_nearby(
            submap.map, keyframe, removed, settings
        )
    return removed


def is_covered(slam_map: Map, keyframe: int, removed: Bool[Tensor, " K"]) -> bool:
    """Whether enough remaining keyframes observe the points of a keyframe at a similar or finer scale."""
    seen = slam_map.observations(slam_map.index_tensor(keyframe))
    observers, scales = slam_map.observers_and_scales(seen.point_index)
    counts = (
        (observers >= 0)
        & (observers != keyframe)
        & ~removed[observers]
        & (scales <= MAX_SCALE_RATIO * seen.scales[:, None])
    )
    return float((counts.sum(1) >= MIN_OBSERVERS).double().mean()) >= MIN_COVERED_RATIO if len(seen) else True


def has_keyframe_nearby(
    slam_map: Map, keyframe: int, removed: Bool[Tensor, " K"], settings: KeyframesConfig
) -> bool:
    """Whether a remaining keyframe is so close that a frame at this pose would not become a keyframe."""
    covisible = slam_map.covisible_keyframes(keyframe, NUM_COVISIBLE)
    covisible = covisible[~removed[covisible]]
    T_cw = slam_map.T_cw[keyframe]
    seen = slam_map.observed_points(slam_map.index_tensor(keyframe))
    depth = transform(T_cw, slam_map.positions_w[seen])[:, 2].median()
    translation, rotation = pose_distance(T_cw, slam_map.T_cw[covisible], depth)
    return bool(((translation <= settings.max_translation) & (rotation <= settings.max_rotation_deg)).any())


def remove_masked_observations(
    submap: Submap, is_masked: Callable[[Float[Tensor, "N 2"]], Bool[Tensor, " N"]]
) -> None:
    """Remove observations of the local keyframes at pixels for which `is_masked` is true."""
    slam_map = submap.map
    seen = slam_map.observations(torch.sort(submap.tracking.local_keyframes).values, as_detected=True)
    slam_map.remove_masked_observations(seen, is_masked(seen.pixels))
