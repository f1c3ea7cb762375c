"""Trajectory files in TUM format: `timestamp tx ty tz qx qy qz qw`, camera to world, meters, seconds."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from torchslam.data.formats.text_file import check_later, numbered_lines, parse_floats
from torchslam.errors import TrajectoryError
from torchslam.geometry.lie import matrix_from_quaternion, quaternion_from_matrix, rigid
from torchslam.types import Trajectory

ORTHOGONAL = 0.05
"""How far R R^T of a pose may be from the identity: some are printed with few digits."""
FARTHEST = 1e12
"""Of a position: meters to beyond Neptune."""
COLUMNS = "timestamp tx ty tz qx qy qz qw"


def read_trajectory(path: str | Path) -> Trajectory:
    """A trajectory from a TUM file; `#` starts a comment.

    Raises TrajectoryError naming file and line: a missing or empty file, not eight finite numbers, a
    quaternion far from unit length, timestamps out of order or doubled.
    """
    rows: list[list[float]] = []
    for number, line in numbered_lines(path, TrajectoryError):
        where = f"{path}:{number}"
        row = parse_floats(line, where, TrajectoryError)
        if len(row) != 8:
            raise TrajectoryError(
                f"{where}: expected `timestamp tx ty tz qx qy qz qw`, got {len(row)} numbers"
            )
        if abs(sum(value * value for value in row[4:]) - 1.0) > 0.1:
            raise TrajectoryError(f"{where}: the quaternion {row[4:]} does not have unit length")
        if rows:
            check_later(row[0], rows[-1][0], where, TrajectoryError)
        rows.append(row)
    if not rows:
        raise TrajectoryError(f"{path}: no poses")
    table = torch.tensor(rows, dtype=torch.float64)
    quaternions = table[:, 4:] / table[:, 4:].norm(dim=-1, keepdim=True)
    T_wc = checked_poses(rigid(matrix_from_quaternion(quaternions), table[:, 1:4]), path)
    return Trajectory(table[:, 0].contiguous(), T_wc)


def checked_poses(T_wc: Tensor, path: Path | str) -> Tensor:
    """Poses (..., 4, 4) as they are. Raises TrajectoryError for one that is no rotation, or is out of this world."""
    R, positions_w = T_wc[..., :3, :3], T_wc[..., :3, 3]
    error = (R @ R.mT - torch.eye(3, dtype=R.dtype)).abs()
    if not bool((error < ORTHOGONAL).all()):  # not so NaN either
        raise TrajectoryError(f"{path}: a pose that is no rotation and translation")
    if not bool((positions_w.abs() < FARTHEST).all()):
        raise TrajectoryError(f"{path}: a position farther off than {FARTHEST:g}")
    return T_wc


def write_trajectory(path: str | Path, trajectory: Trajectory) -> None:
    """Write a trajectory as a TUM file: nanoseconds, nanometers, nine decimals of the quaternion."""
    T_wc = trajectory.T_wc.detach().double().cpu()
    quaternions = quaternion_from_matrix(T_wc[:, :3, :3])
    table = torch.cat((T_wc[:, :3, 3], quaternions), dim=-1).tolist()
    lines = [f"# {COLUMNS} (camera to world, seconds, meters)\n"]
    for timestamp, row in zip(trajectory.timestamps.tolist(), table, strict=True):
        # The shortest text that reads back as the same time: seconds since 1970 fill all digits of a double.
        lines.append(f"{round(timestamp, 9)!r} " + " ".join(f"{value:.9f}" for value in row) + "\n")
    Path(path).write_text("".join(lines), encoding="utf-8")
