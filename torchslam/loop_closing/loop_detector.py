"""Loop detection: candidates from the keyframe database, verified by the Sim(3) between two keyframes.

The keyframes are of different submaps or of both ends of a loop.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchslam.config import Config
from torchslam.geometry import (
    CHI_SQUARE_95,
    SharedCamera,
    estimate_similarity,
    passes_gate,
    se3_inverse,
    sim3_inverse,
    sim3_scale,
    transform,
)
from torchslam.geometry.ransac import samples_needed
from torchslam.geometry.transforms import rotation_angle, without_scale
from torchslam.loop_closing.keyframe_database import KeyframeDatabase
from torchslam.loop_closing.records import LoopClosureRecord, LoopMatches
from torchslam.map.atlas import Atlas, Submap
from torchslam.map.map import Map
from torchslam.optim import POSE_OPTIONS, solve_pose
from torchslam.tracking.localizer import match_projected_points, project_points
from torchslam.tracking.matcher import DescriptorMatcher, run_matcher
from torchslam.types import Matcher

_RADIUS_PX = 8.0
"""Search radius around the projection by a first similarity, pixels; ORB-SLAM's radius there is 7.5 to 10. Tried at
this value only."""
_AROUND = 10
"""Covisible keyframes whose points are searched for in the other map, as many as ORB-SLAM3 takes. Tried at this value
only."""
_MIN_MATCHES = 40
"""Points of the other map that a keyframe must observe where the Sim(3) predicts them; half as many in the other
direction, and by another keyframe. Tried at this value only."""
_MIN_SHARED = 20
"""Points that both maps must have, whose depths give the scale. Tried at this value only."""
_NEEDED = 12
"""Inliers of the first similarity, three times its minimal sample and more. Tried at this value only."""
_CONFIDENCE, _MOST_SAMPLES = 0.9999, 3000
"""Probability with which the search finds a similarity with `_NEEDED` inliers, and its bound: with 12 of 100 matches
5,300 would be needed."""
_KERNEL_SCALE = 2.0
"""Scale of the Cauchy kernel of the refined pose, standard deviations of the noise. Tried at this value only."""
_ITERATIONS = 20
"""Iterations of the refined pose, which rarely needs ten."""
_GATE_WIDENING = 2.0
"""Factor on the noise in the gate of matches, as the Sim(3) has noise of its own. Tried at this value only."""
_KNOWN_KEYFRAMES = 20
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

    S_21 is the Sim(3) from the submap, at the keyframe, to the matched submap; `matches` measured it.
    """

    submap: Submap
    keyframe: int
    matched_submap: Submap
    matched_keyframe: int
    S_21: Float[Tensor, "4 4"]
    matches: LoopMatches | None = None

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


