"""Backward tracking: poses of frames from before the initialization of a map, or from while the camera was lost."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Protocol

import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.config import Config
from torchslam.map.atlas import Atlas, Submap
from torchslam.tracking.pose_validation import (
    PendingFrame,
    PoseConfirmation,
    check_map_agreement,
    check_pose_quality,
)
from torchslam.tracking.tracker import Tracker
from torchslam.types import FrameFeatures, PoseEstimate

MAX_CONSECUTIVE_FAILURES = 5
"""Frames in a row without a plausible pose that end backward tracking."""


class UnposedFrames:
    """The latest frames without a pose, ordered by frame index; at most `limit` of them."""

    def __init__(self, limit: int) -> None:
        self._views: deque[FrameFeatures] = deque(maxlen=limit)

    def __len__(self) -> int:
        return len(self._views)

    def __iter__(self) -> Iterator[FrameFeatures]:
        return iter(self._views)

    def add(self, *views: FrameFeatures) -> None:
        """Add frames, and sort if they are older than the newest one."""
        is_unordered = len(self._views) and views and views[0].index < self._views[-1].index
        self._views.extend(views)
        if is_unordered:
            self._set(sorted(self._views, key=lambda view: view.index))

    def remove(self, views: list[FrameFeatures]) -> None:
        """Remove frames that have a pose now."""
        posed = {view.index for view in views}
        self._set([view for view in self._views if view.index not in posed])

    def restore(self, views: list[FrameFeatures]) -> None:
        """Continue with the frames of an earlier time."""
        self._set(views)

    def _set(self, views: list[FrameFeatures]) -> None:
        self._views.clear()
        self._views.extend(views)


class Builder(Protocol):
    """Receiver of the frames of backward tracking."""

    def add_frame(self, submap: Submap, view: FrameFeatures, estimate: PoseEstimate) -> object:
        """Add a frame with a certain pose."""

    def add_tentative(self, submap: Submap, view: FrameFeatures, estimate: PoseEstimate) -> bool:
        """Map an uncertain frame tentatively, if a keyframe is due; return whether there are tentative keyframes."""

    def commit(self, submap: Submap, frames: list[PendingFrame]) -> object:
        """Keep the tentative keyframes, and add the frames that were held back."""

    def rollback(self, submap: Submap) -> object:
        """Discard the tentative keyframes."""


def track_back(
    tracker: Tracker, submap: Submap, views: Iterable[FrameFeatures], config: Config, builder: Builder
) -> list[FrameFeatures]:
    """Track frames backward in time, starting from the tracking state of `submap`.

    Frames with uncertain poses are held back and mapped tentatively, as forward in time; they are kept if enough
    certain frames follow or the earliest frame is reached. Tracking ends after `MAX_CONSECUTIVE_FAILURES`.

    Args:
        tracker: poses the frames.
        submap: the map, with the tracking state to start from.
        views: from the latest to the earliest.
        config: thresholds of the pose validation and confirmation.
        builder: receives the posed frames.

    Returns:
        The frames that got a pose.
    """
    posed: list[FrameFeatures] = []
    confirmation = PoseConfirmation(config)
    failures = 0
    for view in views:
        predicted = None if submap.tracking.velocity is None else tracker.predict(submap)
        estimate = tracker.track(submap, view, is_sure=not confirmation.is_holding)
        if estimate is None or check_pose_quality(estimate, predicted, config.pose_validation):
            failures += 1
            if failures == MAX_CONSECUTIVE_FAILURES:
                builder.rollback(submap)
                return posed
            continue
        failures = 0
        rejection = check_map_agreement(estimate, submap.tracking, config.pose_validation)
        if rejection is None and not confirmation.is_holding:
            builder.add_frame(submap, view, estimate)
            posed.append(view)
            continue
        is_mapped = builder.add_tentative(submap, view, estimate)
        confirmation.push(view, estimate, submap.tracking, rejection, is_mapped)
        if not confirmation.is_holding or confirmation.is_full:
            posed += confirmation.views()
            frames = confirmation.pop_all() if confirmation.is_holding else confirmation.confirm()
            builder.commit(submap, frames)
    posed += confirmation.views()
    builder.commit(submap, confirmation.pop_all())
    return posed


@dataclass(frozen=True)
class GapLink:
    """The motion over a gap of lost frames, between a keyframe from before it and one from after it.

    Attributes:
        before: key of the keyframe from before the gap.
        after: key of the keyframe from after the gap.
        T_ba: pose of the first camera relative to the second, in the unit of the map after the gap.
    """

    before: int
    after: int
    T_ba: Float[Tensor, "4 4"]


def track_into_earlier_keyframe(
    tracker: Tracker, submap: Submap, atlas: Atlas, before: int, config: Config
) -> GapLink | None:
    """Track one frame further back in time: the last keyframe from before the frames that backward tracking posed.

    Args:
        tracker: poses the keyframe.
        submap: the map, with the tracking state after backward tracking, which is not changed.
        atlas: the submaps with earlier frames of the same session.
        before: key of the earliest frame that was posed.
        config: thresholds of the pose validation.

    Returns:
        The motion; None if no posed frame is near, or if the keyframe is not found in the map.
    """
    earlier = _last_before(atlas, before)
    if earlier is None:
        return None
    other, keyframe = earlier
    state = submap.fork()
    predicted = None if state.tracking.velocity is None else tracker.predict(state)
    estimate = tracker.track(state, other.map.frame_features(keyframe), is_sure=False)
    if estimate is None or check_pose_quality(estimate, predicted, config.pose_validation):
        return None
    reference = submap.map.key(state.tracking.reference)
    return GapLink(other.map.key(keyframe), reference, state.tracking.T_cr)


def _last_before(atlas: Atlas, key: int) -> tuple[Submap, int] | None:
    """The submap of the last posed frame before `key`, and its last keyframe before it; None if there is a long gap."""
    last: tuple[int, Submap] | None = None
    for submap in atlas:
        keys = submap.posed_frames.keys
        keys = keys[(keys < key) & (keys >= key - MAX_CONSECUTIVE_FAILURES)]
        if len(keys) and (last is None or int(keys.max()) > last[0]):
            last = int(keys.max()), submap
    if last is None:
        return None
    keys = last[1].map.keys
    rows = torch.nonzero(keys <= last[0])[:, 0]
    return (last[1], int(rows[keys[rows].argmax()])) if len(rows) else None
