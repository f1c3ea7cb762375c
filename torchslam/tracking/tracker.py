"""Frame-to-map tracking: predict the pose, match the local map, estimate the pose, update the tracking state."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor

from torchslam.config import Config
from torchslam.geometry import (
    Camera,
    se3_inverse,
)
from torchslam.geometry.transforms import reorthonormalized
from torchslam.map.atlas import Submap, TrackingState
from torchslam.map.map import Map
from torchslam.tracking.correspondences import match_near, match_points
from torchslam.tracking.localizer import Localizer
from torchslam.tracking.matcher import Matcher, MatchIndices, make_matcher
from torchslam.types import FrameFeatures, PoseEstimate

EMA_RATE = 0.1
"""Weight of the newest frame in the moving averages of the tracking state."""


class Tracker:
    """Follows the camera against the local map: the keyframes around the reference keyframe and their points.

    It keeps nothing itself: where the camera was is the track of the world.

    counts: whether points remember when and how often they were seen; without it, tracking leaves the map as it is
    """

    def __init__(self, camera: Camera, config: Config, matcher: Matcher | None = None) -> None:
        self.localizer = Localizer(camera, config)
        self.matcher = make_matcher(config.matching, matcher)
        self.settings = config.tracking
        self.matching = config.matching
        self.counts = True

    def set_counting(self, counts: bool) -> None:
        """Choose whether observations are counted in the map; without it, tracking does not change the map."""
        self.counts = counts

    # --- the track -------------------------------------------------------------------------------------------

    def reset_to_keyframe(self, submap: Submap, keyframe: int) -> None:
        """Go on from a keyframe: the last frame is at its place."""
        T_cw = submap.map.T_cw[keyframe]
        seen = submap.map.keyframes["point_ids"][keyframe]
        submap.tracking = replace(
            self._at_keyframe(submap.map, keyframe, T_cw),
            velocity=submap.tracking.velocity,
            last_inlier_points=seen[seen >= 0],
            error=submap.tracking.error,
            explained_ratio=submap.tracking.explained_ratio,
        )

    def _at_keyframe(self, slam_map: Map, keyframe: int, T_cw: Tensor) -> TrackingState:
        """A track that is at T_cw, seen from this keyframe; what is around the keyframe is the local map."""
        local_keyframes = self.localizer.local_keyframes(slam_map, keyframe)
        recent = self.settings.recent_frames if self.counts else 0
        if recent:
            last_seen = slam_map.points["last_seen_frame"]
            local_points = torch.nonzero(
                (last_seen > last_seen.max() - recent) & slam_map.points["is_valid"]
            )[:, 0]
        else:
            local_points = slam_map.points_seen_by(local_keyframes)
        return TrackingState(
            T_cr=T_cw @ se3_inverse(slam_map.T_cw[keyframe]),
            reference=keyframe,
            reference_size=well_observed(slam_map, keyframe, local_keyframes),
            velocity=None,
            last_inlier_points=local_points[:0],
            local_keyframes=local_keyframes,
            local_points=local_points,
        )

    def predict(self, submap: Submap) -> Tensor:
        """(4, 4) where the next frame should be: constant velocity."""
        if submap.tracking.velocity is None or not self.settings.motion_model:
            return submap.T_cw
        return reorthonormalized(submap.tracking.velocity @ submap.T_cw)

    # --- one frame -------------------------------------------------------------------------------------------

    def track(self, submap: Submap, view: FrameFeatures, is_sure: bool = True) -> PoseEstimate | None:
        """Locate the frame that comes after the last one; None when it cannot be located.

        is_sure: the last frames are believed, so that the pose is looked for next to where they lead
        """
        expected = self.predict(submap)
        candidates = self._candidates(submap, view, expected)
        estimate = self.localizer.locate(
            submap.map, view, candidates, submap.tracking.local_points, expected if is_sure else None
        )
        if estimate is None:
            submap.tracking.velocity = None
            return None
        self.update(submap, view, estimate)
        return estimate

    def _candidates(self, submap: Submap, view: FrameFeatures, T_cw: Tensor) -> Iterator[MatchIndices]:
        """Ever wider guesses of who matches whom: near the prediction, in a wider window, anywhere."""
        slam_map, tracking, settings = submap.map, submap.tracking, self.settings
        if settings.guided_matching:
            alive = tracking.last_inlier_points[slam_map.points["is_valid"][tracking.last_inlier_points]]
            near = self.localizer.project(slam_map, alive, T_cw, view)
            yield match_near(slam_map, near, view, settings.search_radius_px, self.matcher, ratio=0.9)
            local = self.localizer.project(slam_map, tracking.local_points, T_cw, view)
            wide = settings.search_radius_px * settings.wide_radius_factor
            yield match_near(slam_map, local, view, wide, self.matcher, ratio=0.9)
        else:
            local = self.localizer.project(slam_map, tracking.local_points, T_cw, view)
        yield match_points(slam_map, local.ids, view, self.matching)
        yield match_points(slam_map, tracking.local_points, view, self.matching)

    def update(self, submap: Submap, view: FrameFeatures, estimate: PoseEstimate) -> None:
        """Take a frame over into the track: velocity, reference keyframe, counters of the points."""
        slam_map, tracking = submap.map, submap.tracking
        tracking.velocity = estimate.T_cw @ se3_inverse(submap.T_cw)
        tracking.last_inlier_points = estimate.point_ids
        tracking.error += EMA_RATE * (estimate.error - tracking.error)
        tracking.explained_ratio += EMA_RATE * (estimate.explained_ratio - tracking.explained_ratio)
        self._update_last_seen(slam_map, view, estimate)
        shared = slam_map.observers(estimate.point_ids, tracking.local_keyframes)
        best = int(tracking.local_keyframes[shared.argmax()])
        if best == tracking.reference:
            tracking.T_cr = estimate.T_cw @ se3_inverse(slam_map.T_cw[best])
        else:
            submap.tracking = replace(
                self._at_keyframe(slam_map, best, estimate.T_cw),
                velocity=tracking.velocity,
                last_inlier_points=tracking.last_inlier_points,
                error=tracking.error,
                explained_ratio=tracking.explained_ratio,
            )

    def start_at_estimate(self, submap: Submap, view: FrameFeatures, estimate: PoseEstimate) -> None:
        """Begin a track anew, wherever in the map: at a frame that was located without one."""
        best = int(submap.map.observers(estimate.point_ids).argmax())
        self._update_last_seen(submap.map, view, estimate)
        submap.tracking = replace(
            self._at_keyframe(submap.map, best, estimate.T_cw),
            velocity=None,
            last_inlier_points=estimate.point_ids,
        )

    def count_visible(self, slam_map: Map, estimate: PoseEstimate) -> None:
        """A frame is believed: the points that it should see were there to be seen."""
        if self.counts:
            expected = estimate.point_ids if estimate.expected is None else estimate.expected
            slam_map.points["times_visible"][expected] += 1

    def count_found(self, slam_map: Map, estimate: PoseEstimate) -> None:
        """A frame is believed: it speaks for the points that it saw."""
        if self.counts:
            slam_map.points["times_found"][estimate.point_ids] += 1

    def _update_last_seen(self, slam_map: Map, view: FrameFeatures, estimate: PoseEstimate) -> None:
        """The points that a frame saw remember when that was."""
        if self.counts:
            slam_map.points["last_seen_frame"][estimate.point_ids] = view.index


def well_observed(slam_map: Map, keyframe: int, local_keyframes: Tensor) -> int:
    """How many points of a keyframe three local keyframes see: what the next frames can be expected to see."""
    table = slam_map.keyframes["point_ids"]
    local = table[local_keyframes].flatten()
    counts = torch.bincount(local[local >= 0], minlength=len(slam_map.points))
    seen = table[keyframe]
    return int((counts[seen[seen >= 0]] >= min(3, len(local_keyframes))).sum())
