"""A world that was begun lately: later frames may show that it was begun wrongly."""

from __future__ import annotations

from torch import Tensor

from torchslam.config import Config
from torchslam.geometry import Camera, epipolar_offsets, se3_inverse
from torchslam.map.atlas import Submap
from torchslam.tracking.initialization import Initializer
from torchslam.tracking.matcher import Matcher, make_matcher, run_matcher
from torchslam.types import FrameFeatures, TwoViewMap

CHECK_INTERVAL = (
    5  # frames between two looks: within a few of them, a turning camera has left what it saw first
)
# Of the support of the motion that two frames alone tell, what that of the map has at least. On 46 cuts of real
# sequences it has 0.83 or more where the map is right; of maps begun wrongly on purpose, mostly less than 0.4.
MIN_SUPPORT_RATIO = 0.5


class ProvisionalMap:
    """A young world and the frames posed in it so far, which wait again if it is taken back."""

    def __init__(self, submap: Submap, views: list[FrameFeatures]) -> None:
        self.submap = submap
        self.views = views
        self.age = 0  # frames tracked since the start

    def add_frame(self, view: FrameFeatures) -> None:
        """Another frame was posed."""
        self.views.append(view)
        self.age += 1

    def find_contradicting_initialization(
        self, camera: Camera, config: Config, matcher: Matcher | None = None
    ) -> TwoViewMap | None:
        """A start by the first and the last frame alone, if it contradicts the map.

        The map keeps what agrees with it, so its own observations never contradict it: these two frames are matched
        anew. None where they make no start, or one whose matches the motion in the map explains about as well.
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
            return None  # no motion can have so much more
        initializer = Initializer(camera, config, matcher)
        initializer.step(first)
        start, _ = initializer.step(last)
        if start is None:
            return None
        pixels = first.keypoints[start.keypoints_1], last.keypoints[start.keypoints_2]
        own, by_map = (support(*pixels, T, camera, threshold_px) for T in (start.T_cw, T_21))
        return start if by_map < MIN_SUPPORT_RATIO * own else None


def support(pixels_1: Tensor, pixels_2: Tensor, T_21: Tensor, camera: Camera, threshold_px: float) -> float:
    """How well a motion T_21 (4, 4) explains matches (n, 2), (n, 2): sum of 1 - (error / threshold)^2, if positive."""
    across, _ = epipolar_offsets(T_21, pixels_1, pixels_2, camera, camera)
    return float((1 - (across / threshold_px) ** 2).clamp_min(0.0).sum())
