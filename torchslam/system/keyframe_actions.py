"""What the newest keyframe has to do with those before it: loops closed, worlds joined, rows let go of."""

from __future__ import annotations

from torchslam.map.submap import World
from torchslam.system.context import Parts
from torchslam.system.initializing import Beginning
from torchslam.system.local_mapping import LocalMapping


class LoopClosing:
    """Looks back from keyframes. To be called while nobody holds rows of the map but anchors."""

    def __init__(self, parts: Parts, mapping: LocalMapping, beginning: Beginning) -> None:
        self.parts, self.mapping, self.beginning = parts, mapping, beginning

    @property
    def count(self) -> int:
        """How many places were recognised so far."""
        return len(self.parts.memory.recalls)

    def catch_up_first(self, world: World) -> World:
        """As `catch_up`, before a frame is tracked."""
        return self.look_back(world) if self.mapping.take_over_first(world) else world

    def catch_up(self, world: World, frame: int | None = None) -> World:
        """Take over the adjustment around the newest keyframe when it is due after a frame, or, without one, now.

        Then look back from there.
        """
        return self.look_back(world) if self.mapping.take_over(world, frame) else world

    def look_ahead(self, world: World) -> None:
        """Ask whether the newest keyframe's place looks known while the adjustment around it is waited for.

        Nearly always it does not, and nothing is left to be asked in the frame in which the adjustment is taken over.
        """
        memory, keyframe = self.parts.memory, world.map.num_keyframes - 1
        was_asked = memory.looks_known is not None and memory.looks_known[0] == world.map.key(keyframe)
        if self.mapping.adjusting and not was_asked:
            with self.parts.clock("loops"):
                memory.look_ahead(world, keyframe)

    def look_back(self, world: World) -> World:
        """Recognise the newest keyframe's place, and let go of what the map can do without.

        Returns the world that is followed from now on: another one where two were joined.
        """
        recalls = self.count
        world = self._recall(world)
        self._tidy(world)
        if self.count > recalls:
            self.parts.patches.leave()
        return world

    def _recall(self, world: World) -> World:
        """Has the newest keyframe's place been seen before? Then the loop is closed, or two worlds become one."""
        parts, newest = self.parts, world.map.num_keyframes - 1
        with parts.clock("loops"):
            found = parts.memory.recognize(world, newest)
            if found is None:
                return world
            if not found.is_loop:
                self.beginning.settle()
            world, keyframe = parts.memory.take_up(found)
            parts.here.world = world
            parts.tracker.follow(world, keyframe)
            parts.foreign.forget_last()  # its pose was one of the map before
        return world

    def _tidy(self, world: World) -> None:
        """Let go of what the map can do without."""
        keys = world.map.keys
        renumbering = self.parts.mapper.tidy(world)
        if renumbering is not None:
            self.parts.memory.remove(keys[renumbering.keyframes < 0])
            self.parts.patches.renumber(renumbering)
