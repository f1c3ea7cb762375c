"""The way back: frames from before a world was known, or from while it was lost, get their poses."""

from __future__ import annotations

from torchslam.map.submap import Submap
from torchslam.system.context import SystemContext
from torchslam.system.local_mapping import LocalMapping
from torchslam.system.tentative_mapping import TentativeMapping
from torchslam.tracking.backward_tracking import track_back
from torchslam.tracking.pose_confirmation import Held
from torchslam.tracking.unposed_frames import UnposedFrames
from torchslam.types import FrameFeatures, PoseEstimate


class TrackingBack:
    """Keeps the frames that wait for a pose, and follows the camera back through them."""

    def __init__(self, parts: SystemContext, mapping: LocalMapping) -> None:
        self.parts, self.mapping = parts, mapping
        self.on_trial = TentativeMapping(parts, mapping)
        self.waiting = UnposedFrames(parts.config.initialization.max_unposed_frames)

    def from_start(self, world: Submap) -> None:
        """Pose the frames from before the first keyframe of a world."""
        behind = world.aside()
        self.parts.tracker.follow(behind, 0)
        self._pose(behind, before=int(world.map.keyframes["frame_index"][0]))

    def from_frame(self, world: Submap, view: FrameFeatures, tracked: PoseEstimate) -> None:
        """Pose the frames that were lost before a frame that was found again."""
        behind = world.aside()
        self.parts.tracker.start_at(behind, view, tracked)
        self._pose(behind, before=view.index)

    def take(self, world: Submap, view: FrameFeatures, tracked: PoseEstimate) -> None:
        """A frame on the way is believed."""
        self.mapping.take(world, view, tracked)

    def try_out(self, world: Submap, view: FrameFeatures, tracked: PoseEstimate) -> bool:
        """A frame on the way is held back; whether anything is mapped on trial."""
        self.on_trial.take(world, view, tracked)
        return bool(self.on_trial)

    def keep(self, world: Submap, held: list[Held]) -> None:
        """What was held back is believed after all."""
        self.on_trial.keep(world)
        for view, tracked, T_cr, reference in held:
            self.parts.tracker.expect(world.map, tracked)
            self.parts.tracker.vouch(world.map, tracked)
            world.history.add(view, tracked, T_cr, reference)

    def drop(self, world: Submap) -> None:
        """What was held back is not believed."""
        self.on_trial.take_back(world)

    def _pose(self, behind: Submap, before: int) -> None:
        """Follow the camera back through the frames that wait from before a frame."""
        parts = self.parts
        with parts.clock("backwards"):
            earlier = [view for view in self.waiting if view.index < before]
            posed = track_back(parts.tracker, behind, reversed(earlier), parts.config, self)
        self.waiting.remove(posed)