class LoopDetector:
    """Detects whether a new keyframe shows a known place, by the Sim(3) to a keyframe of it.

    The two keyframes may be of one map: then the Sim(3) is the drift of a loop. `matcher`: of two keyframes, by
    descriptors if None.
    """

    def __init__(
        self,
        camera: SharedCamera,
        config: Config,
        atlas: Atlas,
        database: KeyframeDatabase,
        matcher: Matcher | None = None,
    ) -> None:
        self.camera, self.config = camera, config
        self.atlas = atlas
        self.keyframe_database = database
        self.guided_matcher = DescriptorMatcher(config.matching)
        self.matcher = matcher or self.guided_matcher

    def detect(self, submap: Submap, keyframe: int) -> LoopCandidate | None:
        """Return the verified candidate of a keyframe; None if there is none or if candidates disagree."""
        found = [
            LoopCandidate(submap, keyframe, other, matched_keyframe, *relation)
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
            taken.append((other, other.map.neighborhood(matched_keyframe, _AROUND)))
            yield other, matched_keyframe

    def _relation(
        self, submap: Submap, keyframe: int, other: Submap, matched_keyframe: int
    ) -> tuple[Float[Tensor, "4 4"], LoopMatches] | None:
        """The Sim(3) of a candidate, if covisible keyframes confirm it and drift can explain it; else None."""
        found = self.estimate(submap.map, keyframe, other.map, matched_keyframe)
        if found is None:
            return None
        S_21 = found[0]
        if submap is other and not is_plausible_drift(submap, keyframe, matched_keyframe, S_21):
            return None
        near = other.map.neighborhood(matched_keyframe, _AROUND)
        covisible = submap.map.covisible_keyframes(keyframe, _NUM_VERIFYING)
        sure = sum(self.verify(S_21, submap.map, one, other.map, near) for one in covisible.tolist())
        return found if sure >= _MIN_VERIFYING else None

    def estimate(
        self, map_1: Map, keyframe_1: int, map_2: Map, keyframe_2: int
    ) -> tuple[Float[Tensor, "4 4"], LoopMatches] | None:
        """Estimate the Sim(3) S_21 from map 1 to map 2 by a keyframe of each, None if it is not certain; with its
        matches."""
        T_12 = self._first_guess(map_1, keyframe_1, map_2, keyframe_2)
        if T_12 is None:
            return None
        points_2 = map_2.observed_points(map_2.neighborhood(keyframe_2, _AROUND))
        ids, keypoints = self.match(map_2, points_2, T_12, map_1, keyframe_1)
        if len(ids) < _MIN_MATCHES:
            return None
        T_12, agrees = self._refined(map_2, ids, T_12, map_1, keyframe_1, keypoints)
        ids, keypoints = ids[agrees], keypoints[agrees]
        own = map_1.keyframes["point_ids"][keyframe_1][keypoints]
        is_shared = own >= 0
        if len(ids) < _MIN_MATCHES or int(is_shared.sum()) < _MIN_SHARED:
            return None
        # One pose has no scale, but the depths of points that both maps have do.
        T_11 = map_1.T_cw[keyframe_1]
        points_1 = transform(T_11, map_1.positions_w[own[is_shared]])
        depth_2 = transform(T_12, map_2.positions_w[ids[is_shared]])[:, 2]
        S_2c = se3_inverse(T_12)
        S_2c[:, :3] *= (depth_2 / points_1[:, 2]).median()
        S_21 = S_2c @ T_11
        around_1 = map_1.observed_points(map_1.neighborhood(keyframe_1, _AROUND))
        T_22 = map_2.T_cw[keyframe_2]
        back, _ = self.match_inliers(map_1, around_1, without_scale(T_22 @ S_21), map_2, keyframe_2)
        if len(back) < _MIN_MATCHES // 2:
            return None
        rows = keypoints[is_shared]
        pixels = map_1.frame_features(keyframe_1).keypoints[rows]
        return S_21, LoopMatches(rows, pixels, points_1, transform(T_22, map_2.positions_w[ids[is_shared]]))

    def verify(
        self, S_21: Float[Tensor, "4 4"], map_1: Map, other: int, map_2: Map, near_2: Int[Tensor, " K"]
    ) -> bool:
        """Whether another keyframe of map 1 observes points of keyframes of map 2 where the Sim(3) predicts them."""
        T_o2 = without_scale(map_1.T_cw[other] @ sim3_inverse(S_21))
        ids, _ = self.match_inliers(map_2, map_2.observed_points(near_2), T_o2, map_1, other)
        return len(ids) >= _MIN_MATCHES // 2

    def match(
        self,
        slam_map: Map,
        point_ids: Int[Tensor, " N"],
        T_cw: Float[Tensor, "4 4"],
        other: Map,
        keyframe: int,
    ) -> tuple[Int[Tensor, " M"], Int[Tensor, " M"]]:
        """Match points of a map to the keypoints of another map's keyframe, whose pose in this map is T_cw."""
        view = other.frame_features(keyframe)
        near = project_points(slam_map, point_ids, T_cw, self.camera.current, view.scale_range)
        pairs = match_projected_points(slam_map, near, view, _RADIUS_PX, self.guided_matcher)
        return pairs.first, pairs.second

    def match_inliers(
        self,
        slam_map: Map,
        point_ids: Int[Tensor, " N"],
        T_cw: Float[Tensor, "4 4"],
        other: Map,
        keyframe: int,
    ) -> tuple[Int[Tensor, " M"], Int[Tensor, " M"]]:
        """Return the matches of `match` that pass a gate widened for the noise of the Sim(3)."""
        ids, keypoints = self.match(slam_map, point_ids, T_cw, other, keyframe)
        view = other.frame_features(keyframe)
        points_c = transform(T_cw, slam_map.positions_w[ids])
        errors = view.noise[keypoints].squared_reprojection(
            points_c, view.keypoints[keypoints], self.camera.current
        )
        good = passes_gate(errors, _GATE_WIDENING**2 * CHI_SQUARE_95)
        return ids[good], keypoints[good]

    def _first_guess(
        self, map_1: Map, keyframe_1: int, map_2: Map, keyframe_2: int
    ) -> Float[Tensor, "4 4"] | None:
        """The pose of keyframe 1 in map 2, from points that both keyframes observe; None if there is none."""
        view_1, view_2 = map_1.frame_features(keyframe_1), map_2.frame_features(keyframe_2)
        points_1 = map_1.keyframes["point_ids"][keyframe_1]
        points_2 = map_2.keyframes["point_ids"][keyframe_2]
        pairs = run_matcher(
            self.matcher,
            replace(view_1, mask=view_1.mask & (points_1 >= 0)),
            replace(view_2, mask=view_2.mask & (points_2 >= 0)),
        )
        rows_1, rows_2 = pairs.first, pairs.second
        if len(rows_1) < _NEEDED:
            return None
        T_1, T_2 = map_1.T_cw[keyframe_1], map_2.T_cw[keyframe_2]
        # With this many samples, a similarity with at least _NEEDED inliers is found if there is one.
        samples = samples_needed(
            torch.tensor([_NEEDED], device="cpu"), torch.tensor([len(rows_1)], device="cpu"), 3, _CONFIDENCE
        )
        found = estimate_similarity(
            transform(T_1, map_1.positions_w[points_1[rows_1]])[None],
            transform(T_2, map_2.positions_w[points_2[rows_2]])[None],
            view_1.keypoints[rows_1][None],
            view_2.keypoints[rows_2][None],
            camera_1=self.camera.current,
            camera_2=self.camera.current,
            sigmas_1=view_1.noise[rows_1].gate_sigma[None],
            sigmas_2=view_2.noise[rows_2].gate_sigma[None],
            seed=self.config.seed,
            confidence=_CONFIDENCE,
            max_samples=min(_MOST_SAMPLES, math.ceil(float(samples))),
        )
        if not bool(found.success[0]) or int(found.inliers[0].sum()) < _NEEDED:
            return None
        return without_scale(sim3_inverse(found.S_21[0]) @ T_2)

    def _refined(
        self,
        slam_map: Map,
        ids: Int[Tensor, " M"],
        T_cw: Float[Tensor, "4 4"],
        other: Map,
        keyframe: int,
        keypoints: Int[Tensor, " M"],
    ) -> tuple[Float[Tensor, "4 4"], Bool[Tensor, " M"]]:
        """The refined pose of another map's keyframe in this map, and which matches are inliers."""
        view, points_w = other.frame_features(keyframe), slam_map.positions_w[ids]
        pixels, noise = view.keypoints[keypoints], view.noise[keypoints]
        refined = solve_pose(
            points_w[None],
            pixels[None],
            T_cw=T_cw[None],
            camera=self.camera.current,
            weights=noise.weights[None],
            options=POSE_OPTIONS.replace(
                kernel="cauchy", scale=_KERNEL_SCALE, iterations=_ITERATIONS, backward="detached"
            ),
        ).T_cw[0]
        return refined, passes_gate(
            noise.squared_reprojection(transform(refined, points_w), pixels, self.camera.current)
        )


def two_hop_covisible(slam_map: Map, keyframe: int) -> Int[Tensor, " R"]:
    """Return a keyframe, those that share points with it, and those that share many with the first of these."""
    near = slam_map.covisible_keyframes(keyframe, slam_map.num_keyframes, min_shared=1)
    further = slam_map.covisibility_union(near[:_KNOWN_KEYFRAMES], _KNOWN_KEYFRAMES)
    return torch.unique(torch.cat([near.new_tensor([keyframe]), near, further]))


def is_plausible_drift(submap: Submap, keyframe: int, matched_keyframe: int, S: Float[Tensor, "4 4"]) -> bool:
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
    S, Z = one.S_21, other.S_21
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
