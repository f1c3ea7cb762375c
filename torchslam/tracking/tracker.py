"""Frame-to-map tracking: predict the pose, match the local map, estimate the pose; `commit` updates the state.

Relocalization: PnP by matches with the keyframes that place recognition proposes.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchslam.config import Config
from torchslam.geometry import SharedCamera, se3_inverse, transform
from torchslam.geometry.lie import se3_log
from torchslam.map.atlas import Submap, TrackingState
from torchslam.map.map import Map
from torchslam.tracking import localizer
from torchslam.tracking.data_association import Projected, match_keyframe, match_points
from torchslam.tracking.localizer import Localizer, match_projected_points
from torchslam.tracking.matcher import DescriptorMatcher, make_matcher
from torchslam.tracking.motion_model import deviating_poses, make_motion_model, run_motion_model
from torchslam.tracking.pose_validation import check_pose
from torchslam.types import (
    FrameFeatures,
    Matcher,
    MatchIndices,
    MotionHistory,
    MotionModel,
    PoseEstimate,
    PosePrediction,
)

SEARCH_RADIUS_PX, WIDE_SEARCH = 12.0, 3.0
"""Search radius around a projected point, pixels of the finest pyramid level, and its factor in the second search, made
if the first has too few matches. Tried at these values only."""
SEARCH_SIGMAS = 3.0
"""Standard deviations of a prediction with a covariance within which keypoints are searched for, beside
`REFINE_RADIUS_PX`. Tried at this value only."""
RECENT_FRAMES = 60
"""Frames whose points are matched in place of the local map with `paper.brute_force`, as in the paper's system."""


