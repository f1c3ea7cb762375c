"""Without a world: come back to a known place, or else begin a new world."""

from __future__ import annotations

from torchslam.map.submap import World
from torchslam.system.backward_tracking import TrackingBack
from torchslam.system.context import Outcome, Parts
from torchslam.system.initializing import Beginning
from torchslam.tracking.relocalization import Relocalizer
from torchslam.types import State, Tracked, View

STARTED = "started the map"
FOUND_AGAIN = "found again"


class Finding:
    """Looks for a world to follow; frames wait until there is a pose for them."""

    def __init__(self, parts: Parts, beginning: Beginning, back: TrackingBack) -> None:
        self.parts, self.beginning, self.back = parts, beginning, back
        self.relocalizer = Relocalizer(parts.tracker, parts.config)
        self.lost_for = 0  # frames

    def seek(self) -> None:
        """Nothing is followed any more."""
        parts, here = self.parts, self.parts.here
        here.world = None
        self.beginning.seek()
        parts.probation.release()
        parts.foreign.forget_last()
        self.lost_for = 0
        here.state = State.LOST if len(parts.session.worlds) else State.INITIALIZING

    def find(self, view: View) -> Outcome:
        """Relocalise the frame, or begin a world with it; it waits where that cannot be done."""
        parts = self.parts
        self.lost_for += 1
        if len(parts.session.worlds):
            with parts.clock("relocalization"):
                found = self.relocalizer.locate(view, parts.memory.likely(view))
            if found is not None:
                return self._return(view, *found)
        self.back.waiting.add(view)
        patient = self.lost_for <= parts.config.relocalization.patience or not parts.session.mapping
        if len(parts.session.worlds) and patient:
            return Outcome("lost")
        reason = self.beginning.step(view)
        return Outcome(reason) if reason else Outcome(STARTED, parts.here.world, is_keyframe=True)

    def _return(self, view: View, world: World, tracked: Tracked) -> Outcome:
        """Go on in a world that was recognised; the next frames have to confirm it."""
        parts = self.parts
        parts.tracker.start_at(world, view, tracked)
        parts.here.world, parts.here.state = world, State.UNCERTAIN
        parts.probation.come_back(view, tracked, world.track)
        return Outcome(FOUND_AGAIN, world, tracked)
