"""Motion models: the built-in ones, plugins, and checks of what they predict."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.config import Config
from torchslam.errors import ConfigError
from torchslam.geometry import se3_exp, se3_inverse
from torchslam.geometry.lie import se3_log
from torchslam.geometry.transforms import reorthonormalized
from torchslam.plugins import MOTION_MODELS, load
from torchslam.types import MotionHistory, MotionModel, PosePrediction

_TOLERANCE = 1e-6
"""Entries by which a predicted rotation may be off an orthonormal matrix, and a covariance off a symmetric one,
relative to its largest entry: that of a model that computes in float32. Tried at this value only."""


def constant_velocity(history: MotionHistory) -> PosePrediction:
    """Repeat the last motion; the last pose where there is none."""
    if not len(history.motions):
        return PosePrediction(history.T_cw)
    return PosePrediction(reorthonormalized(history.motions[-1] @ history.T_cw))


def constant_pose(history: MotionHistory) -> PosePrediction:
    """Repeat the last pose."""
    return PosePrediction(reorthonormalized(history.T_cw))


BUILT_IN: dict[str, MotionModel] = {"constant-velocity": constant_velocity, "constant-pose": constant_pose}
"""The models of torchslam, by their names in `tracking.motion_model`."""


def make_motion_model(config: Config, model: MotionModel | None = None) -> MotionModel:
    """The given model, or else the configured one. Raises ConfigError if it cannot be loaded."""
    if model is not None:
        return model
    name = "constant-pose" if config.paper.brute_force else config.tracking.motion_model
    return BUILT_IN.get(name) or load(MOTION_MODELS, name)


def run_motion_model(model: MotionModel, history: MotionHistory) -> PosePrediction:
    """Run a motion model; raises ConfigError where it predicts no pose, or something that is no covariance."""
    found: Any = model(history)
    if any(model is each for each in BUILT_IN.values()):
        return found
    name = getattr(model, "__name__", type(model).__name__)
    if not isinstance(found, PosePrediction):
        raise ConfigError(f"motion model {name}: must return PosePrediction, not {type(found).__name__}")
    T_cw, covariance = found.T_cw.to(history.T_cw), found.covariance
    eye = torch.eye(4, dtype=T_cw.dtype, device=T_cw.device)
    R = T_cw[..., :3, :3]
    if T_cw.shape != (4, 4) or not _are_close(R @ R.mT, eye[:3, :3]) or not torch.equal(T_cw[3], eye[3]):
        raise ConfigError(f"motion model {name}: T_cw must be a (4, 4) rigid transform")
    if covariance is not None:
        covariance = covariance.to(T_cw)
        if covariance.shape != (6, 6) or not _are_close(covariance, covariance.mT):
            raise ConfigError(f"motion model {name}: covariance must be a finite, symmetric (6, 6) matrix")
        if float(torch.linalg.eigvalsh(covariance)[0]) < -_TOLERANCE * float(covariance.abs().max()):
            raise ConfigError(f"motion model {name}: covariance must be positive semi-definite")
    is_exact = found.T_cw.dtype == T_cw.dtype
    return PosePrediction(T_cw if is_exact else reorthonormalized(T_cw), covariance)


def _are_close(one: Tensor, other: Tensor) -> bool:
    return bool(((one - other).abs() <= _TOLERANCE * other.abs().max()).all())


def deviating_poses(T_cw: Float[Tensor, "4 4"], covariance: Float[Tensor, "6 6"]) -> Float[Tensor, "6 4 4"]:
    """Poses that are off by one standard deviation along each axis of a covariance."""
    variances, axes = torch.linalg.eigh(covariance)
    return se3_exp((variances.clamp_min(0).sqrt() * axes).mT) @ T_cw


def squared_deviation(
    T_cw: Float[Tensor, "4 4"], covariance: Float[Tensor, "6 6"], prediction: PosePrediction
) -> float:
    """Squared distance of a pose from a prediction with a covariance, in units of the covariance of both together."""
    assert prediction.covariance is not None
    apart = se3_log(T_cw @ se3_inverse(prediction.T_cw))
    both = torch.linalg.pinv(covariance + prediction.covariance, hermitian=True)
    return float(apart @ both @ apart)
