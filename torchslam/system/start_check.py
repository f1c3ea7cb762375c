"""Check of a map's start: the first frames are posed anew against the grown map if their own matches contradict them.

A map that was initialized from too little parallax can be bent: the frames of its start agree with its points, and both
are wrong. The map that grows from it is right once it consists of points of later keyframes. Then the start is taken
away and tracked anew, backward in time; that is undone if it does not agree with the matches either.
"""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.geometry import estimate_relative_pose, se3_inverse
from torchslam.map.atlas import Submap
from torchslam.map.compaction import remove_keyframes
from torchslam.map.map import Map
from torchslam.system.local_mapping import BackwardTracking
from torchslam.system.session import SystemContext
from torchslam.tracking.initialization import support
from torchslam.tracking.matcher import run_matcher
from torchslam.types import FrameFeatures

MIN_SUPPORT_RATIO = 0.9
"""Minimum support of the map's motions, relative to that of the motions that two frames alone give.

It is 0.97 or more for right starts of four real sequences and a rendered one, 0.5 for starts that were bent.
"""
NUM_LATER = 8
"""Later keyframes by which a map has grown: as many as the local bundle adjustment moves together."""
MIN_LATER = 4
"""Later keyframes with which a start is checked if the map grows no more."""
MAX_FRAMES = 100
"""Frames after which a map that did not grow is left as it is, and frames of a start that are kept for the check."""
NUM_COMPARED = 3
"""First later keyframes that are compared with the start; further ones see little of it."""
MIN_MATCHES = 50
"""Matches between two keyframes from which on they are compared."""


@dataclass(frozen=True)
class KeyframePair:
    """Matches of a keyframe of the start, by its frame, with a later keyframe, by its key.

    Attributes:
        frame: Index of the frame of the start.
        later: Key of the later keyframe.
        support: Support of the matches by the motion that they alone give.
        pixels_1: Matched keypoints in the frame of the start.
        pixels_2: Matched keypoints in the later keyframe.
    """

    frame: int
    later: int
    support: float
    pixels_1: Float[Tensor, "M 2"]
    pixels_2: Float[Tensor, "M 2"]


