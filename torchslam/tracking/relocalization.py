"""Relocalization: PnP by matches with the keyframes that place recognition proposes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

from torch import Tensor

from torchslam.map.atlas import Submap, TrackingState
from torchslam.map.map import Map
from torchslam.tracking.data_association import match_keyframe
from torchslam.tracking.pose_validation import check_pose
from torchslam.tracking.tracker import Tracker
from torchslam.types import FrameFeatures, MatchIndices, PoseEstimate

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
            near = self.tracker.localizer.local_keyframes(submap.map, keyframe)
            estimate = self.tracker.localizer.locate(
                submap.map, view, self._matches(submap.map, keyframe, view), submap.map.observed_points(near)
            )
            if estimate is not None:
                state = single_frame_state(submap.tracking, estimate)
                if check_pose(estimate, None, state).rejection is None:
                    return submap, estimate
            tried.append((submap, near))
        return None

    def _matches(self, slam_map: Map, keyframe: int, view: FrameFeatures) -> Iterator[MatchIndices]:
        yield match_keyframe(slam_map, keyframe, view, self.tracker.matcher)


def single_frame_state(tracking: TrackingState, estimate: PoseEstimate) -> TrackingState:
    """A tracking state whose averages are those of one frame, to validate its pose without the frames before it."""
    return replace(tracking, error=estimate.error, explained_ratio=estimate.explained_ratio)
