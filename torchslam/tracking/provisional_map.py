"""Provisional maps: recently initialized maps, which later frames may contradict."""

from __future__ import annotations

from torch import Tensor

from torchslam.config import Config
from torchslam.geometry import Camera, epipolar_offsets, se3_inverse
from torchslam.map.atlas import Submap
from torchslam.tracking.initialization import Initializer
from torchslam.tracking.matcher import make_matcher, run_matcher
from torchslam.types import FrameFeatures, Matcher, TwoViewMap

CHECK_INTERVAL = 5
"""Frames between two checks; a turning camera soon no longer sees what the first frame saw."""
MIN_SUPPORT_RATIO = 0.5
"""Minimum support of the map's motion, relative to that of the motion that two frames alone give.

On 46 cuts of real sequences it is 0.83 or more for correct maps; for deliberately wrong ones, mostly below 0.4.
"""


class ProvisionalMap:
    """A recently initialized submap and the frames posed in it so far."""

    def __init__(self, submap: Submap, views: list[FrameFeatures]) -> None:
        self.submap = submap
        self.views = views
        self.age = 0  # frames since the initialization

    def add_frame(self, view: FrameFeatures) -> None:
        """Count another tracked frame."""
        self.views.append(view)
        self.age += 1

    def find_contradicting_initialization(
        self, camera: Camera, config: Config, matcher: Matcher | None = None
    ) -> TwoViewMap | None:
        """Initialize from the first and the last frame alone; return the result if it contradicts the map.

        The map's own observations agree with it by construction, so the two frames are matched again. The result
        contradicts the map if the motion in the map explains its matches much worse.
        """
        if self.age % CHECK_INTERVAL != 0:
            return None
        first, last = self.views[0], self.views[-1]
        threshold_px = config.initialization.threshold_px
        T_1w, T_2w = self.submap.posed_frames.T_cw(self.submap.map)[0], self.submap.T_cw
        T_21 = T_2w @ se3_inverse(T_1w)
        pairs = run_matcher(make_matcher(config.matching, matcher), first, last)
        pixels = first.keypoints[pairs.first], last.keypoints[pairs.second]
        if support(*pixels, T_21, camera, threshold_px) >= MIN_SUPPORT_RATIO * len(pairs.first):
            return None  # no motion can have twice the support
        initializer = Initializer(camera, config, matcher)
        initializer.step(first)
        start = initializer.step(last)
        if not isinstance(start, TwoViewMap):
            return None
        pixels = first.keypoints[start.keypoints_1], last.keypoints[start.keypoints_2]
        own, by_map = (support(*pixels, T, camera, threshold_px) for T in (start.T_cw, T_21))
        return start if by_map < MIN_SUPPORT_RATIO * own else None


def support(pixels_1: Tensor, pixels_2: Tensor, T_21: Tensor, camera: Camera, threshold_px: float) -> float:
    """Support of a motion T_21 (4, 4) by matches (n, 2), (n, 2): sum of 1 - (error / threshold)^2 where positive."""
    across, _ = epipolar_offsets(T_21, pixels_1, pixels_2, camera, camera)
    return float((1 - (across / threshold_px) ** 2).clamp_min(0.0).sum())
