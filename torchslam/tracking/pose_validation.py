"""Validation of pose estimates.

A pose is validated by its inlier ratio, its covariance, its motion, and the agreement of the image with the map.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.geometry import se3_inverse
from torchslam.geometry.transforms import rotation_angle
from torchslam.map.atlas import TrackingState
from torchslam.tracking.motion_model import squared_deviation
from torchslam.types import PoseEstimate, PosePrediction, Reason, Rejection

MIN_INLIER_RATIO = 0.5
"""Ratio of inliers to matches around the predicted pixels: a majority. Tried at this value only."""
MAX_POSITION_STD, MAX_ROTATION_STD_DEG = 0.017, 0.9
"""Largest standard deviations of the position, relative to the median depth of the tracked points, and of the rotation,
degrees: about 0.9 degrees seen from the scene, or by the camera. Tried at these values only."""
MAX_JUMP, MAX_TURN_DEG = 0.5, 20.0
"""Largest distance from the predicted position, relative to the median depth, and rotation from the predicted
orientation, degrees. Tried at these values only."""
MAX_SQUARED_DEVIATION = 38.3
"""Largest squared distance from a prediction with a covariance, in units of that covariance: honest ones exceed it in
one frame of a million (chi-square, six degrees of freedom)."""
MAX_SQUARED_ERROR = 1.3
"""Largest median squared error in units of the noise, averaged over ten frames. Tried at 1.05 and 1.3."""
MIN_EXPLAINED_RATIO = 0.3
"""Ratio of the image area with keypoints that the map explains, averaged over ten frames. Tried at this value only."""
MIN_COVERAGE_RATIO = 0.2
"""Ratio of the image area with expected map points that inliers cover. Tried at this value only."""
NUM_CONFIRMING_FRAMES = 2
"""Certain frames in a row that confirm an uncertain pose. Tried at this value only."""
SURE_INLIERS = 60
"""Number of inliers with which a large turn is believed: where views are far apart, the motion model fails."""


class Certainty(Enum):
    """What a pose is good for."""

    CERTAIN = "the map may be extended from it"
    DOUBTFUL = "later frames have to confirm it; the map may be extended tentatively"
    WRONG = "later frames have to confirm it; the map must not be extended from it"


_WRONG = {
    Reason.LOW_INLIER_RATIO,
    Reason.UNCERTAIN_POSITION,
    Reason.UNCERTAIN_ROTATION,
    Reason.MOVING_MAJORITY,
}
"""Rejections that concern the pose itself. After a jump the motion model may be wrong instead: views are far apart."""


@dataclass(frozen=True)
class Verdict:
    """The result of a validation: why the pose is not certain; None if it is."""

    rejection: Rejection | None = None

    @property
    def certainty(self) -> Certainty:
        """What the pose is good for."""
        if self.rejection is None:
            return Certainty.CERTAIN
        return Certainty.WRONG if self.rejection.reason in _WRONG else Certainty.DOUBTFUL

    @property
    def is_jump(self) -> bool:
        """Whether only the motion model contradicts the pose."""
        return self.rejection is not None and self.rejection.reason is Reason.JUMP


def check_pose(estimate: PoseEstimate, prediction: PosePrediction | None, averages: TrackingState) -> Verdict:
    """Validate a pose by itself, and by the agreement of the recent images with the map.

    `prediction` is that of the motion model; `averages` a tracking state with the averages over the
    frames up to this one, see `TrackingState.averaged_with`.
    """
    quality = check_pose_quality(estimate, prediction)
    return Verdict(quality or check_map_agreement(estimate, averages))


def check_pose_quality(estimate: PoseEstimate, prediction: PosePrediction | None) -> Rejection | None:
    """Why a pose is wrong by its own matches, its covariance or its motion; None if it is plausible."""
    ratio = estimate.inliers / max(estimate.matches, 1)
    if ratio < MIN_INLIER_RATIO:
        return Rejection.of(Reason.LOW_INLIER_RATIO, ratio=ratio, matches=estimate.matches)
    position, rotation = deviations(estimate)
    if position > MAX_POSITION_STD:
        return Rejection.of(Reason.UNCERTAIN_POSITION, std=position)
    if rotation > MAX_ROTATION_STD_DEG:
        return Rejection.of(Reason.UNCERTAIN_ROTATION, degrees=rotation)
    if prediction is None:
        return None
    moved, turned = jump(estimate, prediction.T_cw)
    if prediction.covariance is None:
        is_odd = moved > MAX_JUMP or (turned > MAX_TURN_DEG and estimate.inliers < SURE_INLIERS)
    else:
        squared = squared_deviation(estimate.T_cw, estimate.covariance, prediction)
        is_odd = squared > MAX_SQUARED_DEVIATION
    if is_odd:
        return Rejection.of(Reason.JUMP, translation=moved, degrees=turned)
    return None


def check_map_agreement(estimate: PoseEstimate, averages: TrackingState) -> Rejection | None:
    """Why the recent images disagree with what the map predicts; None if they agree."""
    if averages.error > MAX_SQUARED_ERROR:
        return Rejection.of(Reason.LARGE_ERRORS, sigma=averages.error**0.5)
    if averages.explained_ratio < MIN_EXPLAINED_RATIO:
        return Rejection.of(Reason.LOW_EXPLAINED_RATIO, ratio=averages.explained_ratio)
    if estimate.coverage_ratio < MIN_COVERAGE_RATIO:
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