class Tracker:
    """Tracks the camera against the local map: the keyframes covisible with the reference keyframe, and their points.

    Stateless: the state is `Submap.tracking`, which `track` reads and `commit` updates.

    Attributes:
        counts: Whether observations are counted in the map; without it, tracking does not change the map.
    """

    def __init__(
        self,
        camera: SharedCamera,
        config: Config,
        matcher: Matcher | None = None,
        motion_model: MotionModel | None = None,
    ) -> None:
        self.camera = camera
        self.localizer = Localizer(camera, config)
        self.matcher = make_matcher(config.matching, matcher, features=config.features.kind)
        self.motion_model = make_motion_model(config, motion_model)
        self.brute_force = config.paper.brute_force
        self.matching = config.matching
        self.counts = True

    def for_session(self, mapping: bool) -> Tracker:
        """The same tracker for a session that maps, or that only localizes."""
        tracker = copy.copy(self)
        tracker.counts = mapping
        return tracker

    # --- tracking state -------------------------------------------------------------------------------------------

    def reset_to_keyframe(self, submap: Submap, keyframe: int) -> None:
        """Continue from a keyframe, as if the last frame had its pose."""
        T_cw = submap.map.T_cw[keyframe]
        seen = submap.map.keyframes["point_ids"][keyframe]
        tracking = replace(submap.tracking, last_inlier_points=seen[seen >= 0])
        submap.tracking = self._moved_to(submap.map, keyframe, T_cw, tracking)

    def _moved_to(
        self, slam_map: Map, keyframe: int, T_cw: Float[Tensor, "4 4"], tracking: TrackingState
    ) -> TrackingState:
        """The same state at a pose with another reference keyframe, and its local map."""
        local_keyframes = slam_map.neighborhood(keyframe, localizer.LOCAL_KEYFRAMES)
        if self.brute_force and self.counts:
            last_seen = slam_map.points["last_seen_frame"]
            local_points = torch.nonzero(
                (last_seen > last_seen.max() - RECENT_FRAMES) & slam_map.points["is_valid"]
            )[:, 0]
        else:
            local_points = slam_map.observed_points(local_keyframes)
        return replace(
            tracking,
            T_cr=T_cw @ se3_inverse(slam_map.T_cw[keyframe]),
            reference=keyframe,
            reference_size=well_observed(slam_map, keyframe, local_keyframes),
            local_keyframes=local_keyframes,
            local_points=local_points,
        )

    def predict(self, submap: Submap, timestamp: float) -> PosePrediction:
        """Predicted pose of the next frame, at a time."""
        tracking = submap.tracking
        interval = tracking.seconds_to(timestamp)
        history = MotionHistory(submap.T_cw, tracking.motions, tracking.intervals, interval)
        return run_motion_model(self.motion_model, history)

    # --- one frame -------------------------------------------------------------------------------------------

    def track(
        self,
        submap: Submap,
        view: FrameFeatures,
        prediction: PosePrediction | None = None,
        is_sure: bool = True,
    ) -> PoseEstimate | None:
        """Estimate the pose of the next frame, see `at_middle_row`; None if it cannot be found. Nothing is changed.

        Matches are searched for around `prediction`, that of the motion model if None. If the last poses are certain
        (`is_sure`), a pose near it is tried first.
        """
        prediction = prediction or self.predict(submap, view.timestamp)
        candidates = self._candidates(submap, view, prediction)
        near = prediction.T_cw if is_sure else None
        return self.localizer.locate(submap.map, view, candidates, submap.tracking.local_points, near)

    def at_middle_row(self, submap: Submap, view: FrameFeatures) -> FrameFeatures:
        """The view with keypoints as a global shutter would have seen them, by the last velocity.

        All of them are corrected, as at the median depth of the local map, since it is not known yet what they see.
        Without a readout it is the view itself.
        """
        tracking = submap.tracking
        interval = float(tracking.intervals[-1]) if len(tracking.motions) else 0.0
        if self.camera.model.readout is None or not interval:
            return view
        depths = transform(submap.T_cw, submap.map.positions_w[tracking.local_points])[:, 2]
        depths = depths[depths > 0]
        if len(depths) == 0:
            return view
        velocity = se3_log(tracking.motions[-1]) / interval
        return replace(view, keypoints=self.camera.at_middle_row(view.detected, velocity, depths.median()))

    def _candidates(
        self, submap: Submap, view: FrameFeatures, prediction: PosePrediction
    ) -> Iterator[MatchIndices]:
        """Sets of matches by ever wider search: near the predicted pixels, in a wider window, in the whole image."""
        slam_map, tracking, T_cw = submap.map, submap.tracking, prediction.T_cw
        if not self.brute_force:
            alive = tracking.last_inlier_points[slam_map.points["is_valid"][tracking.last_inlier_points]]
            near = self.localizer.project(slam_map, alive, T_cw, view)
            radius = self._search_radius(slam_map, near, prediction)
            yield match_projected_points(slam_map, near, view, radius, self.matcher)
            local = self.localizer.project(slam_map, tracking.local_points, T_cw, view)
            radius = WIDE_SEARCH * self._search_radius(slam_map, local, prediction)
            yield match_projected_points(slam_map, local, view, radius, self.matcher)
        else:
            local = self.localizer.project(slam_map, tracking.local_points, T_cw, view)
        yield match_points(slam_map, local.ids, view, self.matching)
        yield match_points(slam_map, tracking.local_points, view, self.matching)
        if not isinstance(self.matcher, DescriptorMatcher):  # it may know better, from whole images
            newest = slam_map.num_keyframes - 1
            for keyframe in dict.fromkeys((tracking.reference, newest)):
                yield match_keyframe(slam_map, keyframe, view, self.matcher)

    def _search_radius(
        self, slam_map: Map, projected: Projected, prediction: PosePrediction
    ) -> float | Float[Tensor, " N"]:
        """Search radii around predicted pixels, in pixels of the pyramid level of each point."""
        if prediction.covariance is None:
            return SEARCH_RADIUS_PX
        moved = deviating_poses(prediction.T_cw, prediction.covariance)
        pixels, _ = self.camera.current.project(transform(moved, slam_map.positions_w[projected.ids]))
        std = (pixels - projected.pixels).square().sum((0, 2)).sqrt()
        widest = max(self.camera.current.size)
        radius = localizer.REFINE_RADIUS_PX + SEARCH_SIGMAS * std / projected.scales
        return radius.nan_to_num(widest).clamp_max(widest)

    def commit(self, submap: Submap, view: FrameFeatures, estimate: PoseEstimate | None) -> None:
        """Update the tracking state by a frame: velocity, averages, reference keyframe, `last_seen_frame`.

        Without an estimate the motion is unknown from here on.
        """
        if estimate is None:
            submap.tracking = submap.tracking.without_motion()
            return
        slam_map, motion = submap.map, estimate.T_cw @ se3_inverse(submap.T_cw)
        tracking = replace(
            submap.tracking.averaged_with(estimate).moved(motion, view.timestamp),
            last_inlier_points=estimate.point_ids,
        )
        self._update_last_seen(slam_map, view, estimate)
        shared = slam_map.count_observed(estimate.point_ids, tracking.local_keyframes)
        best = int(tracking.local_keyframes[shared.argmax()])
        if best == tracking.reference:
            submap.tracking = replace(tracking, T_cr=estimate.T_cw @ se3_inverse(slam_map.T_cw[best]))
        else:
            submap.tracking = self._moved_to(slam_map, best, estimate.T_cw, tracking)

    def correct(self, submap: Submap, estimate: PoseEstimate) -> None:
        """Take another estimate of the last frame, in a map that was adjusted since."""
        tracking = submap.tracking
        T_cr = estimate.T_cw @ se3_inverse(submap.map.T_cw[tracking.reference])
        submap.tracking = replace(tracking, T_cr=T_cr, last_inlier_points=estimate.point_ids)

    def start_at_estimate(self, submap: Submap, view: FrameFeatures, estimate: PoseEstimate) -> None:
        """Start the tracking state at a frame that was posed without one."""
        best = int(submap.map.count_observed(estimate.point_ids).argmax())
        self._update_last_seen(submap.map, view, estimate)
        submap.epoch += 1
        tracking = replace(
            TrackingState.empty(estimate.T_cw),
            last_inlier_points=estimate.point_ids,
            timestamp=view.timestamp,
        )
        submap.tracking = self._moved_to(submap.map, best, estimate.T_cw, tracking)

    def count_visible(self, slam_map: Map, estimate: PoseEstimate) -> None:
        """Increment `times_visible` of the points that a frame with a certain pose should observe."""
        if self.counts:
            expected = estimate.point_ids if estimate.expected is None else estimate.expected
            slam_map.points["times_visible"][expected] += 1

    def count_found(self, slam_map: Map, estimate: PoseEstimate) -> None:
        """Increment `times_found` of the points that a frame with a certain pose observes."""
        if self.counts:
            slam_map.points["times_found"][estimate.point_ids] += 1

    def _update_last_seen(self, slam_map: Map, view: FrameFeatures, estimate: PoseEstimate) -> None:
        """Set `last_seen_frame` of the points that a frame observes."""
        if self.counts:
            slam_map.points["last_seen_frame"][estimate.point_ids] = view.index


