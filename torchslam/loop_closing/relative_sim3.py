"""Estimate and verify the Sim(3) between two keyframes, of different submaps or of both ends of a loop."""

from __future__ import annotations

import math
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
    rigid,
    se3_inverse,
    sim3_inverse,
    sim3_scale,
    transform,
)
from torchslam.geometry.ransac import samples_needed
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


@dataclass(frozen=True)
class RelativeSim3:
    """Sim(3) between two maps, estimated from a keyframe of each."""

    S_21: Float[Tensor, "4 4"]  # from the frame of map 1 to that of map 2
    inliers_1: int  # points of map 2 that keyframe 1 observes where the Sim(3) predicts them
    inliers_2: int  # points of map 1 that keyframe 2 observes where the Sim(3) predicts them
    shared_points: int  # that keyframe 1 observes and that both maps have: they give the scale


class RelativeSim3Estimator:
    """Estimates and verifies the Sim(3) between two maps, which may be the same: then it is the drift of a loop."""

    def __init__(self, camera: SharedCamera, config: Config, matcher: Matcher | None = None) -> None:
        """Create the estimator; `matcher`: of two keyframes, by descriptors if None."""
        self.camera, self.config = camera, config
        self.guided_matcher = DescriptorMatcher(config.matching)
        self.matcher = matcher or self.guided_matcher

    def estimate(self, map_1: Map, keyframe_1: int, map_2: Map, keyframe_2: int) -> RelativeSim3 | None:
        """Estimate the Sim(3) between two maps from a keyframe of each; None if it is not certain."""
        T_12 = self._first_guess(map_1, keyframe_1, map_2, keyframe_2)
        if T_12 is None:
            return None
        points_2 = map_2.observed_points(neighborhood(map_2, keyframe_2))
        ids, keypoints = self.match(map_2, points_2, T_12, map_1, keyframe_1)
        if len(ids) < _MIN_MATCHES:
            return None
        T_12, agrees = self._refined(map_2, ids, T_12, map_1, keyframe_1, keypoints)
        ids, keypoints = ids[agrees], keypoints[agrees]
        own = map_1.keyframes["point_ids"][keyframe_1][keypoints]
        is_shared = own >= 0
        shared = int(is_shared.sum())
        if len(ids) < _MIN_MATCHES or shared < _MIN_SHARED:
            return None
        # One pose has no scale, but the depths of points that both maps have do.
        T_11 = map_1.T_cw[keyframe_1]
        depth_1 = transform(T_11, map_1.positions_w[own[is_shared]])[:, 2]
        depth_2 = transform(T_12, map_2.positions_w[ids[is_shared]])[:, 2]
        S_2c = se3_inverse(T_12)
        S_2c[:, :3] *= (depth_2 / depth_1).median()
        S_21 = S_2c @ T_11
        points_1 = map_1.observed_points(neighborhood(map_1, keyframe_1))
        T_21 = transfer_pose(map_2.T_cw[keyframe_2], S_21)
        back, _ = self.match_inliers(map_1, points_1, T_21, map_2, keyframe_2)
        if len(back) < _MIN_MATCHES // 2:
            return None
        return RelativeSim3(S_21, len(ids), len(back), shared)

    def verify(
        self, relation: RelativeSim3, map_1: Map, other: int, map_2: Map, near_2: Int[Tensor, " K"]
    ) -> bool:
        """Whether another keyframe of map 1 observes points of keyframes of map 2 where the Sim(3) predicts them."""
        T_o2 = transfer_pose(map_1.T_cw[other], sim3_inverse(relation.S_21))
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
        eye = torch.eye(4, dtype=T_1.dtype, device=T_1.device)
        return transfer_pose(eye, sim3_inverse(found.S_21[0]) @ T_2)

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


def neighborhood(slam_map: Map, keyframe: int, count: int = _AROUND) -> Int[Tensor, " R"]:
    """Return a keyframe and the `count` most covisible ones."""
    near = slam_map.covisible_keyframes(keyframe, count)
    return torch.cat([near.new_tensor([keyframe]), near])


def transfer_pose(T_cw: Float[Tensor, "4 4"], S_wv: Float[Tensor, "4 4"]) -> Float[Tensor, "4 4"]:
    """Return the pose T_cv in world v of a camera at T_cw in world w; S_wv: Sim(3) from v to w.

    The scale is left out, as it has no effect on projections.
    """
    S_cv = T_cw @ S_wv
    scale = sim3_scale(S_cv)
    return rigid(S_cv[:3, :3] / scale, S_cv[:3, 3] / scale)
