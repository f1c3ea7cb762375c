"""The way back: frames from before a world was known, or from while it was lost, get their poses."""

from __future__ import annotations

from torchslam.map.submap import World
from torchslam.system.context import Parts
from torchslam.system.local_mapping import LocalMapping
from torchslam.system.tentative_mapping import OnTrial
from torchslam.tracking.backward_tracking import track_back
from torchslam.tracking.pose_confirmation import Held
from torchslam.tracking.unposed_frames import Waiting
from torchslam.types import Tracked, View


class TrackingBack:
    """Keeps the frames that wait for a pose, and follows the camera back through them."""

    def __init__(self, parts: Parts, mapping: LocalMapping) -> None:
        self.parts, self.mapping = parts, mapping
        self.on_trial = OnTrial(parts, mapping)
        self.waiting = Waiting(parts.config.initialization.max_waiting)

    def from_start(self, world: World) -> None:
        """Pose the frames from before the first keyframe of a world."""
        behind = world.aside()
        self.parts.tracker.follow(behind, 0)
        self._pose(behind, before=int(world.map.keyframes["frame_index"][0]))

    def from_frame(self, world: World, view: View, tracked: Tracked) -> None:
        """Pose the frames that were lost before a frame that was found again."""
        behind = world.aside()
        self.parts.tracker.start_at(behind, view, tracked)
        self._pose(behind, before=view.index)

    def take(self, world: World, view: View, tracked: Tracked) -> None:
        """A frame on the way is believed."""
        self.mapping.take(world, view, tracked)

    def try_out(self, world: World, view: View, tracked: Tracked) -> bool:
        """A frame on the way is held back; whether anything is mapped on trial."""
        self.on_trial.take(world, view, tracked)
        return bool(self.on_trial)

    def keep(self, world: World, held: list[Held]) -> None:
        """What was held back is believed after all."""
        self.on_trial.keep(world)
        for view, tracked, T_cr, reference in held:
            self.parts.tracker.expect(world.map, tracked)
            self.parts.tracker.vouch(world.map, tracked)
            world.history.add(view, tracked, T_cr, reference)

    def drop(self, world: World) -> None:
        """What was held back is not believed."""
        self.on_trial.take_back(world)

    def _pose(self, behind: World, before: int) -> None:
        """Follow the camera back through the frames that wait from before a frame."""
        parts = self.parts
        with parts.clock("backwards"):
            earlier = [view for view in self.waiting if view.index < before]
            posed = track_back(parts.tracker, behind, reversed(earlier), parts.config, self)
        self.waiting.remove(posed)
