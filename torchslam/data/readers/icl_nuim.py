"""Folders of ICL-NUIM in their TUM-compatible form: `rgb/`, `associations.txt`, `*.gt.freiburg`.

Source: https://www.doc.ic.ac.uk/~ahanda/VaFRIC/iclnuim.html. Frames are numbered, 30 a second, in place of times. The
published camera has a negative fy: its y axis points up. Here it points down, so that camera and world are mirrored.
"""

from __future__ import annotations

from pathlib import Path

import torch

from torchslam.data.calibration import PRESETS
from torchslam.data.camera_argument import GivenCamera
from torchslam.data.formats.frame_names import find_frames
from torchslam.data.formats.text_file import parse_count
from torchslam.data.readers.folder import DEFAULT_RATE
from torchslam.data.readers.image_sequence import ImageEntry, ImageSequence
from torchslam.data.trajectories import read_trajectory
from torchslam.errors import SequenceError
from torchslam.types import Trajectory

LOOKS_FOR = "rgb/ with *.gt.freiburg (ICL-NUIM)"
TRUTH = "*.gt.freiburg"
MIRROR = (1.0, -1.0, 1.0, 1.0)


def matches(path: str) -> bool:
    """Whether the folder has a trajectory under this dataset's name, and images."""
    return (Path(path) / "rgb").is_dir() and next(Path(path).glob(TRUTH), None) is not None


def open(path: str, camera: GivenCamera | None, rate: float | None) -> ImageSequence:
    """A trajectory of the living room or the office.

    Raises SequenceError, CalibrationError or TrajectoryError naming the file.
    """
    folder = Path(path)
    rate = rate or DEFAULT_RATE
    found = find_frames(folder / "rgb")
    unnumbered = [file for file in found.frames if parse_count(file.stem) is None]
    if unnumbered:
        raise SequenceError(f"{unnumbered[0]}: frames of ICL-NUIM are named by their number")
    entries = [ImageEntry(int(file.stem) / rate, file, str(file)) for file in found.frames]
    numbered = read_trajectory(sorted(folder.glob(TRUTH))[0])
    mirror = torch.diag(torch.tensor(MIRROR, dtype=torch.float64))
    groundtruth = Trajectory(numbered.timestamps / rate, mirror @ numbered.T_wc @ mirror)
    camera = PRESETS["icl"] if camera is None else camera
    return ImageSequence(folder.name, "ICL-NUIM folder", entries, camera, groundtruth, found.notes)
