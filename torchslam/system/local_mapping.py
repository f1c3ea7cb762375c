"""A frame that is believed enters its world; a keyframe grows the map."""

from __future__ import annotations

from torchslam.map.submap import Submap
from torchslam.mapping.keyframe_policy import why_keyframe
from torchslam.system.context import SystemContext
from torchslam.types import FrameFeatures, PoseEstimate


class LocalMapping:
    """Remembers frames and maps keyframes; what is around one may be adjusted while the next frames are tracked."""

    def __init__(self, parts: SystemContext) -> None:
        self.parts, self.adjusting = parts, parts.mapper.adjusting

    def take(
        self, world: Submap, view: FrameFeatures, tracked: PoseEstimate, delay: int | None = None
    ) -> str:
        """Remember a frame that is believed; a keyframe grows the map. Returns why it is one, or nothing.

        delay: frames that are tracked before the adjustment around a keyframe is taken over, or None as in `insert`;
               there is no other keyframe until then
        """
        parts, adjusting = self.parts, self.adjusting
        parts.tracker.expect(world.map, tracked)
        why = why_keyframe(view, tracked, world, parts.config.keyframes) if parts.session.mapping else ""
        if why and adjusting:
            adjusting.set_deadline(view.index)
            why = ""
        if why:
            keyframe = parts.mapper.insert(world.map, view, tracked, delay)
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

    def take_over_first(self, world: Submap) -> bool:
        """Take over what is due before the next frame, from the newest keyframe on; whether there was any."""
        if not self.adjusting.due_before_next_frame:
            return False
        self.parts.mapper.take_over(world.map)
        self.parts.tracker.follow(world, world.map.num_keyframes - 1)
        return True

    def is_due(self, frame: int) -> bool:
        """Whether what was adjusted is taken over with this frame."""
        return self.adjusting.is_due(frame)

    def take_over(self, world: Submap, frame: int | None = None) -> bool:
        """Put the map to where the adjustment around the newest keyframe has it, if it is time; whether it was.

        frame: the one that was tracked; None: before its time, as the map is to change or the world is left
        """
        if not self.adjusting or (frame is not None and not self.is_due(frame)):
            return False
        self.parts.mapper.take_over(world.map)
        return True
