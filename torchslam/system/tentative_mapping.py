"""Keyframes on trial: the map grows while the camera's place is uncertain, and is as it was if the camera is lost."""

from __future__ import annotations

from dataclasses import replace

from torchslam.map.snapshot import MapSnapshot
from torchslam.map.submap import Submap
from torchslam.map.tracking_state import TrackingState
from torchslam.mapping.keyframe_policy import why_keyframe
from torchslam.system.context import SystemContext
from torchslam.system.local_mapping import LocalMapping
from torchslam.types import FrameFeatures, PoseEstimate


class TentativeMapping:
    """Maps frames that are held back: without new points a camera that moves on would be lost before it is certain.

    No place is recognised by keyframes on trial, and their points do not grow old.
    """

    def __init__(self, parts: SystemContext, mapping: LocalMapping) -> None:
        self.parts, self.mapping = parts, mapping
        self._before: tuple[MapSnapshot, TrackingState] | None = None  # the world without keyframes on trial

    def __bool__(self) -> bool:
        """Whether there are keyframes on trial."""
        return self._before is not None

    def take(self, world: Submap, view: FrameFeatures, tracked: PoseEstimate) -> None:
        """Make a keyframe of a frame that is held back, if one is due."""
        parts = self.parts
        if not parts.session.mapping or not why_keyframe(view, tracked, world, parts.config.keyframes):
            return
        if self._before is None:
            self.mapping.take_over(world)
            self._before = MapSnapshot.of(world.map), replace(world.track)
        keyframe = parts.mapper.insert(world.map, view, tracked)
        parts.tracker.follow(world, keyframe)

    def keep(self, world: Submap) -> None:
        """The keyframes stay, and their places may be recognised."""
        if self._before is not None:
            (before, _), self._before = self._before, None
            for keyframe in range(before.num_keyframes, world.map.num_keyframes):
                self.parts.memory.add(world.map, keyframe)

    def take_back(self, world: Submap) -> None:
        """The camera is lost: nothing is left of what was mapped on trial."""
        if self._before is not None:
            (before, world.track), self._before = self._before, None
            before.return_to(world.map)
