"""Where is a camera that is lost? Matches with keyframes that look alike, by their own descriptors, and PnP."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import torch
from torch import Tensor

from torchslam.config import Config
from torchslam.map.atlas import Submap, TrackingState
from torchslam.map.map import Map
from torchslam.tracking.correspondences import match_keyframe
from torchslam.tracking.matcher import MatchIndices
from torchslam.tracking.pose_validation import why_doubt
from torchslam.tracking.tracker import Tracker
from torchslam.types import FrameFeatures, PoseEstimate

Candidate = tuple[Submap, int]
"""A keyframe, by world and row, that may show the same place."""


class Relocalizer:
    """Poses a frame in a map without knowing where it is."""

    def __init__(self, tracker: Tracker, config: Config) -> None:
        self.tracker = tracker
        self.judge = config.pose_validation
        self.tries = config.relocalization.max_candidates

    def locate(
        self, view: FrameFeatures, candidates: Iterable[Candidate]
    ) -> tuple[Submap, PoseEstimate] | None:
        """The frame's pose against the first of the candidates that give one that is to be believed.

        Candidates beside one that failed are left out: they see the same.
        """
        tried: list[tuple[Submap, Tensor]] = []
        for submap, keyframe in candidates:
            if len(tried) == self.tries:
                return None
            if any(submap is other and bool((near == keyframe).any()) for other, near in tried):
                continue
            near = self._near(submap.map, keyframe)
            estimate = self.tracker.localizer.locate(
                submap.map, view, self._matches(submap.map, keyframe, view), submap.map.points_seen_by(near)
            )
            if estimate is not None and not why_doubt(
                estimate, None, alone(submap.tracking, estimate), self.judge
            ):
                return submap, estimate
            tried.append((submap, near))
        return None

    def _near(self, slam_map: Map, keyframe: int) -> Tensor:
        """(k,) a keyframe and those that share most points with it."""
        near = slam_map.covisible(keyframe, self.tracker.settings.local_keyframes)
        return torch.cat([near.new_tensor([keyframe]), near])

    def _matches(self, slam_map: Map, keyframe: int, view: FrameFeatures) -> Iterator[MatchIndices]:
        yield match_keyframe(slam_map, keyframe, view, self.tracker.matcher)


def alone(tracking: TrackingState, estimate: PoseEstimate) -> TrackingState:
    """What there is to judge a frame by that no others came before: itself."""
    return replace(tracking, error=estimate.error, explained_ratio=estimate.explained_ratio)
