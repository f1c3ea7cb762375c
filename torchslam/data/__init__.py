"""Sequences in: folders of datasets and of images, videos, recordings, live cameras, rendered scenes."""

from typing import TYPE_CHECKING

from torchslam.utils.lazy import lazy_names

if TYPE_CHECKING:
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

# The system needs sequences alone, and not the readers of all formats.
__getattr__ = lazy_names(
    __name__,
    {
        "torchslam.data.calibration": "Calibration",
        "torchslam.data.formats.calibration_files": "parse_camera read_calibration",
        "torchslam.data.opening": "open_sequence",
        "torchslam.data.sequence": "Calibrated EndOfSequence Sequence",
        "torchslam.data.trajectories": "read_trajectory write_trajectory",
    },
)
