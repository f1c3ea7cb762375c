"""Tracking in a submap: frames with certain poses are mapped, doubtful ones are held back until others confirm them."""

from __future__ import annotations

from torchslam.config import KeyframesConfig
from torchslam.loop_closing.loop_closer import LoopCloser
from torchslam.map.atlas import Submap
from torchslam.mapping.local_bundle import ApplyAt
from torchslam.mapping.mapper import (
    LIVE_MIN_OVERLAP,
    MIN_POINTS,
    Mapper,
    keyframe_reason,
    overlap_with_reference,
)
from torchslam.system.frame_log import FrameLog, HeldFrame
from torchslam.system.savepoint import Savepoint
from torchslam.tracking.pose_validation import NUM_CONFIRMING_FRAMES, Certainty, Verdict, check_pose
from torchslam.tracking.tracker import Tracker
from torchslam.types import Explanation, FrameFeatures, PoseEstimate
from torchslam.utils.timing import Stopwatch

MAX_CONSECUTIVE_FAILURES = 5
"""Frames in a row without a plausible pose that end backward tracking. Tried at this value only."""


class LocalMapping:
    """Adds frames to a submap and inserts keyframes.

    Args:
        tracker, mapper, loop_closer, log: of the session.
        keyframes: when a frame becomes a keyframe; None: never, frames are only localized.
    """

    def __init__(
        self,
        tracker: Tracker,
        mapper: Mapper,
        loop_closer: LoopCloser,
        log: FrameLog,
        keyframes: KeyframesConfig | None,
    ) -> None:
        self.tracker, self.mapper, self.loop_closer = tracker, mapper, loop_closer
        self.log, self.keyframes, self.adjustment = log, keyframes, mapper.adjustment

    def add_frame(
        self,
        submap: Submap,
        view: FrameFeatures,
        estimate: PoseEstimate,
        apply_at: ApplyAt = ApplyAt.NOW,
    ) -> Explanation | None:
        """Add a frame with a certain pose; return why it became a keyframe, or None.

        While an adjustment is pending there is no other keyframe: it is applied after this frame instead. That of the
        whole map takes longer: it is waited for as long as enough of the map is seen, see `is_urgent`.
        """
        self.tracker.count_visible(submap.map, estimate)
        reason = self._keyframe_reason(submap, view, estimate)
        if reason and self.adjustment.is_pending:
            if not self.adjustment.is_whole or overlap_with_reference(estimate, submap) <= LIVE_MIN_OVERLAP:
                self.adjustment.set_deadline(view.index)
            reason = None
        if reason:
            self.loop_closer.add(submap.map, self._insert(submap, view, estimate, apply_at))
        self.tracker.count_found(submap.map, estimate)
        submap.posed_frames.add(view, estimate, submap.tracking.T_cr, submap.tracking.reference)
        sensor = self.mapper.camera.model
        if reason and sensor.readout is not None:
            submap.correct_keyframes(sensor, newest=2)  # the frame after the one before is known now
        return reason

    def is_urgent(self, submap: Submap, view: FrameFeatures, estimate: PoseEstimate) -> bool:
        """Whether a keyframe is due at once, before the pending adjustment of the whole map: few points are in view."""
        is_weak = self.adjustment.is_whole and estimate.inliers < MIN_POINTS
        return is_weak and self._keyframe_reason(submap, view, estimate) is not None

    def add_tentative_keyframe(
        self, savepoint: Savepoint, view: FrameFeatures, estimate: PoseEstimate
    ) -> None:
        """Insert a frame with a doubtful pose as a keyframe, if one is due.

        Without new points a moving camera would be lost before its pose is confirmed. Tentative keyframes are not in
        the keyframe database, and their points are not culled.
        """
        submap = savepoint.submap
        if not self._keyframe_reason(submap, view, estimate):
            return
        if self.adjustment.is_pending:
            self.mapper.apply_adjustment(submap.map)
        savepoint.save_map()
        self._insert(submap, view, estimate)

    def commit(self, savepoint: Savepoint) -> list[HeldFrame]:
        """Add the frames that were held back since a savepoint, and keep its tentative keyframes; return the frames."""
        submap = savepoint.submap
        for keyframe in savepoint.keyframes:
            self.loop_closer.add(submap.map, keyframe)
        frames = self.log.take_held(savepoint.frames)
        for frame in frames:
            self.tracker.count_visible(submap.map, frame.estimate)
            self.tracker.count_found(submap.map, frame.estimate)
            submap.posed_frames.add(frame.view, frame.estimate, frame.T_cr, frame.reference)
        savepoint.commit()
        return frames

    def _insert(
        self, submap: Submap, view: FrameFeatures, estimate: PoseEstimate, apply_at: ApplyAt = ApplyAt.NOW
    ) -> int:
        """Insert a frame as a keyframe, which tracking goes on from; return its row."""
        keyframe = self.mapper.insert(submap.map, view, estimate, apply_at)
        self.tracker.reset_to_keyframe(submap, keyframe)
        return keyframe

    def _keyframe_reason(
        self, submap: Submap, view: FrameFeatures, estimate: PoseEstimate
    ) -> Explanation | None:
        return None if self.keyframes is None else keyframe_reason(view, estimate, submap, self.keyframes)

    def hold(self, savepoint: Savepoint, view: FrameFeatures, estimate: PoseEstimate) -> None:
        """Hold a frame back, with its pose relative to the map as it is now."""
        savepoint.frames.append(view.index)
        self.log.hold(HeldFrame.of(view, estimate, savepoint.submap.tracking))


