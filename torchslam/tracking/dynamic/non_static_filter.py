"""Filter for keypoints that do not belong to the static scene: static overlays and moving objects."""

from __future__ import annotations

from torch import Tensor

from torchslam.config import Config
from torchslam.geometry import Camera
from torchslam.tracking.dynamic.independent_motion import NOTHING, IndependentMotion, Movement
from torchslam.tracking.dynamic.static_overlay import StaticOverlayDetector
from torchslam.types import FrameFeatures, PoseEstimate


class NonStaticFilter:
    """Masks out keypoints of static overlays and moving objects, as far as each is enabled."""

    def __init__(self, camera: Camera, config: Config) -> None:
        self.config = config
        self.static_overlay = StaticOverlayDetector(camera, config.static_overlay, config.matching)
        self.independent_motion = IndependentMotion(camera, config.independent_motion, config.matching)

    def mask_out(self, view: FrameFeatures) -> FrameFeatures:
        """The view without the keypoints known not to belong to the scene; call it once per frame, in order."""
        self._view = view
        self._without_overlays = self.static_overlay.mask_out(view)
        return self.independent_motion.mask_out(self._without_overlays)

    def detect_independent_motion(self, estimate: PoseEstimate) -> Movement:
        """Detect keypoints of the newest view that move against the scene, given the view's pose."""
        if not self.config.independent_motion.enabled:
            return NOTHING
        return self.independent_motion.observe(self._without_overlays, estimate)

    def update_overlay(self, T_cw: Tensor, depth: float) -> bool:
        """Update the overlays with the newest view and its pose (4, 4); return whether there are new ones."""
        if not self.config.static_overlay.enabled:
            return False
        return self.static_overlay.observe(self._view, T_cw, depth) > 0

    def forget_last(self) -> None:
        """Compare the next frame with no earlier one: its pose is in another submap."""
        self.static_overlay.forget_last()
        self.independent_motion.forget_last()
