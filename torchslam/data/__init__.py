"""Sequences in: folders of datasets and of images, videos, recordings, live cameras, rendered scenes."""

from torchslam.data.calibration import Calibration
from torchslam.data.formats.calibration_files import parse_camera, read_calibration
from torchslam.data.opening import open_sequence
from torchslam.data.sequence import Calibrated, EndOfSequence, Sequence
from torchslam.data.trajectories import read_trajectory, write_trajectory

__all__ = [
    "Calibrated",
    "Calibration",
    "EndOfSequence",
    "Sequence",
    "open_sequence",
    "parse_camera",
    "read_calibration",
    "read_trajectory",
    "write_trajectory",
]
