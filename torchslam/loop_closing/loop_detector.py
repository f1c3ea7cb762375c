"""Is this keyframe where another time, or another world, has been before? Looked for, related, confirmed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from torchslam.config import Config, LoopClosingConfig
from torchslam.geometry import Camera, se3_inverse, sim3_scale
from torchslam.geometry.motion import rotation_angle
from torchslam.loop_closing.keyframe_database import KeyframeDatabase
from torchslam.loop_closing.relative_sim3 import RelativeSim3, confirms, neighbourhood, relate
from torchslam.map.atlas import Atlas
from torchslam.map.map import Map
from torchslam.map.submap import Submap

_AROUND = 20  # keyframes that share most points with the asking one: what they see is no news
_CONFIRMERS = 5  # keyframes beside it that are asked
_SAME_SCALE, _SAME_DEG, _SAME_SHARE = 1.2, 5.0, 0.1  # between two relations that say the same


@dataclass(frozen=True)
class LoopCandidate:
    """A keyframe shows the place of another one.

    world, keyframe: the one that asked; other, place: the one that was recognised, in the same world or another
    relation: of the asking world, where the keyframe is, to the other world
    """

    world: Submap
    keyframe: int
    other: Submap
    place: int
    relation: RelativeSim3

    @property
    def is_loop(self) -> bool:
        """Within one world."""
        return self.world is self.other

    @property
    def recall(self) -> LoopClosureRecord:
        """What remains of it when the map has changed."""
        frame = int(self.world.map.keyframes["frame_index"][self.keyframe])
        place = int(self.other.map.keyframes["frame_index"][self.place])
        return LoopClosureRecord(frame, place, self.world.number, self.other.number)


@dataclass(frozen=True)
class LoopClosureRecord:
    """That a place was recognised, for the record: the frames of the two keyframes and the numbers of their worlds."""

    frame: int
    place: int
    world: int
    other: int


class LoopDetector:
    """Asks for every new keyframe whether its place is known."""

    def __init__(self, camera: Camera, config: Config, worlds: Atlas, places: KeyframeDatabase) -> None:
        self.camera = camera
        self.config = config
        self.worlds = worlds
        self.places = places

    def recognize(self, world: Submap, keyframe: int) -> LoopCandidate | None:
        """The place that a keyframe shows, if it is certain; None where it is new, or where two places might be it."""
        found = [
            LoopCandidate(world, keyframe, other, place, relation)
            for other, place in self._candidates(world, keyframe)
            if (relation := self._relation(world, keyframe, other, place)) is not None
        ]
        if not found or any(not agree(found[0], other) for other in found[1:]):
            return None
        return found[0]

    def _candidates(self, world: Submap, keyframe: int) -> Iterator[tuple[Submap, int]]:
        """Keyframes that look like this one but share nothing with it, the likeliest first, one of each place."""
        slam_map = world.map
        known = two_steps_around(slam_map, keyframe)
        keys, _ = self.places.like(slam_map.key(keyframe))
        taken: list[tuple[Submap, Tensor]] = [(world, known)]
        for key in keys[: 4 * self.config.loop_closing.max_candidates].tolist():
            found = self.worlds.find(key)
            if found is None or len(taken) > self.config.loop_closing.max_candidates:
                continue
            other, place = found
            if any(other is one and bool((near == place).any()) for one, near in taken):
                continue
            taken.append((other, neighbourhood(other.map, place)))
            yield other, place

    def _relation(self, world: Submap, keyframe: int, other: Submap, place: int) -> RelativeSim3 | None:
        """How a keyframe lies to a place, if keyframes beside it confirm that and a drift may be the reason."""
        relation = relate(world.map, keyframe, other.map, place, self.camera, self.config)
        if relation is None:
            return None
        if world is other and not may_have_drifted(
            world, keyframe, place, relation, self.config.loop_closing
        ):
            return None
        near = neighbourhood(other.map, place)
        beside = world.map.covisible(keyframe, _CONFIRMERS)
        sure = sum(
            confirms(relation, world.map, one, other.map, near, self.camera, self.config)
            for one in beside.tolist()
        )
        return relation if sure >= self.config.loop_closing.min_confirming_keyframes else None


def two_steps_around(slam_map: Map, keyframe: int) -> Tensor:
    """(k,) a keyframe, those that share points with it, and those that share many with the first of these."""
    near = slam_map.covisible(keyframe, slam_map.num_keyframes, min_shared=1)
    further = slam_map.around(near[:_AROUND], _AROUND)
    return torch.unique(torch.cat([near.new_tensor([keyframe]), near, further]))


def may_have_drifted(
    world: Submap, keyframe: int, place: int, relation: RelativeSim3, settings: LoopClosingConfig
) -> bool:
    """Whether so long a way can have drifted by what a loop says: places that only look alike lie further apart.

    The way is that of the keyframes between the two, in the order in which they were seen.
    """
    slam_map = world.map
    order = torch.argsort(slam_map.keys)
    rank = torch.argsort(order)
    start, end = sorted((int(rank[place]), int(rank[keyframe])))
    centres_w = se3_inverse(slam_map.T_cw[order[start : end + 1]])[:, :3, 3]
    length = float(torch.linalg.vector_norm(centres_w.diff(dim=0), dim=-1).sum())
    here = se3_inverse(slam_map.T_cw[keyframe])[:3, 3]
    S = relation.S_21
    scale = float(sim3_scale(S))
    moved = float(torch.linalg.vector_norm(S[:3, :3] @ here + S[:3, 3] - here))
    turned = float(torch.rad2deg(rotation_angle(S[:3, :3] / scale)))
    return (
        moved <= settings.max_drift * length
        and turned <= settings.max_drift_deg
        and 1 / settings.max_drift_scale <= scale <= settings.max_drift_scale
    )


def agree(one: LoopCandidate, other: LoopCandidate) -> bool:
    """Whether two recognitions by the same keyframe say the same; of different worlds nothing can be said."""
    if one.other is not other.other:
        return True
    S, Z = one.relation.S_21, other.relation.S_21
    scale, second = sim3_scale(S), sim3_scale(Z)
    turned = torch.rad2deg(rotation_angle(S[:3, :3] / scale @ (Z[:3, :3] / second).mT))
    camera_1 = se3_inverse(one.world.map.T_cw[one.keyframe])[:3, 3]
    apart = torch.linalg.vector_norm((S - Z)[:3, :3] @ camera_1 + (S - Z)[:3, 3])
    seen = one.other.map.points_seen_by(one.other.map.ids(one.place))
    T_cw = one.other.map.T_cw[one.place]
    depth = (one.other.map.positions_w[seen] @ T_cw[2, :3] + T_cw[2, 3]).median()
    ratio = float(scale / second)
    return (
        1 / _SAME_SCALE < ratio < _SAME_SCALE
        and float(turned) < _SAME_DEG
        and float(apart) < _SAME_SHARE * float(depth)
    )