MAX_CANDIDATES = 3
"""Places that are tried for a frame, the most similar first. Tried at this value only."""

Candidate = tuple[Submap, int]
"""A keyframe that may show the same place: its submap and row."""


class Relocalizer:
    """Poses a frame in a known map without a predicted pose."""

    def __init__(self, tracker: Tracker) -> None:
        self.tracker = tracker

    def locate(
        self, view: FrameFeatures, candidates: Iterable[Candidate]
    ) -> tuple[Submap, PoseEstimate] | None:
        """The first candidate's submap in which the frame has a valid pose, and that pose.

        Candidates that are covisible with one that failed are skipped.
        """
        tried: list[tuple[Submap, Tensor]] = []
        for submap, keyframe in candidates:
            if len(tried) == MAX_CANDIDATES:
                return None
            if any(submap is other and bool((near == keyframe).any()) for other, near in tried):
                continue
            near = submap.map.neighborhood(keyframe, localizer.LOCAL_KEYFRAMES)
            pairs = match_keyframe(submap.map, keyframe, view, self.tracker.matcher)
            points = submap.map.observed_points(near)
            estimate = self.tracker.localizer.locate(submap.map, view, [pairs], points)
            if estimate is not None:
                state = single_frame_state(submap.tracking, estimate)
                if check_pose(estimate, None, state).rejection is None:
                    return submap, estimate
            tried.append((submap, near))
        return None


def single_frame_state(tracking: TrackingState, estimate: PoseEstimate) -> TrackingState:
    """A tracking state whose averages are those of one frame, to validate its pose without the frames before it."""
    return replace(tracking, error=estimate.error, explained_ratio=estimate.explained_ratio)


def well_observed(slam_map: Map, keyframe: int, local_keyframes: Int[Tensor, " K"]) -> int:
    """Number of points of a keyframe that at least three local keyframes observe."""
    table = slam_map.keyframes["point_ids"]
    local = table[local_keyframes].flatten()
    counts = torch.bincount(local[local >= 0], minlength=len(slam_map.points))
    seen = table[keyframe]
    return int((counts[seen[seen >= 0]] >= min(3, len(local_keyframes))).sum())