def locate(
    tracker: Tracker, submap: Submap, view: FrameFeatures, is_sure: bool
) -> tuple[PoseEstimate, Verdict] | None:
    """Track a frame in a submap and judge its pose; None if it has none.

    Args:
        tracker: Of the session.
        submap: The submap, with the tracking state after the frame before.
        view: The frame.
        is_sure: Whether the poses before are certain.
    """
    has_moved = len(submap.tracking.motions) > 0
    prediction = tracker.predict(submap, view.timestamp)
    estimate = tracker.track(submap, view, prediction, is_sure)
    verdict = None
    if estimate is not None:
        averages = submap.tracking.averaged_with(estimate)
        verdict = check_pose(estimate, prediction if has_moved else None, averages)
    tracker.commit(submap, view, estimate)
    return None if estimate is None or verdict is None else (estimate, verdict)


class BackwardTracking:
    """Poses logged frames by tracking backward in time, once there is a map."""

    def __init__(self, mapping: LocalMapping, clock: Stopwatch) -> None:
        self.mapping, self.clock = mapping, clock
        self.tracker, self.log = mapping.tracker, mapping.log

    def from_first_keyframe(self, submap: Submap) -> None:
        """Pose the frames from before the first keyframe of a submap."""
        backward = submap.fork()
        self.tracker.reset_to_keyframe(backward, 0)
        self._track(backward, before=int(submap.map.keyframes["frame_index"][0]))

    def from_frame(self, submap: Submap, frame: HeldFrame) -> None:
        """Pose the frames from before a relocalized frame."""
        backward = submap.fork()
        self.tracker.start_at_estimate(backward, frame.view, frame.estimate)
        self._track(backward, before=frame.view.index)

    def _track(self, submap: Submap, before: int) -> None:
        """Track the unposed frames from before a frame.

        What is held back at the earliest frame is kept, as forward in time at the end of a run. Tracking ends after
        `MAX_CONSECUTIVE_FAILURES`, and what is held back then is unposed again.
        """
        log = self.log
        doubted: Savepoint | None = None
        failures = 0
        with self.clock("backwards"):
            for unposed in reversed(log.unposed(before)):
                view = self.tracker.at_middle_row(submap, unposed)
                found = locate(self.tracker, submap, view, is_sure=doubted is None)
                if found is None or found[1].certainty is Certainty.WRONG or found[1].is_jump:
                    failures += 1
                    if failures == MAX_CONSECUTIVE_FAILURES:
                        break
                    continue
                failures = 0
                estimate, verdict = found
                if verdict.rejection is None and doubted is None:
                    self.mapping.add_frame(submap, view, estimate)
                    log.forget([view.index])
                    continue
                doubted = doubted or Savepoint(submap, NUM_CONFIRMING_FRAMES)
                self.mapping.add_tentative_keyframe(doubted, view, estimate)
                doubted.count(verdict.rejection)
                self.mapping.hold(doubted, view, estimate)
                if not doubted.is_open or doubted.is_full:
                    self.mapping.commit(doubted)
                doubted = doubted if doubted.is_open else None
            if doubted is not None and failures < MAX_CONSECUTIVE_FAILURES:
                self.mapping.commit(doubted)
            elif doubted is not None:
                doubted.rollback()
                log.release(doubted.frames)