class StartCheck:
    """Checks the start of a new submap once it has grown."""

    def __init__(self, context: SystemContext, backward: BackwardTracking) -> None:
        self.context, self.backward = context, backward
        self._submap: Submap | None = None
        self._views: list[FrameFeatures] = []
        self._age = 0  # frames since the start

    def start(self, submap: Submap, views: list[FrameFeatures]) -> None:
        """Check a submap that was just confirmed later on.

        Args:
            submap: The submap.
            views: The frames posed in it so far.
        """
        self.cancel()
        if 0 < len(views) <= MAX_FRAMES:
            self._submap, self._views = submap, sorted(views, key=lambda view: view.index)

    def cancel(self) -> None:
        """Leave the start as it is."""
        self._submap, self._views, self._age = None, [], 0

    def step(self, submap: Submap, is_last: bool = False) -> bool:
        """Check the start if the active submap has grown enough; return whether its frames were posed anew.

        Rows of keyframes are renumbered then. No adjustment may be pending.

        Args:
            submap: The active submap.
            is_last: Whether this is the last opportunity.
        """
        if self._submap is None:
            return False
        if submap is not self._submap:  # merged into another one, or lost
            self.cancel()
            return False
        later = _later_keyframes(submap.map, self._views[-1].index)
        self._age += 1
        is_last = is_last or self._age >= MAX_FRAMES
        if len(later) < (MIN_LATER if is_last else NUM_LATER):
            if is_last:
                self.cancel()
            return False
        if int(submap.map.keyframes["frame_index"][submap.tracking.reference]) <= self._views[-1].index:
            if is_last:
                self.cancel()
            return False  # the camera is back where it started
        views = self._views
        self.cancel()
        with self.context.clock("initialization"):
            pairs = self._pairs(submap.map, views[-1].index, later)
            needed = MIN_SUPPORT_RATIO * sum(pair.support for pair in pairs)
            if self._support(submap, pairs) >= needed:
                return False
        return self._pose_anew(submap, views, pairs, needed)

    def _pairs(self, slam_map: Map, last: int, later: list[int]) -> list[KeyframePair]:
        """Matches between the keyframes of the start and the first later ones that give a motion on their own."""
        pairs = []
        frames = slam_map.keyframes["frame_index"].tolist()
        first = sorted(later, key=lambda keyframe: frames[keyframe])[:NUM_COMPARED]
        for row, frame in enumerate(frames):
            for other in first if frame <= last else ():
                view, after = slam_map.frame_features(row), slam_map.frame_features(other)
                found = run_matcher(self.context.matcher, view, after)
                if len(found.first) < MIN_MATCHES:
                    continue
                pixels = view.keypoints[found.first], after.keypoints[found.second]
                own_support = self._own_support(*pixels)
                if own_support > 0:
                    pairs.append(KeyframePair(frame, slam_map.key(other), own_support, *pixels))
        return pairs

    def _support(self, submap: Submap, pairs: list[KeyframePair]) -> float:
        """Support of the matches by the motions in the map."""
        poses = submap.posed_frames.T_cw(submap.map)
        rows = {frame: row for row, frame in enumerate(submap.posed_frames.frames["frame_index"].tolist())}
        threshold, camera = self.context.config.initialization.threshold_px, self.context.camera
        total = 0.0
        for pair in pairs:
            if pair.frame in rows:
                T_21 = submap.map.T_cw[submap.map.row(pair.later)] @ se3_inverse(poses[rows[pair.frame]])
                total += support(pair.pixels_1, pair.pixels_2, T_21, camera, threshold)
        return total

    def _own_support(self, pixels_1: Float[Tensor, "M 2"], pixels_2: Float[Tensor, "M 2"]) -> float:
        """Support of the matches by the motion that they alone give; 0 if they give none."""
        config, camera = self.context.config, self.context.camera
        threshold = config.initialization.threshold_px
        found = estimate_relative_pose(
            pixels_1[None],
            pixels_2[None],
            camera_1=camera,
            camera_2=camera,
            threshold=threshold,
            seed=config.seed,
            kernel="truncated",
            min_samples=64,
        )
        if not bool(found.success[0]):
            return 0.0
        return support(pixels_1, pixels_2, found.T_21[0], camera, threshold)

    def _pose_anew(
        self, submap: Submap, views: list[FrameFeatures], pairs: list[KeyframePair], needed: float
    ) -> bool:
        """Track the start anew, and undo that if matches contradict it still; return whether it stays."""
        context, backward = self.context, self.backward
        with torch.inference_mode(False):  # the run goes on outside of it
            before = deepcopy(submap)
        frames = submap.map.keyframes["frame_index"].clone()
        start = torch.nonzero(frames <= views[-1].index)[:, 0]
        context.loop_closer.remove(submap.map.keys[start])
        remove_keyframes(submap, start)
        submap.posed_frames.remove({view.index for view in views} | set(frames[start].tolist()))
        kept = submap.map.num_keyframes
        backward.unposed.add(*views)
        backward.from_first_keyframe(submap)
        known = set(submap.posed_frames.frames["frame_index"].tolist())
        if all(view.index in known for view in views) and self._support(submap, pairs) >= needed:
            return True
        backward.unposed.remove(views)
        context.loop_closer.remove(submap.map.keys[kept:])
        submap.map, submap.posed_frames, submap.tracking = before.map, before.posed_frames, before.tracking
        for keyframe in start.tolist():
            context.loop_closer.add(submap.map, keyframe)
        return False


def _later_keyframes(slam_map: Map, last: int) -> list[int]:
    """Rows of the keyframes from after the frame `last`."""
    return torch.nonzero(slam_map.keyframes["frame_index"] > last)[:, 0].tolist()
