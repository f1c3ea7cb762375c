"""Folders in the layout of ETH3D-SLAM and TUM RGB-D: `rgb.txt`, `groundtruth.txt`, `calibration.txt`.

Sources: https://www.eth3d.net/slam_documentation and https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats
"""

from __future__ import annotations

import math
import re
from pathlib import Path

from torchslam.data.calibration import PRESETS, Calibration
from torchslam.data.camera_argument import GivenCamera
from torchslam.data.formats.calibration_files import read_calibration
from torchslam.data.formats.text_file import numbered_lines
from torchslam.data.readers.image_sequence import ImageEntry, ImageSequence
from torchslam.data.trajectories import read_trajectory
from torchslam.errors import SequenceError

CALIBRATION_FILES = ("calibration.txt", "calib.txt")


LOOKS_FOR = "rgb.txt (ETH3D, TUM)"
FREIBURG = re.compile(r"freiburg([123])(?!\d)")


def matches(path: str) -> bool:
    """Whether the folder has a list of images in this layout."""
    return (Path(path) / "rgb.txt").is_file()


def open(path: str, camera: GivenCamera | None, rate: float | None) -> ImageSequence:
    """A folder of ETH3D-SLAM or TUM RGB-D; `camera` overrides the folder's calibration.

    The archives of TUM contain no calibration; their name identifies the published camera.
    Raises SequenceError, CalibrationError or TrajectoryError naming file and line.
    """
    folder = Path(path)
    entries = read_image_list(folder / "rgb.txt")
    camera = camera if camera is not None else find_calibration(folder)
    robot = FREIBURG.search(folder.resolve().name)
    if camera is None and robot is not None:
        camera = PRESETS[f"tum-fr{robot[1]}"]
    truth = folder / "groundtruth.txt"
    groundtruth = read_trajectory(truth) if truth.is_file() else None
    return ImageSequence(folder.name, "ETH3D or TUM folder", entries, camera, groundtruth)


def read_image_list(path: Path) -> list[ImageEntry]:
    """The lines `timestamp file` of a list. Raises SequenceError naming file and line."""
    entries = []
    for number, line in numbered_lines(path, SequenceError):
        where = f"{path}:{number}"
        words = line.split(maxsplit=1)
        try:
            timestamp = float(words[0])
        except ValueError:
            timestamp = math.nan
        if len(words) != 2 or not math.isfinite(timestamp):
            raise SequenceError(f"{where}: expected `timestamp file`, got `{line}`")
        entries.append(ImageEntry(timestamp, path.parent / words[1], where))
    if not entries:
        raise SequenceError(f"{path}: no images are listed")
    return entries


def find_calibration(path: Path) -> Calibration | None:
    """The calibration file of a folder, if it has one."""
    for name in CALIBRATION_FILES:
        if (path / name).is_file():
            return read_calibration(path / name)
    return None
