"""Folders of the 7-Scenes dataset: `frame-000000.color.png`, `.depth.png` and `.pose.txt` side by side.

Source: https://www.microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes/
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from torchslam.data.calibration import PRESETS
from torchslam.data.camera_argument import GivenCamera
from torchslam.data.formats.frame_names import match_pattern
from torchslam.data.formats.text_file import numbered_lines, parse_floats
from torchslam.data.readers.folder import DEFAULT_RATE, at_rate
from torchslam.data.readers.image_sequence import ImageSequence
from torchslam.data.trajectories import checked_poses
from torchslam.errors import TrajectoryError
from torchslam.types import Trajectory

LOOKS_FOR = "frame-*.color.png (7-Scenes)"
COLOR = "frame-*.color.png"
ORTHOGONAL = 0.05
"""How far R R^T of a pose may be from the identity; fused poses are printed with few digits."""


def matches(path: str) -> bool:
    """Whether the folder has color frames of this dataset's names."""
    return Path(path).is_dir() and next(Path(path).glob(COLOR), None) is not None


def open(path: str, camera: GivenCamera | None, rate: float | None) -> ImageSequence:
    """One sequence (`seq-01`), at the Kinect's 30 frames per second, with the poses of its depth camera.

    The dataset gives no calibration of the color camera; without `camera` its nominal focal length is a guess.
    Raises SequenceError, CalibrationError or TrajectoryError naming the file.
    """
    folder = Path(path)
    found = match_pattern(str(folder / COLOR))
    entries = at_rate(found.frames, rate or DEFAULT_RATE)
    times: list[float] = []
    poses: list[Tensor] = []
    for entry in entries:
        pose = entry.path.with_name(entry.path.name.replace(".color.png", ".pose.txt"))
        T_wc = _read_pose(pose) if pose.is_file() else None
        if T_wc is not None:
            times.append(entry.timestamp)
            poses.append(T_wc)
    groundtruth = None
    if poses:
        groundtruth = Trajectory(torch.tensor(times, dtype=torch.float64), torch.stack(poses))
    camera = PRESETS["7-scenes"] if camera is None else camera
    name = f"{folder.resolve().parent.name}/{folder.name}" if folder.name.startswith("seq-") else folder.name
    return ImageSequence(name, "7-Scenes folder", entries, camera, groundtruth, found.notes)


def _read_pose(path: Path) -> Tensor | None:
    """(4, 4) T_wc; None where tracking had failed: the dataset then writes numbers that are no rotation."""
    rows = []
    for number, line in numbered_lines(path, TrajectoryError):
        if "nan" in line.lower() or "inf" in line.lower():
            return None
        rows.append(parse_floats(line, f"{path}:{number}", TrajectoryError))
    if [len(row) for row in rows] != [4, 4, 4, 4]:
        raise TrajectoryError(f"{path}: expected four lines of four numbers")
    T_wc = torch.tensor(rows, dtype=torch.float64)
    R = T_wc[:3, :3]
    if (R @ R.mT - torch.eye(3, dtype=R.dtype)).abs().max() > ORTHOGONAL:
        return None
    # The nearest rotation: poses are printed with few digits.
    U, _, Vh = torch.linalg.svd(R)
    T_wc[:3, :3] = U @ Vh
    return checked_poses(T_wc, path)
