"""The state machine of a session: initialize a map, track the camera in it, relocalize when it is lost.

INITIALIZING, LOST    -> `LostState`: relocalize in a known submap, or create a new one (`InitializationState`)
TRACKING, UNCERTAIN   -> `StateMachine.track`: track, validate the pose; map the frame, or hold it back until confirmed
keyframe was adjusted -> `KeyframeActions`: detect and close loops, cull, compact
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from torchslam.loop_closing.loop_detector import LoopCandidate
from torchslam.map.atlas import Submap
from torchslam.mapping.culling import remove_masked_observations
from torchslam.mapping.local_bundle import ApplyAt
from torchslam.mapping.mapper import MapInitializer
from torchslam.system.local_mapping import BackwardTracking, LocalMapping, TentativeMapping
from torchslam.system.session import SystemContext
from torchslam.system.start_check import StartCheck
from torchslam.tracking.initialization import Initializer, ProvisionalMap
from torchslam.tracking.non_static import NO_MOVEMENT
from torchslam.tracking.pose_validation import (
    SURE_INLIERS,
    PendingFrame,
    check_map_agreement,
    check_pose_quality,
)
from torchslam.tracking.relocalization import Relocalizer
from torchslam.types import Explanation, FrameFeatures, PoseEstimate, Reason, Rejection, State, TwoViewMap

_LOOP_STRIDE = 4
"""Of the keyframes that are confirmed together, every so many are checked for a loop: their views overlap."""
_FRAMES_PER_KEYFRAME = 2
"""Frames that a keyframe is worth in the confirmation of a map: views far apart contradict a wrong one sooner."""


@dataclass(frozen=True)
class FrameOutcome:
    """Effect of a frame.

    Attributes:
        reasons: why the frame has no pose, an uncertain one, or became a keyframe.
        submap: the submap in which it has a pose; None without a pose.
        estimate: pose and inliers; None without a pose, and for a frame that initialized the submap.
        is_keyframe: True if it became a keyframe.
    """

    reasons: Sequence[Reason | Explanation]
    submap: Submap | None = None
    estimate: PoseEstimate | None = None
    is_keyframe: bool = False


class InitializationState:
    """Creates submaps from two views.

    Attributes:
        provisional: the active submap, until enough frames were tracked in it to confirm it.
    """

    def __init__(self, context: SystemContext, backward: BackwardTracking, start_check: StartCheck) -> None:
        self.context, self.backward, self.start_check = context, backward, start_check
        self.atlas, self.settings = context.session.atlas, context.config.initialization
        self.map_initializer = MapInitializer(
            context.tracker, context.mapper, self.settings.min_explained_ratio
        )
        self.provisional: ProvisionalMap | None = None
        self.restart()

    def restart(self) -> None:
        """Forget the reference frame, and initialize with the frames from now on."""
        context = self.context
        self.initializer = Initializer(context.camera, context.config, context.matcher)

    def step(self, view: FrameFeatures) -> Rejection | None:
        """Create a submap if the frame and an earlier one determine it; return why not, or None."""
        with self.context.clock("initialization"):
            result = self.initializer.step(view)
            self.context.non_static_filter.static_overlay.add(self.initializer.static_pixels)
            return result if isinstance(result, Rejection) else self._create(result, self.initializer.views)

    def add_confirmed(self, frames: Sequence[PendingFrame]) -> None:
        """Note frames of a provisional map that were held back, and then confirmed."""
        if self.provisional is not None:
            self.provisional.views += [view for view, _, _, _ in frames]

    @property
    def is_almost_confirmed(self) -> bool:
        """Whether one more tracked frame confirms the provisional map."""
        return self.provisional is not None and self.provisional.age + 1 >= self.settings.provisional_frames

    def add_frame(self, view: FrameFeatures) -> bool:
        """Note that a frame was tracked; return whether the provisional map was replaced by another one."""
        if self.provisional is None:
            return False
        self.provisional.add_frame(view)
        if self._replace_if_contradicted(self.provisional):
            return True
        if self.provisional.age >= self.settings.provisional_frames:
            self.confirm_map()
        return False

    def confirm_map(self) -> None:
        """Confirm the provisional map, and pose the frames from before its first keyframe."""
        if self.provisional is None:
            return
        provisional, self.provisional = self.provisional, None
        earlier = self.backward.from_first_keyframe(provisional.submap)
        self.start_check.start(provisional.submap, earlier + provisional.views)

    def on_lost(self) -> bool:
        """Discard a map that is still provisional when the camera is lost; return whether it was."""
        is_discarded = self.provisional is not None and self._is_young(self.provisional)
        if self.provisional is not None and is_discarded:
            self._discard(self.provisional)
        self.confirm_map()
        return is_discarded

    def _is_young(self, provisional: ProvisionalMap) -> bool:
        """Whether a map has too few frames to be kept when the camera is lost; keyframes are worth several."""
        keyframes = provisional.submap.map.num_keyframes
        frames = max(provisional.age, _FRAMES_PER_KEYFRAME * keyframes)
        return frames < self.settings.provisional_frames

    def _create(self, start: TwoViewMap, views: list[FrameFeatures]) -> Rejection | None:
        """Create a submap from two views, and discard a provisional one; return why it is rejected, or None."""
        submap = self.atlas.create()
        try:
            rejection = self.map_initializer.build(submap, start, views)
        except BaseException:  # of a user's matcher, or from the keyboard
            self.atlas.revoke(submap)
            raise
        if rejection:
            self.atlas.remove(submap)
            return rejection
        if self.provisional is not None:
            self._discard(self.provisional)
        for keyframe in range(submap.map.num_keyframes):
            self.context.loop_closer.add(submap.map, keyframe)
        known = set(submap.posed_frames.frames["frame_index"].tolist()) if len(submap.posed_frames) else set()
        posed = [view for view in views if view.index in known]
        self.backward.unposed.remove(posed)
        self.provisional = ProvisionalMap(submap, posed)
        self.context.active_map.activate(submap, State.TRACKING)
        return None

    def _discard(self, provisional: ProvisionalMap) -> None:
        """Remove a submap that later frames contradict; its frames are unposed again."""
        self.backward.unposed.add(*provisional.views)
        self.context.mapper.adjustment.drop()
        self.context.loop_closer.remove(provisional.submap.map.keys)
        self.atlas.remove(provisional.submap)
        self.provisional = None

    def _replace_if_contradicted(self, provisional: ProvisionalMap) -> bool:
        """Initialize from the first and the last frame of a provisional map, if they contradict it."""
        context = self.context
        with context.clock("initialization"):
            start = provisional.find_contradicting_initialization(
                context.camera, context.config, context.matcher
            )
            is_replaced = start is not None and not self._create(start, provisional.views)
        if is_replaced:
            context.non_static_filter.forget_last()  # its pose was one of the discarded map
        return is_replaced


class KeyframeActions:
    """Loop closing, culling and compaction, once the adjustment around a keyframe is applied.

    The methods renumber rows of the active map, and may replace it by the submap it is merged into.
    """

    def __init__(
        self, context: SystemContext, mapping: LocalMapping, initialization: InitializationState
    ) -> None:
        self.context, self.mapping, self.initialization = context, mapping, initialization
        self.active_map = context.active_map

    def apply_adjustment_before_frame(self) -> None:
        """Apply an adjustment that is due before the next frame, then detect and close loops."""
        if self.mapping.apply_adjustment_before_frame(self.active_map.current):
            self.detect_and_close()

    def apply_pending_adjustment(self, frame: int | None = None) -> None:
        """Apply the pending adjustment if it is due after a frame, or at once if None; detect and close loops."""
        if self.mapping.apply_adjustment(self.active_map.current, frame):
            self.detect_and_close()

    def precheck_loop(self) -> None:
        """Look for a loop at the newest keyframe while its adjustment is pending.

        Nearly always there is none, which saves the search in the frame in which the adjustment is applied.
        """
        slam_map, loop_closer = self.active_map.current.map, self.context.loop_closer
        keyframe = slam_map.num_keyframes - 1
        checked = loop_closer.loop_precheck
        was_checked = checked is not None and checked[0] == slam_map.key(keyframe)
        if self.mapping.adjustment.is_pending and not was_checked:
            with self.context.clock("loops"):
                loop_closer.precheck(self.active_map.current, keyframe)

    def detect_and_close(self) -> None:
        """Detect and close a loop at the newest keyframe; cull keyframes and compact the map."""
        self.detect_loop()
        self._cull_and_compact(self.active_map.current)

    def detect_loop(self, count: int = 1) -> None:
        """Close a loop at one of the newest keyframes, or merge two submaps, if its place was seen before.

        Args:
            count: Number of the newest keyframes, of which every `_LOOP_STRIDE`-th is checked until one closes a loop.
        """
        context, submap = self.context, self.active_map.current
        with context.clock("loops"):
            keyframes = torch.argsort(submap.map.keys, descending=True)[:count:_LOOP_STRIDE].tolist()
            detected = (context.loop_closer.detect(submap, keyframe) for keyframe in keyframes)
            found = next((candidate for candidate in detected if candidate is not None), None)
            if found is not None:
                self._close(found)

    def close_gap(self) -> None:
        """Join both sides of a gap of lost frames, once backward tracking has reached the frames from before it."""
        context, link = self.context, self.initialization.backward.pop_gap_link()
        if link is None or not context.session.mapping or self.active_map.submap is None:
            return
        with context.clock("loops"):
            found = context.loop_closer.detect_at_gap(link)
            if found is not None and found.submap is self.active_map.submap:
                self._close(found)

    def _close(self, found: LoopCandidate) -> None:
        context = self.context
        newest = int(found.submap.map.keys.argmax())  # rows after it are of frames that were tracked backward
        if not found.is_loop:
            self.initialization.confirm_map()
            self.initialization.start_check.cancel()  # the other map agrees with this one
        since = newest - found.keyframe
        submap, keyframe = context.loop_closer.close(found)
        self.active_map.replace(submap)
        context.tracker.reset_to_keyframe(submap, keyframe + since)
        context.non_static_filter.forget_last()  # its pose was one of the map before

    def _cull_and_compact(self, submap: Submap) -> None:
        keys = submap.map.keys
        remap = self.context.mapper.cull_and_compact(submap)
        if remap is not None:
            self.context.loop_closer.remove(keys[remap.keyframes < 0])


class LostState:
    """Looks for a submap to track the camera in; frames are kept as unposed until there is one."""

    def __init__(
        self, context: SystemContext, initialization: InitializationState, backward: BackwardTracking
    ) -> None:
        self.context, self.initialization, self.backward = context, initialization, backward
        self.relocalizer = Relocalizer(context.tracker, context.config)
        self.num_frames = 0  # since the camera was lost

    def enter(self) -> None:
        """Stop tracking in the active map."""
        context = self.context
        context.active_map.deactivate(State.LOST if len(context.session.atlas) else State.INITIALIZING)
        self.initialization.restart()
        context.confirmation.confirm()
        context.non_static_filter.forget_last()
        self.num_frames = 0

    def step(self, view: FrameFeatures) -> FrameOutcome:
        """Relocalize the frame, or initialize a new submap with it; after an exception the state is that of before."""
        restore = self._restorer()
        try:
            return self._step(view)
        except BaseException:  # of a user's matcher, or from the keyboard
            restore()
            raise

    def _restorer(self) -> Callable[[], None]:
        """A function that restores what a frame changes before it has a pose."""
        overlay, unposed = self.context.non_static_filter.static_overlay, self.backward.unposed
        evidence, views, num_frames = overlay.evidence.clone(), list(unposed), self.num_frames
        initializer = self.initialization.initializer.copy()

        def restore() -> None:
            overlay.restore(evidence)
            unposed.restore(views)
            self.num_frames, self.initialization.initializer = num_frames, initializer

        return restore

    def _step(self, view: FrameFeatures) -> FrameOutcome:
        context, has_submaps = self.context, len(self.context.session.atlas) > 0
        self.num_frames += 1
        if has_submaps:
            with context.clock("relocalization"):
                found = self.relocalizer.locate(view, context.loop_closer.query(view))
            if found is not None:
                return self._on_relocalized(view, *found)
        self.backward.unposed.add(view)
        waits = self.num_frames <= context.config.relocalization.frames_before_new_submap
        if has_submaps and (waits or not context.session.mapping):
            return FrameOutcome([Reason.LOST])
        rejection = self.initialization.step(view)
        if rejection:
            return FrameOutcome([rejection])
        return FrameOutcome([Reason.STARTED], context.active_map.submap, is_keyframe=True)

    def _on_relocalized(self, view: FrameFeatures, submap: Submap, estimate: PoseEstimate) -> FrameOutcome:
        """Track in the submap from here; the next frames have to confirm the pose."""
        context = self.context
        context.tracker.start_at_estimate(submap, view, estimate)
        context.active_map.activate(submap, State.UNCERTAIN)
        context.confirmation.start_after_relocalization(view, estimate, submap.tracking)
        return FrameOutcome([Reason.RELOCALIZED], submap, estimate)


class StateMachine:
    """Processes the features of one frame after the other."""

    def __init__(self, context: SystemContext) -> None:
        self.context, self.active_map = context, context.active_map
        self.mapping = LocalMapping(context)
        self.tentative = TentativeMapping(context, self.mapping)
        self.backward = BackwardTracking(context, self.mapping)
        self.start_check = StartCheck(context, self.backward)
        self.initialization = InitializationState(context, self.backward, self.start_check)
        self.keyframe_actions = KeyframeActions(context, self.mapping, self.initialization)
        self.lost = LostState(context, self.initialization, self.backward)

    def relocalize_or_initialize(self, view: FrameFeatures) -> FrameOutcome:
        """Look for a submap to track in, without an active one."""
        return self.lost.step(view)

    def track(self, view: FrameFeatures) -> FrameOutcome:
        """Track the frame; a doubtful pose is held back until later frames confirm it."""
        context = self.context
        self.mapping.start_adjustment()
        self.keyframe_actions.apply_adjustment_before_frame()
        submap = self.active_map.current
        with context.clock("tracking"):
            expected = None if submap.tracking.velocity is None else context.tracker.predict(submap)
            is_sure = not context.confirmation.is_holding
            estimate = context.tracker.track(submap, view, is_sure=is_sure)
        if estimate is None:
            return self._on_lost(view)
        quality_rejection = check_pose_quality(estimate, expected, context.config.pose_validation)
        rejection = quality_rejection or check_map_agreement(
            estimate, submap.tracking, context.config.pose_validation
        )
        motion = NO_MOVEMENT
        if rejection is None:
            motion = context.non_static_filter.detect_independent_motion(estimate)
        if not (rejection or motion.rejection or context.confirmation.is_holding):
            return self._on_certain(view, estimate, motion.note)
        # Where views are far apart, the motion model is wrong and not the pose.
        is_plausible = quality_rejection is None or quality_rejection.reason is Reason.JUMP
        has_moving_majority = (
            motion.rejection is not None and motion.rejection.reason is Reason.MOVING_MAJORITY
        )
        may_map = self._may_map_tentatively(estimate, rejection or motion.rejection)
        if is_plausible and not has_moving_majority and may_map:
            self.tentative.add_keyframe(submap, view, estimate)
        return self._on_uncertain(view, estimate, rejection or motion.rejection)

    def finalize(self) -> None:
        """End the session: frames that are held back keep their poses, uncertain as they are."""
        if self.active_map.submap is not None:
            num_new = self._keep_uncertain()
            self.keyframe_actions.apply_pending_adjustment()
            self.keyframe_actions.detect_loop(num_new)
        self.initialization.confirm_map()
        if self.active_map.submap is not None:
            self.start_check.step(self.active_map.submap, is_last=True)
        self.keyframe_actions.close_gap()

    def confirm_map(self) -> None:
        """Confirm a provisional map as it is, with its tentative keyframes: backward tracking adds to the same map."""
        if self.active_map.submap is not None and self.initialization.provisional is not None:
            self.tentative.commit(self.active_map.current)
            self.mapping.apply_adjustment(self.active_map.current)
        self.initialization.confirm_map()
        self.start_check.cancel()

    def _on_certain(
        self, view: FrameFeatures, estimate: PoseEstimate, motion: Explanation | None
    ) -> FrameOutcome:
        """Map the frame, close loops, remove static overlays, confirm a provisional map.

        Args:
            motion: note about keypoints that move independently of the scene.
        """
        context, mapping, actions = self.context, self.mapping, self.keyframe_actions
        self.active_map.set_state(State.TRACKING)
        reason = mapping.add_frame(self.active_map.current, view, estimate, self._apply_at())
        is_keyframe = reason is not None
        if is_keyframe and not mapping.adjustment.is_pending:
            actions.detect_and_close()
        has_new_overlay = context.session.mapping and context.non_static_filter.update_overlay(
            self.active_map.current.T_cw, estimate.depth
        )
        if has_new_overlay:
            actions.apply_pending_adjustment()
            remove_masked_observations(
                self.active_map.current, context.non_static_filter.static_overlay.covers
            )
        if self.initialization.is_almost_confirmed:
            actions.apply_pending_adjustment()
        if self.initialization.add_frame(view):
            return FrameOutcome([Reason.STARTED_ANEW], self.active_map.submap, is_keyframe=True)
        if not is_keyframe and not mapping.adjustment.is_due(view.index):
            actions.precheck_loop()
        if not is_keyframe:
            actions.apply_pending_adjustment(view.index)
        if not mapping.adjustment.is_pending:
            self.start_check.step(self.active_map.current)
            actions.close_gap()
        notes = [reason, Reason.STATIC_OVERLAY if has_new_overlay else None, motion]
        reasons = [note for note in notes if note is not None]
        return FrameOutcome(reasons, self.active_map.submap, estimate, is_keyframe)

    def _apply_at(self) -> ApplyAt:
        """When the adjustment around a new keyframe is applied: soon, as long as it moves the whole map."""
        settings = self.context.config.bundle_adjustment
        if settings.delay_frames == 0:
            return ApplyAt.NOW
        is_small = self.active_map.current.map.num_keyframes < settings.local_window
        if is_small or self.initialization.provisional is not None:
            return ApplyAt.BEFORE_NEXT_FRAME
        return ApplyAt.AFTER_DELAY

    def _may_map_tentatively(self, estimate: PoseEstimate, rejection: Rejection | None) -> bool:
        """Whether a frame that is held back may become a tentative keyframe; after a relocalization only a sure one."""
        if self.context.confirmation.is_relocalized:
            return estimate.inliers >= SURE_INLIERS
        return rejection is not None or self.tentative.has_keyframes

    def _on_uncertain(
        self, view: FrameFeatures, estimate: PoseEstimate, rejection: Rejection | None
    ) -> FrameOutcome:
        """Hold the frame back; enough frames in a row without a rejection confirm all that are held back."""
        submap, confirmation = self.active_map.current, self.context.confirmation
        confirmation.push(view, estimate, submap.tracking, rejection, self.tentative.has_keyframes)
        if confirmation.is_holding:
            reason = rejection or confirmation.reason
            self.active_map.set_state(State.UNCERTAIN)
            if confirmation.is_full:
                self.keyframe_actions.detect_loop(self._keep_uncertain())
            return FrameOutcome([reason], self.active_map.current, estimate)
        num_new = self.tentative.commit(submap)  # whose adjustments are applied: none is pending
        was_relocalized, frames = confirmation.is_relocalized, confirmation.confirm()
        self.mapping.add_pending_frames(submap, frames)
        self.initialization.add_confirmed(frames)
        if was_relocalized:
            self.backward.from_frame(submap, *frames[0][:2])
        self.active_map.set_state(State.TRACKING)
        self.keyframe_actions.close_gap()
        self.keyframe_actions.detect_loop(num_new)
        return FrameOutcome([], self.active_map.current, estimate)

    def _keep_uncertain(self) -> int:
        """Keep the poses of frames that are held back, and their tentative keyframes; return the number of these."""
        submap, confirmation = self.active_map.current, self.context.confirmation
        num_new, frames = self.tentative.commit(submap), confirmation.pop_all()
        for pending in frames:
            submap.posed_frames.add(*pending)
        if frames and confirmation.is_relocalized:
            self.backward.from_frame(submap, *frames[0][:2])
        return num_new

    def _on_lost(self, view: FrameFeatures) -> FrameOutcome:
        """Frames that are held back are unposed again, unless they are many; a provisional map is discarded."""
        self.keyframe_actions.apply_pending_adjustment()
        if self.context.confirmation.is_long:
            self._keep_uncertain()
        self.tentative.rollback(self.active_map.current)
        self.backward.unposed.add(*self.context.confirmation.views(), view)
        is_discarded = self.initialization.on_lost()
        self.keyframe_actions.close_gap()
        self.lost.enter()
        return FrameOutcome([Reason.LOST_AT_START if is_discarded else Reason.LOST])
