"""The state machine of a session: what happens to a frame in each mode.

INITIALIZING, LOST -> relocalize in a known submap, or initialize a new one (`MapStart`)
all other modes    -> maintain the map, track the frame and judge its pose; then
                      map a certain frame and maintain the map again; hold a doubtful one back until others confirm it;
                      without a pose, go back to the savepoint
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from torchslam.map.atlas import Submap
from torchslam.mapping.local_bundle import LOCAL_WINDOW, ApplyAt
from torchslam.mapping.mapper import MIN_POINTS, remove_masked_observations
from torchslam.system.local_mapping import BackwardTracking, LocalMapping, locate
from torchslam.system.maintenance import Maintenance
from torchslam.system.map_start import MapStart
from torchslam.system.modes import TRANSITIONS
from torchslam.system.savepoint import Savepoint
from torchslam.system.session import SystemContext
from torchslam.tracking.non_static import NO_MOVEMENT, FilteredView
from torchslam.tracking.pose_validation import (
    NUM_CONFIRMING_FRAMES,
    SURE_INLIERS,
    Certainty,
    Verdict,
    check_pose_quality,
)
from torchslam.tracking.tracker import Relocalizer
from torchslam.types import Explanation, FrameFeatures, PoseEstimate, PosePrediction, Reason

FRAMES_BEFORE_NEW_SUBMAP = 20
"""Lost frames before a new submap may be initialized, so that the camera can come back. Tried at this value only."""
NUM_RELOCALIZED_FRAMES = 4
"""Certain frames in a row after a relocalization before mapping resumes. Tried at this value only."""


@dataclass(frozen=True)
class FrameOutcome:
    """Effect of a frame.

    Attributes:
        reasons: Why the frame has no pose, an uncertain one, or became a keyframe.
        submap: The submap in which it has a pose; None without a pose.
        estimate: Pose and inliers; None without a pose, and for a frame that initialized the submap.
        is_keyframe: True if it became a keyframe.
    """

    reasons: Sequence[Reason | Explanation]
    submap: Submap | None = None
    estimate: PoseEstimate | None = None
    is_keyframe: bool = False


class StateMachine:
    """Processes the features of one frame after the other."""

    def __init__(self, context: SystemContext) -> None:
        self.context, self.active_map = context, context.active_map
        keyframes = context.config.keyframes if context.session.mapping else None
        self.mapping = LocalMapping(
            context.tracker, context.mapper, context.loop_closer, context.log, keyframes
        )
        self.backward = BackwardTracking(self.mapping, context.clock)
        self.map_start = MapStart(context, self.backward)
        self.maintenance = Maintenance(context, self.map_start)
        self.relocalizer = Relocalizer(context.tracker)
        self.num_lost = 0  # frames since the camera was lost

    def step(self, filtered: FilteredView) -> FrameOutcome:
        """Track the frame in the active submap, or look for one."""
        before = self.context.mode
        outcome = self._find(filtered.view) if self.active_map.submap is None else self._track(filtered)
        after = self.context.mode
        assert before is after or (before, after) in TRANSITIONS, f"{before.name} -> {after.name}"
        return outcome

    def _track(self, filtered: FilteredView) -> FrameOutcome:
        """Maintain the map, track the frame, and do with it what its pose is good for."""
        self.maintenance.before_frame()
        submap = self.active_map.current
        filtered = self._at_middle_row(submap, filtered)
        view = filtered.view
        with self.context.clock("tracking"):
            located = locate(self.context.tracker, submap, view, is_sure=self.active_map.doubted is None)
        if located is None:
            return self._lose(view)
        estimate, verdict = located
        motion = NO_MOVEMENT
        if verdict.certainty is Certainty.CERTAIN:
            motion = self.context.scene_filter.detect_independent_motion(filtered, estimate, submap.world)
            verdict = Verdict(motion.rejection)
        if verdict.certainty is Certainty.CERTAIN and self.active_map.doubted is None:
            if self.mapping.is_urgent(submap, view, estimate):
                return self._map_at_once(filtered, motion.note)
            return self._map(filtered, estimate, motion.note)
        return self._hold(view, estimate, verdict)

    def _at_middle_row(self, submap: Submap, filtered: FilteredView) -> FilteredView:
        """The frame with the keypoints of a global shutter, by the velocity before it.

        Static overlays are found in the image as it is.
        """
        view = self.context.tracker.at_middle_row(submap, filtered.view)
        without_overlays = replace(filtered.without_overlays, keypoints=view.keypoints)
        return replace(filtered, view=view, without_overlays=without_overlays)

    def confirm_map(self) -> None:
        """Confirm a provisional map as it is, with the frames that are held back."""
        if self.active_map.provisional is not None:
            self._keep_held()
            self.maintenance.after_frame(None)
            self.map_start.confirm()

    def finalize(self) -> None:
        """End the session: frames that are held back keep their poses, uncertain as they are."""
        if self.active_map.submap is not None:
            self.context.online_camera.forget()  # the final adjustment estimates the sensor
            num_new = self._keep_held()
            self.maintenance.after_frame(None)
            self.maintenance.close_loops(num_new)
        self.map_start.confirm()

    # --- with an active submap ---------------------------------------------------------------------------------------

    def _map(
        self, filtered: FilteredView, estimate: PoseEstimate, motion: Explanation | None
    ) -> FrameOutcome:
        """Map a frame with a certain pose.

        Args:
            filtered: The frame.
            estimate: Its pose.
            motion: Note about keypoints that move independently of the scene.
        """
        context, view, active_map = self.context, filtered.view, self.active_map
        reason = self.mapping.add_frame(active_map.current, view, estimate, self._apply_at(estimate))
        has_new_overlay = context.session.mapping and context.scene_filter.update_overlay(
            filtered, active_map.current.T_cw, estimate.depth, active_map.current.world
        )
        at_once = has_new_overlay or self.map_start.is_almost_confirmed
        self.maintenance.after_frame(None if at_once else view.index, is_keyframe=reason is not None)
        if has_new_overlay:
            covers = context.scene_filter.static_overlay.covers
            remove_masked_observations(active_map.current, covers)
        if self.map_start.count_frame(view):
            return FrameOutcome([Reason.STARTED_ANEW], active_map.submap, is_keyframe=True)
        notes = [reason, Reason.STATIC_OVERLAY if has_new_overlay else None, motion]
        reasons = [note for note in notes if note is not None]
        return FrameOutcome(reasons, active_map.submap, estimate, reason is not None)

    def _map_at_once(self, filtered: FilteredView, motion: Explanation | None) -> FrameOutcome:
        """Map a frame that cannot wait for the pending adjustment: that is applied, and the frame posed again."""
        self.maintenance.after_frame(None)
        submap, tracker = self.active_map.current, self.context.tracker
        filtered = self._at_middle_row(submap, filtered)
        prediction = PosePrediction(submap.T_cw)
        estimate = tracker.track(submap, filtered.view, prediction)
        if estimate is None:
            return self._lose(filtered.view)
        tracker.correct(submap, estimate)
        rejection = check_pose_quality(estimate, prediction)
        if rejection is not None:
            return self._hold(filtered.view, estimate, Verdict(rejection))
        return self._map(filtered, estimate, motion)

    def _apply_at(self, estimate: PoseEstimate) -> ApplyAt:
        """When the adjustment around a new keyframe is applied.

        Soon, as long as it moves the whole map, or where so few points are in view that the next frame may have to be a
        keyframe as well.
        """
        is_small = self.active_map.current.map.num_keyframes < LOCAL_WINDOW
        if is_small or self.active_map.provisional is not None or estimate.inliers < MIN_POINTS:
            return ApplyAt.BEFORE_NEXT_FRAME
        return ApplyAt.AFTER_DELAY

    def _hold(self, view: FrameFeatures, estimate: PoseEstimate, verdict: Verdict) -> FrameOutcome:
        """Hold a frame back; enough certain frames in a row confirm all that are held back."""
        active_map = self.active_map
        doubted = active_map.doubted or Savepoint(active_map.current, NUM_CONFIRMING_FRAMES)
        if verdict.certainty is not Certainty.WRONG and _may_extend(doubted, estimate, verdict):
            self.mapping.add_tentative_keyframe(doubted, view, estimate)
        doubted.count(verdict.rejection)
        self.mapping.hold(doubted, view, estimate)
        reasons = [verdict.rejection or doubted.reason] if doubted.is_open else []
        active_map.doubted = doubted
        if doubted.is_full or not doubted.is_open:
            num_new = self._keep_held()
            active_map.doubted = doubted if doubted.is_open else None
            self.maintenance.close_loops(num_new)
        return FrameOutcome(reasons, active_map.current, estimate)

    def _keep_held(self) -> int:
        """Keep the poses of frames that are held back; return the number of keyframes that were tentative."""
        doubted = self.active_map.doubted
        if doubted is None:
            return 0
        num_new = len(doubted.keyframes)
        frames = self.mapping.commit(doubted)
        self.map_start.add_frames(frame.view for frame in frames)
        if frames and doubted.is_relocalized:
            self.backward.from_frame(doubted.submap, frames[0])
        return num_new

    def _lose(self, view: FrameFeatures) -> FrameOutcome:
        """Go back to the savepoints: frames since are unposed again, unless they are many."""
        context, active_map, doubted = self.context, self.active_map, self.active_map.doubted
        if doubted is not None and doubted.is_long:
            self._keep_held()
        elif doubted is not None:
            doubted.rollback()
            context.log.release(doubted.frames)
        active_map.doubted = None
        context.log.unpose(view)
        self.maintenance.after_frame(None)
        is_discarded = self.map_start.end()
        active_map.submap = None
        self.map_start.restart()
        self.num_lost = 0
        return FrameOutcome([Reason.LOST_AT_START if is_discarded else Reason.LOST])

    # --- without one -------------------------------------------------------------------------------------------------

    def _find(self, view: FrameFeatures) -> FrameOutcome:
        """Relocalize the frame, or initialize a new submap with it; after an exception the state is that of before."""
        restore = self._restorer()
        try:
            return self._relocalize_or_initialize(view)
        except BaseException:  # of a user's matcher, or from the keyboard
            restore()
            raise

    def _restorer(self) -> Callable[[], None]:
        """A function that restores what a frame changes before it has a pose."""
        overlay, log = self.context.scene_filter.static_overlay, self.context.log
        evidence, logged, num_lost = overlay.evidence.clone(), log.copy(), self.num_lost
        initializer = copy.copy(self.map_start.initializer)

        def restore() -> None:
            overlay.restore(evidence)
            log.restore(logged)
            self.num_lost, self.map_start.initializer = num_lost, initializer

        return restore

    def _relocalize_or_initialize(self, view: FrameFeatures) -> FrameOutcome:
        context, has_submaps = self.context, len(self.context.session.atlas) > 0
        self.num_lost += 1
        if has_submaps:
            with context.clock("relocalization"):
                found = self.relocalizer.locate(view, context.loop_closer.query(view))
            if found is not None:
                return self._relocalize(view, *found)
        context.log.unpose(view)
        waits = self.num_lost <= FRAMES_BEFORE_NEW_SUBMAP
        if has_submaps and (waits or not context.session.mapping):
            return FrameOutcome([Reason.LOST])
        rejection = self.map_start.step(view)
        if rejection:
            return FrameOutcome([rejection])
        return FrameOutcome([Reason.STARTED], self.active_map.submap, is_keyframe=True)

    def _relocalize(self, view: FrameFeatures, submap: Submap, estimate: PoseEstimate) -> FrameOutcome:
        """Track in the submap from here; the next frames have to confirm the pose."""
        context = self.context
        context.tracker.start_at_estimate(submap, view, estimate)
        doubted = Savepoint(submap, NUM_RELOCALIZED_FRAMES, is_relocalized=True)
        self.mapping.hold(doubted, view, estimate)
        self.active_map.submap, self.active_map.doubted = submap, doubted
        return FrameOutcome([Reason.RELOCALIZED], submap, estimate)


def _may_extend(doubted: Savepoint, estimate: PoseEstimate, verdict: Verdict) -> bool:
    """Whether a frame that is held back may become a tentative keyframe; after a relocalization only a sure one."""
    if doubted.is_relocalized:
        return estimate.inliers >= SURE_INLIERS
    return verdict.certainty is not Certainty.CERTAIN or doubted.has_keyframes
