"""The way back in time: frames from before a world was known, or from while it was lost."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol

from torchslam.config import Config
from torchslam.map.submap import Submap
from torchslam.tracking.pose_confirmation import Held, PoseConfirmation
from torchslam.tracking.pose_validation import why_strange, why_unsound
from torchslam.tracking.tracker import Tracker
from torchslam.types import FrameFeatures, PoseEstimate

MISSES = 5  # frames in a row without a sound pose that end the way back


class Builder(Protocol):
    """What becomes of the frames on the way."""

    def take(self, world: Submap, view: FrameFeatures, tracked: PoseEstimate) -> object:
        """A frame is believed."""

    def try_out(self, world: Submap, view: FrameFeatures, tracked: PoseEstimate) -> bool:
        """A frame is held back: map it on trial if that is due; whether anything is on trial."""

    def keep(self, world: Submap, held: list[Held]) -> object:
        """What was held back is believed after all, with what was mapped on trial."""

    def drop(self, world: Submap) -> object:
        """What was held back is not believed: nothing is left of what was mapped on trial."""


def track_back(
    tracker: Tracker, world: Submap, views: Iterable[FrameFeatures], config: Config, builder: Builder
) -> list[FrameFeatures]:
    """Follow a camera from the track of `world` through frames given from the latest to the earliest.

    As forwards, frames that agree with the map but are not what it leads to expect are held back and mapped on trial:
    they are kept where enough certain ones follow, or the way leads to the earliest frame. It ends where several in a
    row have no sound pose; what is held back then is not kept. Returns the frames that are.
    """
    posed: list[FrameFeatures] = []
    probation = PoseConfirmation(config)
    misses = 0
    for view in views:
        expected = None if world.track.velocity is None else tracker.predict(world)
        tracked = tracker.track(world, view, is_sure=not probation)
        if tracked is None or why_unsound(tracked, expected, config.pose_validation):
            misses += 1
            if misses == MISSES:
                builder.drop(world)
                return posed
            continue
        misses = 0
        doubt = why_strange(tracked, world.track, config.pose_validation)
        if not doubt and not probation:
            builder.take(world, view, tracked)
            posed.append(view)
            continue
        is_mapped = builder.try_out(world, view, tracked)
        probation.hold(view, tracked, world.track, doubt, is_mapped)
        if not probation or probation.is_full:
            posed += probation.views()
            builder.keep(world, probation.hand_over() if probation else probation.release())
    posed += probation.views()
    builder.keep(world, probation.hand_over())
    return posed
