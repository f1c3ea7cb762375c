"""Validation of pose estimates, and confirmation of uncertain ones by the frames that follow.

A pose is validated by its inlier ratio, its covariance, its motion, and the agreement of the image with the map.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.config import Config, PoseValidationConfig
from torchslam.geometry import se3_inverse
from torchslam.geometry.transforms import rotation_angle
from torchslam.map.atlas import TrackingState
from torchslam.types import Explanation, FrameFeatures, PoseEstimate, Reason, Rejection

SURE_INLIERS = 60
"""Number of inliers with which a large turn is believed: where views are far apart, the motion model fails."""


def validate_pose(
    estimate: PoseEstimate,
    predicted_T_cw: Float[Tensor, "4 4"] | None,
    tracking: TrackingState,
    settings: PoseValidationConfig,
) -> Rejection | None:
    """Why the map must not be extended from a pose; None if it may.

    Args:
        estimate: the pose.
        predicted_T_cw: pose that the motion model predicts; None without a prediction.
        tracking: state with the averages over the frames up to this one.
        settings: thresholds.
    """
    quality = check_pose_quality(estimate, predicted_T_cw, settings)
    return quality or check_map_agreement(estimate, tracking, settings)


def check_pose_quality(
    estimate: PoseEstimate, predicted_T_cw: Float[Tensor, "4 4"] | None, settings: PoseValidationConfig
) -> Rejection | None:
    """Why a pose is wrong by its own matches, its covariance or its motion; None if it is plausible."""
    ratio = estimate.inliers / max(estimate.matches, 1)
    if ratio < settings.min_inlier_ratio:
        return Rejection.of(Reason.LOW_INLIER_RATIO, ratio=ratio, matches=estimate.matches)
    position, rotation = deviations(estimate)
    if position > settings.max_position_std:
        return Rejection.of(Reason.UNCERTAIN_POSITION, std=position)
    if rotation > settings.max_rotation_std_deg:
        return Rejection.of(Reason.UNCERTAIN_ROTATION, degrees=rotation)
    if predicted_T_cw is None:
        return None
    moved, turned = jump(estimate, predicted_T_cw)
    is_turn_odd = turned > settings.max_turn_deg and estimate.inliers < SURE_INLIERS
    if moved > settings.max_jump or is_turn_odd:
        return Rejection.of(Reason.JUMP, translation=moved, degrees=turned)
    return None


def check_map_agreement(
    estimate: PoseEstimate, tracking: TrackingState, settings: PoseValidationConfig
) -> Rejection | None:
    """Why the recent images disagree with what the map predicts; None if they agree."""
    if tracking.error > settings.max_squared_error:
        return Rejection.of(Reason.LARGE_ERRORS, sigma=tracking.error**0.5)
    if tracking.explained_ratio < settings.min_explained_ratio:
        return Rejection.of(Reason.LOW_EXPLAINED_RATIO, ratio=tracking.explained_ratio)
    if estimate.coverage_ratio < settings.min_coverage_ratio:
        return Rejection.of(Reason.LOW_COVERAGE_RATIO, ratio=estimate.coverage_ratio)
    return None


def deviations(estimate: PoseEstimate) -> tuple[float, float]:
    """Standard deviations of the position, as a ratio of the scene's depth, and of the rotation, in degrees."""
    variances = estimate.covariance.diagonal().tolist()
    position = max(sum(variances[:3]), 0.0) ** 0.5 / max(estimate.depth, 1e-12)
    return position, math.degrees(max(sum(variances[3:]), 0.0) ** 0.5)


def jump(estimate: PoseEstimate, predicted_T_cw: Float[Tensor, "4 4"]) -> tuple[float, float]:
    """Distance of a pose from the predicted one, as a ratio of the scene's depth and in degrees."""
    motion = estimate.T_cw @ se3_inverse(predicted_T_cw)
    moved = float(torch.linalg.vector_norm(motion[:3, 3])) / max(estimate.depth, 1e-12)
    return moved, math.degrees(float(rotation_angle(motion[:3, :3])))


PendingFrame = tuple[FrameFeatures, PoseEstimate, Float[Tensor, "4 4"], int]
"""A frame, its pose estimate, its pose T_cr relative to a keyframe, and the row of that keyframe."""

MAX_PENDING_FRAMES = 1000
"""Frames that are held back at most."""
MANY_PENDING_FRAMES = 40
"""Frames that are held back and kept when the camera is lost: a wrong pose does not last that long."""


class PoseConfirmation:
    """Buffer of the frames since the first uncertain one, with a countdown of certain frames that confirm them."""

    def __init__(self, config: Config) -> None:
        self._needed_after_rejection = config.pose_validation.num_confirming_frames
        self._needed_after_relocalization = config.relocalization.num_confirming_frames
        self._pending: list[PendingFrame] = []
        self._needed = 0
        self._num_rejected = 0  # since the last confirmation
        self.is_relocalized = False

    @property
    def is_holding(self) -> bool:
        """Whether frames have to be confirmed."""
        return self._needed > 0

    @property
    def reason(self) -> Explanation:
        """Number of frames that have to confirm those held back."""
        return Explanation.of(Reason.UNCONFIRMED, count=self._needed)

    def start_after_relocalization(
        self, view: FrameFeatures, estimate: PoseEstimate, tracking: TrackingState
    ) -> None:
        """Start again with a relocalized frame."""
        self._pending = [(view, estimate, tracking.T_cr, tracking.reference)]
        self._needed, self.is_relocalized = self._needed_after_relocalization, True

    def push(
        self,
        view: FrameFeatures,
        estimate: PoseEstimate,
        tracking: TrackingState,
        rejection: Rejection | None,
        is_mapped: bool = False,
    ) -> None:
        """Hold a frame back; one without a rejection counts as a confirmation.

        Args:
            view: the frame.
            estimate: its pose.
            tracking: the tracking state after it.
            rejection: result of the pose validation.
            is_mapped: True if there are tentative keyframes, which agree with frames by construction: as many certain
                frames are needed as there were rejected ones.
        """
        self._pending.append((view, estimate, tracking.T_cr, tracking.reference))
        if rejection is None:
            self._needed -= 1
            return
        self._num_rejected += 1
        self._needed = (
            self._needed_after_relocalization if self.is_relocalized else self._needed_after_rejection
        )
        if is_mapped:
            self._needed = max(self._needed, self._num_rejected)

    @property
    def is_full(self) -> bool:
        """Whether no more frames can be held back."""
        return len(self._pending) >= MAX_PENDING_FRAMES

    @property
    def is_long(self) -> bool:
        """Whether frames are held back for so long that their poses are kept even if the camera is lost."""
        return len(self._pending) >= MANY_PENDING_FRAMES

    def views(self) -> list[FrameFeatures]:
        """The pending frames, in order."""
        return [frame[0] for frame in self._pending]

    def confirm(self) -> list[PendingFrame]:
        """Remove and return the pending frames, and reset the countdown."""
        self._needed, self._num_rejected, self.is_relocalized = 0, 0, False
        return self.pop_all()

    def pop_all(self) -> list[PendingFrame]:
        """Remove and return the pending frames; the countdown goes on."""
        pending, self._pending = self._pending, []
        return pending
