"""Sequences in: ETH3D, TUM, KITTI and EuRoC folders, plain folders, videos, rendered scenes."""

from torchslam.data.calibration import Calibration, parse_camera, read_calibration
from torchslam.data.opening import open_sequence
from torchslam.data.sequence import Sequence
from torchslam.data.trajectory_file import read_trajectory, write_trajectory

__all__ = [
    "Calibration",
    "Sequence",
    "open_sequence",
    "parse_camera",
    "read_calibration",
    "read_trajectory",
    "write_trajectory",
]
