"""Folders of the KITTI odometry benchmark: `image_0/`, `times.txt`, `calib.txt`, poses next to the sequences.

Source: the development kit of https://www.cvlibs.net/datasets/kitti/eval_odometry.php
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from torchslam.data.calibration import Calibration
from torchslam.data.camera_argument import GivenCamera
from torchslam.data.formats.frame_names import find_frames
from torchslam.data.formats.text_file import numbered_lines, parse_floats
from torchslam.data.readers.image_sequence import ImageEntry, ImageSequence
from torchslam.data.trajectories import checked_poses
from torchslam.errors import CalibrationError, SequenceError, TrajectoryError
from torchslam.types import Trajectory

LOOKS_FOR = "image_0/ or image_2/ with times.txt (KITTI odometry)"
CAMERAS = ("image_0", "image_2")
"""The left cameras, gray and color."""


def matches(path: str) -> bool:
    """True for a sequence of the odometry benchmark."""
    return (Path(path) / "times.txt").is_file() and any((Path(path) / name).is_dir() for name in CAMERAS)


def open(path: str, camera: GivenCamera | None, rate: float | None) -> ImageSequence:
    """A KITTI odometry sequence, left gray images before left color ones; `camera` overrides `calib.txt`.

    Ground truth, if any, comes from `poses.txt` in the folder, or `poses/NN.txt` next to `sequences/NN`.
    Raises SequenceError, CalibrationError or TrajectoryError naming file and line.
    """
    base = Path(path)
    folder = next(base / name for name in CAMERAS if (base / name).is_dir())
    times = _read_rows(base / "times.txt", 1, SequenceError)[:, 0]
    found = find_frames(folder)
    images = found.frames
    if len(images) != len(times):
        raise SequenceError(
            f"{path}: times.txt has {len(times)} lines, {folder.name}/ has {len(images)} images"
        )
    entries = [
        ImageEntry(time, image, f"{base / 'times.txt'}:{line}")
        for line, (time, image) in enumerate(zip(times.tolist(), images, strict=True), start=1)
    ]
    offset_x = 0.0
    if camera is None:
        camera, offset_x = _read_projection(base / "calib.txt", f"P{folder.name[-1]}")
    groundtruth = _read_poses(base, times, offset_x)
    kind = f"KITTI odometry, {folder.name}"
    return ImageSequence(base.name, kind, entries, camera, groundtruth, found.notes)


def _read_projection(path: Path, label: str) -> tuple[Calibration, float]:
    """The rectified camera K [I | t] of a line `P0: ...` and t_x, meters, its offset from camera 0."""
    for number, line in numbered_lines(path, CalibrationError):
        if not line.startswith(f"{label}:"):
            continue
        where = f"{path}:{number}"
        P = parse_floats(line.split(":", 1)[1], where, CalibrationError)
        if len(P) != 12:
            raise CalibrationError(f"{where}: expected the 12 numbers of a 3x4 projection, got {len(P)}")
        calibration = Calibration.from_numbers([P[0], P[5], P[2], P[6]], where)
        return calibration, (P[3] - P[2] * P[11]) / P[0]
    raise CalibrationError(f"{path}: no line `{label}: ...`")


def _read_poses(path: Path, times: Tensor, offset_x: float) -> Trajectory | None:
    """The poses of camera 0, shifted to the camera that took the images."""
    resolved = path.resolve()
    candidates = (path / "poses.txt", resolved.parent.parent / "poses" / f"{resolved.name}.txt")
    found = next((candidate for candidate in candidates if candidate.is_file()), None)
    if found is None:
        return None
    rows = _read_rows(found, 12, TrajectoryError)
    if len(rows) != len(times):
        raise TrajectoryError(f"{found}: {len(rows)} poses for {len(times)} times")
    T_w0 = torch.eye(4, dtype=torch.float64).repeat(len(rows), 1, 1)
    T_w0[:, :3] = rows.view(-1, 3, 4)
    T_0c = torch.eye(4, dtype=torch.float64)
    T_0c[0, 3] = -offset_x
    return Trajectory(times, checked_poses(T_w0 @ T_0c, found))


def _read_rows(path: Path, columns: int, error: type[SequenceError] | type[TrajectoryError]) -> Tensor:
    """(N, columns) numbers, one row a line."""
    rows = []
    for number, line in numbered_lines(path, error):
        row = parse_floats(line, f"{path}:{number}", error)
        if len(row) != columns:
            raise error(f"{path}:{number}: expected {columns} numbers, got {len(row)}")
        rows.append(row)
    if not rows:
        raise error(f"{path}: is empty")
    return torch.tensor(rows, dtype=torch.float64)
