"""Mapping of posed frames: keyframes of confirmed poses, of tentative ones, and of frames tracked backward in time."""

from __future__ import annotations

from dataclasses import replace

import torch

from torchslam.map.atlas import Submap, TrackingState
from torchslam.map.map import MapSnapshot, key_of
from torchslam.mapping.local_bundle import ApplyAt
from torchslam.mapping.mapper import keyframe_reason
from torchslam.system.session import SystemContext
from torchslam.tracking.backward_tracking import (
    GapLink,
    UnposedFrames,
    track_back,
    track_into_earlier_keyframe,
)
from torchslam.tracking.pose_validation import PendingFrame
from torchslam.types import Explanation, FrameFeatures, PoseEstimate


class LocalMapping:
    """Adds confirmed frames to a submap, inserts keyframes, and applies the local bundle adjustments around them."""

    def __init__(self, context: SystemContext) -> None:
        self.context, self.adjustment = context, context.mapper.adjustment

    def add_frame(
        self,
        submap: Submap,
        view: FrameFeatures,
        estimate: PoseEstimate,
        apply_at: ApplyAt = ApplyAt.NOW,
    ) -> Explanation | None:
        """Add a frame with a confirmed pose; return why it became a keyframe, or None.

        While an adjustment is pending there is no other keyframe: it is applied after this frame instead.
        """
        context = self.context
        context.tracker.count_visible(submap.map, estimate)
        reason = None
        if context.session.mapping:
            reason = keyframe_reason(view, estimate, submap, context.config.keyframes)
        if reason and self.adjustment.is_pending:
            self.adjustment.set_deadline(view.index)
            reason = None
        if reason:
            keyframe = context.mapper.insert(submap.map, view, estimate, apply_at)
            context.loop_closer.add(submap.map, keyframe)
            context.tracker.reset_to_keyframe(submap, keyframe)
        context.tracker.count_found(submap.map, estimate)
        submap.posed_frames.add(view, estimate, submap.tracking.T_cr, submap.tracking.reference)
        return reason

    def add_pending_frames(self, submap: Submap, frames: list[PendingFrame]) -> None:
        """Add frames whose poses were confirmed by later ones."""
        for view, estimate, T_cr, reference in frames:
            self.context.tracker.count_visible(submap.map, estimate)
            self.context.tracker.count_found(submap.map, estimate)
            submap.posed_frames.add(view, estimate, T_cr, reference)

    def start_adjustment(self) -> None:
        """Start the pending adjustment: the frame that requested it took long enough without it."""
        if self.adjustment.is_pending:
            with self.context.clock("bundle"):
                self.adjustment.start()

    def apply_adjustment_before_frame(self, submap: Submap) -> bool:
        """Apply an adjustment that is due before the next frame; return whether there was one."""
        if not self.adjustment.is_due_before_next_frame:
            return False
        self.context.mapper.apply_adjustment(submap.map)
        self.context.tracker.reset_to_keyframe(submap, submap.map.num_keyframes - 1)
        return True

    def apply_adjustment(self, submap: Submap, frame: int | None = None) -> bool:
        """Apply the pending adjustment if it is due after a frame, or at once if `frame` is None; return whether."""
        if not self.adjustment.is_pending or (frame is not None and not self.adjustment.is_due(frame)):
            return False
        self.context.mapper.apply_adjustment(submap.map)
        return True


