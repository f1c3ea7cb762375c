"""The way back in time: frames from before a world was known, or from while it was lost."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol

from torchslam.config import Config
from torchslam.map.atlas import Submap
from torchslam.tracking.pose_confirmation import PendingFrame, PoseConfirmation
from torchslam.tracking.pose_validation import why_strange, why_unsound
from torchslam.tracking.tracker import Tracker
from torchslam.types import FrameFeatures, PoseEstimate

MAX_CONSECUTIVE_FAILURES = 5  # frames in a row without a sound pose that end the way back


class Builder(Protocol):
    """What becomes of the frames on the way."""

    def take(self, submap: Submap, view: FrameFeatures, estimate: PoseEstimate) -> object:
        """A frame is believed."""

    def try_out(self, submap: Submap, view: FrameFeatures, estimate: PoseEstimate) -> bool:
        """A frame is held back: map it on trial if that is due; whether anything is on trial."""

    def keep(self, submap: Submap, held: list[PendingFrame]) -> object:
        """What was held back is believed after all, with what was mapped on trial."""

    def drop(self, submap: Submap) -> object:
        """What was held back is not believed: nothing is left of what was mapped on trial."""


def track_back(
    tracker: Tracker, submap: Submap, views: Iterable[FrameFeatures], config: Config, builder: Builder
) -> list[FrameFeatures]:
    """Follow a camera from the track of `submap` through frames given from the latest to the earliest.

    As forwards, frames that agree with the map but are not what it leads to expect are held back and mapped on trial:
    they are kept where enough certain ones follow, or the way leads to the earliest frame. It ends where several in a
    row have no sound pose; what is held back then is not kept. Returns the frames that are.
    """
    posed: list[FrameFeatures] = []
    probation = PoseConfirmation(config)
    misses = 0
    for view in views:
        expected = None if submap.tracking.velocity is None else tracker.predict(submap)
        estimate = tracker.track(submap, view, is_sure=not probation)
        if estimate is None or why_unsound(estimate, expected, config.pose_validation):
            misses += 1
            if misses == MAX_CONSECUTIVE_FAILURES:
                builder.drop(submap)
                return posed
            continue
        misses = 0
        doubt = why_strange(estimate, submap.tracking, config.pose_validation)
        if not doubt and not probation:
            builder.take(submap, view, estimate)
            posed.append(view)
            continue
        is_mapped = builder.try_out(submap, view, estimate)
        probation.push(view, estimate, submap.tracking, doubt, is_mapped)
        if not probation or probation.is_full:
            posed += probation.views()
            builder.keep(submap, probation.pop_all() if probation else probation.confirm())
    posed += probation.views()
    builder.keep(submap, probation.pop_all())
    return posed
