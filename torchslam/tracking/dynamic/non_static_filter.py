"""What is not matched, as it does not belong to the scene: pixels that stay in place, things that move."""

from __future__ import annotations

from torch import Tensor

from torchslam.config import Config
from torchslam.geometry import Camera
from torchslam.tracking.dynamic.independent_motion import NOTHING, IndependentMotion, Movement
from torchslam.tracking.dynamic.static_overlay import StaticOverlayDetector
from torchslam.types import FrameFeatures, PoseEstimate


class NonStaticFilter:
    """Watches for both, as far as the configuration wants it."""

    def __init__(self, camera: Camera, config: Config) -> None:
        self.config = config
        self.static_overlay = StaticOverlayDetector(camera, config.static_overlay, config.matching)
        self.independent_motion = IndependentMotion(camera, config.independent_motion, config.matching)

    def mask_out(self, view: FrameFeatures) -> FrameFeatures:
        """The view without the keypoints that are known not to belong; views come in order of time."""
        self._seen = view
        self._steady = self.static_overlay.mask_out(view)
        return self.independent_motion.mask_out(self._steady)

    def detect_independent_motion(self, estimate: PoseEstimate) -> Movement:
        """What of the newest view moves against the scene, by the pose that was found for it."""
        if not self.config.independent_motion.enabled:
            return NOTHING
        return self.independent_motion.observe(self._steady, estimate)

    def update_overlay(self, T_cw: Tensor, depth: float) -> bool:
        """Whether pixels of the newest view became known to stay; its pose (4, 4), and the depth of the scene."""
        if not self.config.static_overlay.enabled:
            return False
        return self.static_overlay.observe(self._seen, T_cw, depth) > 0

    def forget_last(self) -> None:
        """The next frame cannot be compared with the ones before: its pose is in another world."""
        self.static_overlay.forget_last()
        self.independent_motion.forget_last()