class TentativeMapping:
    """Inserts keyframes of frames with unconfirmed poses, so that the map can be rolled back if the camera is lost.

    Without new points a moving camera would be lost before its pose is confirmed. Tentative keyframes are not in the
    keyframe database, and their points are not culled.
    """

    def __init__(self, context: SystemContext, mapping: LocalMapping) -> None:
        self.context, self.mapping = context, mapping
        self._before: tuple[MapSnapshot, TrackingState] | None = None

    @property
    def has_keyframes(self) -> bool:
        """Whether there are tentative keyframes."""
        return self._before is not None

    def add_keyframe(self, submap: Submap, view: FrameFeatures, estimate: PoseEstimate) -> None:
        """Insert a frame as a tentative keyframe, if one is due."""
        context = self.context
        if not context.session.mapping or not keyframe_reason(
            view, estimate, submap, context.config.keyframes
        ):
            return
        if self._before is None:
            self.mapping.apply_adjustment(submap)
            self._before = MapSnapshot.of(submap.map), replace(submap.tracking)
        keyframe = context.mapper.insert(submap.map, view, estimate)
        context.tracker.reset_to_keyframe(submap, keyframe)

    def commit(self, submap: Submap) -> int:
        """Keep the tentative keyframes and add them to the keyframe database; return their number."""
        if self._before is None:
            return 0
        (before, _), self._before = self._before, None
        for keyframe in range(before.num_keyframes, submap.map.num_keyframes):
            self.context.loop_closer.add(submap.map, keyframe)
        return submap.map.num_keyframes - before.num_keyframes

    def rollback(self, submap: Submap) -> None:
        """Restore map and tracking state from before the first tentative keyframe."""
        if self._before is not None:
            (before, submap.tracking), self._before = self._before, None
            before.restore(submap.map)


class BackwardTracking:
    """Keeps frames without a pose, and poses them by tracking backward in time once there is a map.

    Attributes:
        gap_link: The motion between the earliest frame that was posed last and the keyframe before; None if unknown.
    """

    def __init__(self, context: SystemContext, mapping: LocalMapping) -> None:
        self.context, self.mapping = context, mapping
        self.tentative = TentativeMapping(context, mapping)
        self.unposed = UnposedFrames(context.config.initialization.max_unposed_frames)
        self.gap_link: GapLink | None = None

    def from_first_keyframe(self, submap: Submap) -> list[FrameFeatures]:
        """Pose the frames from before the first keyframe of a submap; return those that got a pose."""
        backward = submap.fork()
        self.context.tracker.reset_to_keyframe(backward, 0)
        return self._track(backward, before=int(submap.map.keyframes["frame_index"][0]))

    def from_frame(self, submap: Submap, view: FrameFeatures, estimate: PoseEstimate) -> None:
        """Pose the frames from before a relocalized frame."""
        backward = submap.fork()
        self.context.tracker.start_at_estimate(backward, view, estimate)
        self._track(backward, before=view.index)

    def _track(self, backward: Submap, before: int) -> list[FrameFeatures]:
        context = self.context
        with context.clock("backwards"):
            earlier = [view for view in self.unposed if view.index < before]
            posed = track_back(context.tracker, backward, reversed(earlier), context.config, self)
            first = min([before, *(view.index for view in posed)])
            key = int(
                key_of(torch.tensor(context.session.number, device="cpu"), torch.tensor(first, device="cpu"))
            )
            self.gap_link = track_into_earlier_keyframe(
                context.tracker, backward, context.session.atlas, key, context.config
            )
        self.unposed.remove(posed)
        return posed

    def pop_gap_link(self) -> GapLink | None:
        """Return and forget the motion over the last gap."""
        link, self.gap_link = self.gap_link, None
        return link

    def add_frame(self, submap: Submap, view: FrameFeatures, estimate: PoseEstimate) -> None:
        """Add a frame with a confirmed pose."""
        self.mapping.add_frame(submap, view, estimate)

    def add_tentative(self, submap: Submap, view: FrameFeatures, estimate: PoseEstimate) -> bool:
        """Map a frame tentatively, if a keyframe is due; return whether there are tentative keyframes."""
        self.tentative.add_keyframe(submap, view, estimate)
        return self.tentative.has_keyframes

    def commit(self, submap: Submap, frames: list[PendingFrame]) -> None:
        """Keep the tentative keyframes, and add the frames that were held back."""
        self.tentative.commit(submap)
        self.mapping.add_pending_frames(submap, frames)

    def rollback(self, submap: Submap) -> None:
        """Discard the tentative keyframes."""
        self.tentative.rollback(submap)
