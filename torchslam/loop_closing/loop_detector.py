"""Loop detection: candidates from the keyframe database, Sim(3) estimation, and verification."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Int
from torch import Tensor

from torchslam.config import Config
from torchslam.geometry import SharedCamera, se3_inverse, sim3_scale
from torchslam.geometry.transforms import rotation_angle
from torchslam.loop_closing.keyframe_database import KeyframeDatabase
from torchslam.loop_closing.relative_sim3 import RelativeSim3, RelativeSim3Estimator, neighborhood
from torchslam.map.atlas import Atlas, Submap
from torchslam.map.map import Map
from torchslam.types import Matcher

_AROUND = 20
"""Keyframes that share most points with the new one: their places are known. Tried at this value only."""
_MAX_CANDIDATES = 3
"""Places that are verified for a keyframe, the most similar first; each takes a Sim(3). Tried at this value only."""
_NUM_VERIFYING, _MIN_VERIFYING = 5, 2
"""Covisible keyframes that may verify a candidate, and those that must. Tried at these values only."""
_MAX_DRIFT, _MAX_DRIFT_DEG, _MAX_DRIFT_SCALE = 0.2, 20.0, 5.0
"""Largest plausible drift along a loop: ratio of the position to the length of the path, degrees, and factor of the
scale, which drifts most. Tried with a factor of the scale of 2 and 5."""
_SAME_SCALE, _SAME_DEG, _SAME_SHARE = 1.2, 5.0, 0.1
"""Largest difference of two consistent relations: ratio of scales, degrees, and distance relative to the depth of the
scene. Wide: lookalike places differ by meters and tens of degrees. Tried at these values only."""


@dataclass(frozen=True)
class LoopCandidate:
    """A verified match of a new keyframe with a recognized one of the same place, in the same submap or another.

    The relation is the Sim(3) from the submap, at the keyframe, to the matched submap.
    """

    submap: Submap
    keyframe: int
    matched_submap: Submap
    matched_keyframe: int
    relation: RelativeSim3

    @property
    def is_loop(self) -> bool:
        """Whether both are in the same submap."""
        return self.submap is self.matched_submap

    @property
    def closure(self) -> LoopClosureRecord:
        """The record of this candidate, independent of later changes of the map."""
        frame = int(self.submap.map.keyframes["frame_index"][self.keyframe])
        matched_frame = int(self.matched_submap.map.keyframes["frame_index"][self.matched_keyframe])
        return LoopClosureRecord(frame, matched_frame, self.submap.number, self.matched_submap.number)


@dataclass(frozen=True)
class LoopClosureRecord:
    """Record of a loop closure or map merge: frames of the new and the recognized keyframe, and their submaps."""

    frame: int
    matched_frame: int
    submap: int
    matched_submap: int


class LoopDetector:
    """Detects whether a new keyframe shows a known place."""

    def __init__(
        self,
        camera: SharedCamera,
        config: Config,
        atlas: Atlas,
        database: KeyframeDatabase,
        matcher: Matcher | None,
    ) -> None:
        self.atlas = atlas
        self.keyframe_database = database
        self.estimator = RelativeSim3Estimator(camera, config, matcher)

    def detect(self, submap: Submap, keyframe: int) -> LoopCandidate | None:
        """Return the verified candidate of a keyframe; None if there is none or if candidates disagree."""
        found = [
            LoopCandidate(submap, keyframe, other, matched_keyframe, relation)
            for other, matched_keyframe in self._candidates(submap, keyframe)
            if (relation := self._relation(submap, keyframe, other, matched_keyframe)) is not None
        ]
        if not found or any(not are_consistent(found[0], other) for other in found[1:]):
            return None
        return found[0]

    def _candidates(self, submap: Submap, keyframe: int) -> Iterator[tuple[Submap, int]]:
        """Keyframes that look like this one but share no points with it, the most similar first, one of each place."""
        slam_map = submap.map
        known = two_hop_covisible(slam_map, keyframe)
        keys, _ = self.keyframe_database.query_by_key(slam_map.key(keyframe))
        taken: list[tuple[Submap, Tensor]] = [(submap, known)]
        for key in keys[: 4 * _MAX_CANDIDATES].tolist():
            found = self.atlas.find(key)
            if found is None or len(taken) > _MAX_CANDIDATES:
                continue
            other, matched_keyframe = found
            if any(other is one and bool((near == matched_keyframe).any()) for one, near in taken):
                continue
            taken.append((other, neighborhood(other.map, matched_keyframe)))
            yield other, matched_keyframe

    def _relation(
        self, submap: Submap, keyframe: int, other: Submap, matched_keyframe: int
    ) -> RelativeSim3 | None:
        """The Sim(3) of a candidate, if covisible keyframes confirm it and drift can explain it; else None."""
        relation = self.estimator.estimate(submap.map, keyframe, other.map, matched_keyframe)
        if relation is None:
            return None
        if submap is other and not is_plausible_drift(submap, keyframe, matched_keyframe, relation):
            return None
        near = neighborhood(other.map, matched_keyframe)
        covisible = submap.map.covisible_keyframes(keyframe, _NUM_VERIFYING)
        sure = sum(
            self.estimator.verify(relation, submap.map, one, other.map, near) for one in covisible.tolist()
        )
        return relation if sure >= _MIN_VERIFYING else None


def two_hop_covisible(slam_map: Map, keyframe: int) -> Int[Tensor, " R"]:
    """Return a keyframe, those that share points with it, and those that share many with the first of these."""
    near = slam_map.covisible_keyframes(keyframe, slam_map.num_keyframes, min_shared=1)
    further = slam_map.covisibility_union(near[:_AROUND], _AROUND)
    return torch.unique(torch.cat([near.new_tensor([keyframe]), near, further]))


def is_plausible_drift(submap: Submap, keyframe: int, matched_keyframe: int, relation: RelativeSim3) -> bool:
    """Whether drift along the path between two keyframes can explain the Sim(3) of a loop.

    The Sim(3) between places that only look alike is mostly larger. The path is that of the keyframes between the two,
    in temporal order.
    """
    slam_map = submap.map
    order = torch.argsort(slam_map.keys)
    rank = torch.argsort(order)
    start, end = sorted((int(rank[matched_keyframe]), int(rank[keyframe])))
    centers_w = se3_inverse(slam_map.T_cw[order[start : end + 1]])[:, :3, 3]
    length = float(torch.linalg.vector_norm(centers_w.diff(dim=0), dim=-1).sum())
    here = se3_inverse(slam_map.T_cw[keyframe])[:3, 3]
    S = relation.S_21
    scale = float(sim3_scale(S))
    moved = float(torch.linalg.vector_norm(S[:3, :3] @ here + S[:3, 3] - here))
    turned = float(torch.rad2deg(rotation_angle(S[:3, :3] / scale)))
    return (
        moved <= _MAX_DRIFT * length
        and turned <= _MAX_DRIFT_DEG
        and 1 / _MAX_DRIFT_SCALE <= scale <= _MAX_DRIFT_SCALE
    )


def are_consistent(one: LoopCandidate, other: LoopCandidate) -> bool:
    """Whether two candidates of one keyframe imply the same Sim(3); always true for different submaps."""
    target = one.matched_submap.map
    if one.matched_submap is not other.matched_submap:
        return True
    S, Z = one.relation.S_21, other.relation.S_21
    scale, second = sim3_scale(S), sim3_scale(Z)
    turned = torch.rad2deg(rotation_angle(S[:3, :3] / scale @ (Z[:3, :3] / second).mT))
    camera_1 = se3_inverse(one.submap.map.T_cw[one.keyframe])[:3, 3]
    apart = torch.linalg.vector_norm((S - Z)[:3, :3] @ camera_1 + (S - Z)[:3, 3])
    observed = target.observed_points(target.index_tensor(one.matched_keyframe))
    T_cw = target.T_cw[one.matched_keyframe]
    depth = (target.positions_w[observed] @ T_cw[2, :3] + T_cw[2, 3]).median()
    ratio = float(scale / second)
    return (
        1 / _SAME_SCALE < ratio < _SAME_SCALE
        and float(turned) < _SAME_DEG
        and float(apart) < _SAME_SHARE * float(depth)
    )
