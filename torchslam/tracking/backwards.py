"""The way back in time: frames from before a world was known, or from while it was lost."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from torchslam.config import JudgeConfig
from torchslam.tracking.judge import why_doubt
from torchslam.tracking.tracker import Tracker
from torchslam.values import Tracked, View
from torchslam.world.world import World

MISSES = 5  # frames in a row without a pose to be believed that end the way back


def track_back(
    tracker: Tracker,
    world: World,
    views: Iterable[View],
    judge: JudgeConfig,
    take: Callable[[World, View, Tracked], object],
) -> list[View]:
    """Follow a camera from the track of `world` through frames given from the latest to the earliest.

    `take` gets every frame that is believed. Returns these frames; the way ends where several in a row are not.
    """
    posed: list[View] = []
    misses = 0
    for view in views:
        expected = None if world.track.velocity is None else tracker.predict(world)
        tracked = tracker.track(world, view)
        if tracked is None or why_doubt(tracked, expected, world.track, judge):
            misses += 1
            if misses == MISSES:
                break
            continue
        misses = 0
        take(world, view, tracked)
        posed.append(view)
    return posed
