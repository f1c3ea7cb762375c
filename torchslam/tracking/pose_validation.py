"""May a pose be believed? By how much agrees with it, how sure it is, and whether the motion is possible."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchslam.config import PoseValidationConfig
from torchslam.geometry import se3_inverse
from torchslam.geometry.transforms import rotation_angle
from torchslam.map.atlas import TrackingState
from torchslam.types import PoseEstimate


def why_doubt(
    estimate: PoseEstimate,
    predicted_T_cw: Tensor | None,
    tracking: TrackingState,
    settings: PoseValidationConfig,
) -> str:
    """Why a pose should not be built on, in words; empty when it may be.

    predicted_T_cw: (4, 4) where the camera was expected; None where nothing was
    track: what the frames before it were like
    """
    return why_unsound(estimate, predicted_T_cw, settings) or why_strange(estimate, tracking, settings)


def why_unsound(estimate: PoseEstimate, predicted_T_cw: Tensor | None, settings: PoseValidationConfig) -> str:
    """Why a pose is not even what its own matches say; empty when it is. Arguments as of `why_doubt`."""
    share = estimate.inliers / max(estimate.matches, 1)
    if share < settings.min_inlier_ratio:
        return f"only {share:.0%} of {estimate.matches} matches agree with the pose"
    position, rotation = deviations(estimate)
    if position > settings.max_position_std:
        return f"the position is known to {position:.3f} of the scene's depth"
    if rotation > settings.max_rotation_std_deg:
        return f"the rotation is known to {rotation:.2f} degrees"
    if predicted_T_cw is None:
        return ""
    moved, turned = jump(estimate, predicted_T_cw)
    if moved > settings.max_jump or turned > settings.max_turn_deg:
        return f"jumped by {moved:.2f} of the scene's depth and {turned:.0f} degrees"
    return ""


def why_strange(estimate: PoseEstimate, tracking: TrackingState, settings: PoseValidationConfig) -> str:
    """Why the images of late are not what the map leads to expect; empty when they are."""
    if tracking.error > settings.max_squared_error:
        return f"the matches of the last frames are off by {tracking.error**0.5:.1f} times their noise in the median"
    if tracking.explained_ratio < settings.min_explained_ratio:
        return f"the map explains only {tracking.explained_ratio:.0%} of the image"
    if estimate.coverage_ratio < settings.min_coverage_ratio:
        return f"only {estimate.coverage_ratio:.0%} of the image shows what the map expects there"
    return ""


def deviations(estimate: PoseEstimate) -> tuple[float, float]:
    """Standard deviations of the position, as a share of the depth of the scene, and of the rotation, in degrees."""
    variances = estimate.covariance.diagonal().tolist()
    position = max(sum(variances[:3]), 0.0) ** 0.5 / max(estimate.depth, 1e-12)
    return position, math.degrees(max(sum(variances[3:]), 0.0) ** 0.5)


def jump(estimate: PoseEstimate, predicted_T_cw: Tensor) -> tuple[float, float]:
    """How far a pose is from where it was expected: in shares of the depth of the scene, and in degrees."""
    motion = estimate.T_cw @ se3_inverse(predicted_T_cw)
    moved = float(torch.linalg.vector_norm(motion[:3, 3])) / max(estimate.depth, 1e-12)
    return moved, math.degrees(float(rotation_angle(motion[:3, :3])))
