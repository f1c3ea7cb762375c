"""The camera from the images: refinement of it on a run's graph, and runs, in turns."""

from torchslam.calibration.intrinsics import Refinement, estimate_intrinsics
from torchslam.calibration.rounds import FoundCamera, Round, calibrate

__all__ = ["FoundCamera", "Refinement", "Round", "calibrate", "estimate_intrinsics"]
