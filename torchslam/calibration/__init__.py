"""The camera from images: its focal length from pairs of them, its intrinsics from the graph of a run."""

from torchslam.calibration.from_pairs import search_focal
from torchslam.calibration.intrinsics import IntrinsicsEstimate, estimate_intrinsics

__all__ = ["IntrinsicsEstimate", "estimate_intrinsics", "search_focal"]
