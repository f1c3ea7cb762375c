"""A frame that is believed enters its world; a keyframe grows the map."""

from __future__ import annotations

from torchslam.mapping.keyframes import why_keyframe
from torchslam.stages.parts import Parts
from torchslam.values import Tracked, View
from torchslam.world.world import World


class LocalMapping:
    """Remembers frames and maps keyframes; what is around one may be adjusted while the next frames are tracked."""

    def __init__(self, parts: Parts) -> None:
        self.parts, self.adjusting = parts, parts.mapper.adjusting

    def take(self, world: World, view: View, tracked: Tracked, is_later: bool = False) -> str:
        """Remember a frame that is believed; a keyframe grows the map. Returns why it is one, or nothing.

        is_later: what is around a keyframe is adjusted while the next frames are tracked; there is no other until then
        """
        parts, adjusting = self.parts, self.adjusting
        parts.tracker.expect(world.map, tracked)
        why = why_keyframe(view, tracked, world, parts.config.keyframes) if parts.session.mapping else ""
        if why and adjusting:
            adjusting.hurry(view.index)
            why = ""
        if why:
            keyframe = parts.mapper.insert(world.map, view, tracked, is_later)
            parts.memory.add(world.map, keyframe)
            parts.tracker.follow(world, keyframe)
        parts.tracker.vouch(world.map, tracked)
        world.history.add(view, tracked, world.track.T_cr, world.track.reference)
        return why

    def begin_adjusting(self) -> None:
        """What was asked for with the last frame begins: that one was long enough."""
        if self.adjusting:
            with self.parts.clock("bundle"):
                self.adjusting.begin()

    def is_due(self, frame: int) -> bool:
        """Whether what was adjusted is taken over with this frame."""
        return self.adjusting.is_due(frame)

    def take_over(self, world: World, frame: int, now: bool = False) -> bool:
        """If it is time, put the map to where the adjustment around the newest keyframe has it; whether it was.

        now: before its time: the map is to change, or the world is left
        """
        if now:
            self.adjusting.hurry(frame)
        if not self.is_due(frame):
            return False
        self.parts.mapper.take_over(world.map)
        return True
