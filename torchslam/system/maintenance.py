"""Maintenance of the active map, always in this order: local adjustment, loops, culling, the camera.

It runs before a frame is tracked and after it was mapped. Rows may be renumbered; what the submap refers to follows
(`map/compaction.py`). The submap that the active one is merged into takes its place.
"""

from __future__ import annotations

import torch

from torchslam.loop_closing.loop_detector import LoopCandidate
from torchslam.system.map_start import MapStart
from torchslam.system.modes import Mode
from torchslam.system.session import SystemContext

LOOP_STRIDE = 4
"""Of the keyframes that are confirmed together, every so many are checked for a loop: their views overlap. Tried at
this value only."""


class Maintenance:
    """Applies local adjustments, closes loops, culls keyframes and compacts the map."""

    def __init__(self, context: SystemContext, map_start: MapStart) -> None:
        self.context, self.map_start = context, map_start
        self.active_map, self.adjustment = context.active_map, context.mapper.adjustment

    def before_frame(self) -> None:
        """Start the pending adjustment, and apply it if it is due before the next frame.

        The frame that requested it took long enough without it.
        """
        if not self.adjustment.is_pending:
            return
        with self.context.clock("bundle"):
            self.adjustment.start()
        if self.adjustment.is_due_before_next_frame:
            self.context.mapper.apply_adjustment(self.active_map.current.map)
            submap = self.active_map.current
            self.context.tracker.reset_to_keyframe(submap, submap.map.num_keyframes - 1)
            self._close_and_cull()

    def after_frame(self, frame: int | None, is_keyframe: bool = False) -> None:
        """Maintain the map after a frame.

        Args:
            frame: Index of the frame, after which a pending adjustment may be due; None: it is applied in any case.
            is_keyframe: Whether the frame became a keyframe.
        """
        if not self.adjustment.is_pending:
            if is_keyframe:
                self._close_and_cull()
        elif frame is None or (not is_keyframe and self.adjustment.is_due(frame)):
            self.context.mapper.apply_adjustment(self.active_map.current.map)
            self._close_and_cull()
        elif not is_keyframe:
            self._precheck_loop()

    def close_loops(self, count: int = 1) -> None:
        """Close a loop at one of the newest keyframes, or merge two submaps, if its place was seen before.

        Args:
            count: Number of the newest keyframes, of which every `LOOP_STRIDE`-th is checked until one closes a loop.
        """
        context, submap = self.context, self.active_map.current
        with context.clock("loops"):
            for keyframe in torch.argsort(submap.map.keys, descending=True)[:count:LOOP_STRIDE].tolist():
                found = context.loop_closer.detect(submap, keyframe)
                if found is not None:
                    self._close(found)
                    break
                context.loop_closer.fuse_with_earlier_visits(submap, keyframe)

    def _close_and_cull(self) -> None:
        """Close a loop at the newest keyframe, cull keyframes, compact the map, and estimate the sensor."""
        self.close_loops()
        submap = self.active_map.current
        keys = submap.map.keys
        remap = self.context.mapper.cull_and_compact(submap)
        if remap is not None:
            self.context.loop_closer.remove(keys[remap.keyframes < 0])
        if self.context.mode is Mode.TRACKING and not self.adjustment.is_pending:
            with self.context.clock("sensor"):
                self.context.online_camera.step(submap)

    def _precheck_loop(self) -> None:
        """Look for a loop at the newest keyframe while its adjustment is pending.

        Nearly always there is none, which saves the search in the frame in which the adjustment is applied.
        """
        slam_map, loop_closer = self.active_map.current.map, self.context.loop_closer
        keyframe = slam_map.num_keyframes - 1
        checked = loop_closer.loop_precheck
        if checked is None or checked[0] != slam_map.key(keyframe):
            with self.context.clock("loops"):
                loop_closer.precheck(self.active_map.current, keyframe)

    def _close(self, found: LoopCandidate) -> None:
        context = self.context
        newest = int(found.submap.map.keys.argmax())  # rows after it are of frames that were tracked backward
        if not found.is_loop:
            self.map_start.confirm()  # the other map agrees with this one
        since = newest - found.keyframe
        submap, keyframe = context.loop_closer.close(found)
        self.active_map.submap = submap
        if self.active_map.doubted is not None:  # where no more could be held back
            self.active_map.doubted.submap = submap
        context.tracker.reset_to_keyframe(submap, keyframe + since)
