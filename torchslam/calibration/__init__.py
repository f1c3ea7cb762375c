"""Calibration from images: runs alternate with estimation of the intrinsics on their graphs."""

from torchslam.calibration.intrinsics import IntrinsicsEstimate, estimate_intrinsics
from torchslam.calibration.rounds import CalibrationResult, CalibrationRound, calibrate

__all__ = ["CalibrationResult", "CalibrationRound", "IntrinsicsEstimate", "calibrate", "estimate_intrinsics"]
