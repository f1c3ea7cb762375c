"""A frame that is believed enters its world; a keyframe grows the map, at once or while the next frames are tracked."""

from __future__ import annotations

from torchslam.mapping.keyframes import why_keyframe
from torchslam.stages.parts import Parts
from torchslam.values import Tracked, View
from torchslam.world.world import World


class LocalMapping:
    """Remembers frames and maps keyframes, one at a time."""

    def __init__(self, parts: Parts) -> None:
        self.parts = parts

    @property
    def is_growing(self) -> bool:
        """Whether something is left to be done for the newest keyframe: there is no other one until it is finished."""
        return self.parts.mapper.growth is not None

    def take(self, world: World, view: View, tracked: Tracked, delay: int | None = None) -> str:
        """Remember a frame that is believed; a keyframe grows the map. Returns why it is one, or nothing.

        delay: frames that are tracked before the adjustment around a keyframe is taken over; its points are merged with
               others before the first of them, or, without any, at once. None: all is done at once
        """
        parts = self.parts
        parts.tracker.expect(world.map, tracked)
        why = why_keyframe(view, tracked, world, parts.config.keyframes) if parts.session.mapping else ""
        if why and self.is_growing:
            parts.mapper.hurry(view.index)
            why = ""
        if why:
            keyframe = parts.mapper.insert(world.map, view, tracked, delay or 0)
            if delay is None:
                parts.mapper.finish(world.map)
            elif delay == 0:
                parts.mapper.go_on(world.map)
            parts.memory.add(world.map, keyframe)
            parts.tracker.follow(world, keyframe)
        parts.tracker.vouch(world.map, tracked)
        world.history.add(view, tracked, world.track.T_cr, world.track.reference)
        return why

    def go_on(self, world: World) -> bool:
        """Take the next step for the newest keyframe, before a frame is tracked; whether that was the last one."""
        mapper, growth = self.parts.mapper, self.parts.mapper.growth
        if growth is None or (growth.is_fused and growth.due is not None):
            return False
        mapper.go_on(world.map)
        is_last = growth.due is None and mapper.finish(world.map)
        self.parts.tracker.follow(world, growth.keyframe)
        return is_last

    def is_due(self, frame: int) -> bool:
        """Whether what is left for the newest keyframe is to be done after this frame."""
        return self.parts.mapper.is_due(frame)

    def finish(self, world: World) -> bool:
        """Do all that is left for the newest keyframe: the map is to change. Whether there was anything."""
        return self.parts.mapper.finish(world.map)
