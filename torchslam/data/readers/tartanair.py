"""Folders of TartanAir: `image_left/` and `pose_left.txt`, in version 2 with `lcam_front` in place of `left`.

Source: https://github.com/castacks/tartanair_tools/blob/master/data_type.md: poses are camera to world, in a frame
whose x points forward, y to the right and z down.
"""

from __future__ import annotations

from pathlib import Path

import torch

from torchslam.data.calibration import PRESETS
from torchslam.data.camera_argument import GivenCamera
from torchslam.data.formats.frame_names import find_frames
from torchslam.data.formats.text_file import numbered_lines, parse_floats
from torchslam.data.readers.folder import DEFAULT_RATE, at_rate
from torchslam.data.readers.image_sequence import ImageSequence
from torchslam.data.trajectories import checked_poses
from torchslam.errors import TrajectoryError
from torchslam.geometry.lie import matrix_from_quaternion, rigid
from torchslam.types import Trajectory

LOOKS_FOR = "image_left/ with pose_left.txt (TartanAir)"
CAMERAS = ("left", "lcam_front")
AXES = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
"""The axes of our cameras, right, down, forward, as columns in the dataset's: forward, right, down."""


def matches(path: str) -> bool:
    """Whether the folder is a trajectory (`P000`) of the dataset."""
    return _camera(Path(path)) is not None


def open(path: str, camera: GivenCamera | None, rate: float | None) -> ImageSequence:
    """The left camera of a trajectory; the dataset has no times, so that `rate` or 30 frames per second are taken.

    Raises SequenceError, CalibrationError or TrajectoryError naming file and line.
    """
    folder = Path(path)
    name = _camera(folder) or CAMERAS[0]
    found = find_frames(folder / f"image_{name}")
    entries = at_rate(found.frames, rate or DEFAULT_RATE)
    truth = _read_poses(folder / f"pose_{name}.txt", [entry.timestamp for entry in entries])
    camera = PRESETS["tartanair"] if camera is None else camera
    return ImageSequence(folder.name, "TartanAir folder", entries, camera, truth, found.notes)


def _camera(folder: Path) -> str | None:
    for name in CAMERAS:
        if (folder / f"image_{name}").is_dir() and (folder / f"pose_{name}.txt").is_file():
            return name
    return None


def _read_poses(path: Path, times: list[float]) -> Trajectory:
    """One line `tx ty tz qx qy qz qw` per frame."""
    rows = []
    for number, line in numbered_lines(path, TrajectoryError):
        row = parse_floats(line, f"{path}:{number}", TrajectoryError)
        if len(row) != 7 or abs(sum(value * value for value in row[3:]) - 1.0) > 0.1:
            raise TrajectoryError(
                f"{path}:{number}: expected `tx ty tz qx qy qz qw` of unit length, got `{line}`"
            )
        rows.append(row)
    if len(rows) != len(times):
        raise TrajectoryError(f"{path}: {len(rows)} poses for {len(times)} images")
    table = torch.tensor(rows, dtype=torch.float64)
    quaternions = table[:, 3:] / table[:, 3:].norm(dim=-1, keepdim=True)
    R = matrix_from_quaternion(quaternions) @ torch.tensor(AXES, dtype=torch.float64)
    T_wc = checked_poses(rigid(R, table[:, :3]), path)
    return Trajectory(torch.tensor(times, dtype=torch.float64), T_wc)
