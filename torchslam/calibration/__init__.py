"""The camera from the images: refinement of it on a run's graph, and runs, in turns."""

from torchslam.calibration.refinement import Refinement, refine
from torchslam.calibration.rounds import Calibrated, Round, calibrate

__all__ = ["Calibrated", "Refinement", "Round", "calibrate", "refine"]
