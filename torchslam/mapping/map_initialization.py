"""The beginning of a world: two views make a map, and the frames between them say whether it is right."""

from __future__ import annotations

from torchslam.map.submap import Submap
from torchslam.mapping.mapper import Mapper
from torchslam.tracking.tracker import Tracker
from torchslam.types import FrameFeatures, TwoViewMap


class MapInitializer:
    """Fills empty worlds."""

    def __init__(self, tracker: Tracker, mapper: Mapper, min_explained: float) -> None:
        self.tracker = tracker
        self.mapper = mapper
        self.min_explained = min_explained  # share of the frames that a new map must explain

    def found(self, world: Submap, start: TwoViewMap, views: list[FrameFeatures]) -> str:
        """Make the first map of two views, pose the frames from one to the other, and go on from the second.

        Returns why the map is not to be believed, in words; empty when it is.
        """
        first, second = self.mapper.start(world.map, start)
        self.tracker.follow(world, first)
        explained = [self._explains(world, view) for view in views]
        self.tracker.follow(world, second)
        if sum(explained) < self.min_explained * len(explained):
            return f"bad start: it explains {sum(explained)} of {len(explained)} frames"
        return ""

    def _explains(self, world: Submap, view: FrameFeatures) -> bool:
        """Pose a frame that was seen before there was a map; whether most of its matches agree with the map."""
        tracked = self.tracker.track(world, view)
        if tracked is None:
            return False
        self.tracker.vouch(world.map, tracked)
        world.history.add(view, tracked, world.track.T_cr, world.track.reference)
        return tracked.inliers > 0.5 * tracked.matches
