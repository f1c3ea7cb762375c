"""Trajectory files (TUM, KITTI) and association of poses by timestamp."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchslam.data.text_file import check_later, in_seconds, number_rows
from torchslam.errors import TrajectoryError
from torchslam.geometry.lie import matrix_from_quaternion, quaternion_from_matrix, rigid, se3_interpolate
from torchslam.types import Trajectory

ORTHOGONAL = 0.05
"""Tolerated deviation of R R^T from the identity; some files have few digits."""
UNIT_LENGTH = 0.05
"""Tolerated deviation of the length of a quaternion from one."""
FARTHEST = 1e12
"""Maximum coordinate of a position, in meters."""
COLUMNS = "timestamp tx ty tz qx qy qz qw"


def read_trajectory(path: str | Path) -> Trajectory:
    """Read a TUM trajectory file; `#` starts a comment.

    Raises TrajectoryError naming file and line: a missing or empty file, not eight finite numbers, a
    quaternion far from unit length, timestamps out of order or doubled.
    """
    places: list[str] = []
    rows: list[list[float]] = []
    for where, row in number_rows(path, COLUMNS, TrajectoryError):
        row[0] = in_seconds(row[0], where, TrajectoryError)
        if rows:
            check_later(row[0], rows[-1][0], where, TrajectoryError)
        places.append(where)
        rows.append(row)
    table = torch.tensor(rows, dtype=torch.float64, device="cpu")
    return Trajectory(table[:, 0].contiguous(), poses_from_rows(table[:, 1:], places))


def poses_from_rows(rows: Float[Tensor, "N 7"], places: Sequence[str]) -> Float[Tensor, "N 4 4"]:
    """Convert rows `tx ty tz qx qy qz qw` to poses.

    Raises TrajectoryError, at the place of the row, for a quaternion far from unit length or a position beyond
    `FARTHEST`.
    """
    lengths = rows[:, 3:].norm(dim=-1, keepdim=True)
    wrong = torch.nonzero(~((lengths[:, 0] - 1).abs() <= UNIT_LENGTH))[:, 0].tolist()
    if wrong:
        raise TrajectoryError(
            f"{places[wrong[0]]}: the quaternion {rows[wrong[0], 3:].tolist()} does not have unit length"
        )
    return checked_poses(rigid(matrix_from_quaternion(rows[:, 3:] / lengths), rows[:, :3]), places)


def checked_poses(T_wc: Float[Tensor, "N 4 4"], places: Path | Sequence[str]) -> Float[Tensor, "N 4 4"]:
    """Return poses unchanged. Raises TrajectoryError for an invalid rotation or position, at its place or its file."""
    R, positions_w = T_wc[:, :3, :3], T_wc[:, :3, 3]
    error = (R @ R.mT - torch.eye(3, dtype=R.dtype, device="cpu")).abs().flatten(1).amax(1)
    for is_right, what in (
        (error < ORTHOGONAL, "a pose is not a rigid transformation"),
        (positions_w.abs().amax(1) < FARTHEST, f"a position is farther away than {FARTHEST:g}"),
    ):
        wrong = torch.nonzero(~is_right)[:, 0].tolist()  # NaN is neither
        if wrong:
            raise TrajectoryError(f"{places if isinstance(places, Path) else places[wrong[0]]}: {what}")
    return T_wc


def write_trajectory(path: str | Path, trajectory: Trajectory) -> None:
    """Write a trajectory as a TUM file: nanoseconds, nanometers, nine decimals of the quaternion."""
    T_wc = trajectory.T_wc.detach().double().cpu()
    quaternions = quaternion_from_matrix(T_wc[:, :3, :3])
    table = torch.cat((T_wc[:, :3, 3], quaternions), dim=-1).tolist()
    lines = [f"# {COLUMNS} (camera to world, seconds, meters or map units)\n"]
    for timestamp, row in zip(trajectory.timestamps.tolist(), table, strict=True):
        # The shortest text that reads back as the same time: seconds since 1970 fill all digits of a double.
        lines.append(f"{round(timestamp, 9)!r} " + " ".join(f"{value:.9f}" for value in row) + "\n")
    Path(path).write_text("".join(lines), encoding="utf-8")


def nearest(
    timestamps: Float[Tensor, " N"], reference: Float[Tensor, " M"]
) -> tuple[Int[Tensor, " N"], Float[Tensor, " N"]]:
    """Find the nearest reference time of each timestamp; of two equally near ones, the earlier.

    Args:
        timestamps: seconds.
        reference: seconds, sorted, at least one.

    Returns:
        Indices into `reference`, and distances in seconds.
    """
    right = _next(timestamps, reference)
    left = (right - 1).clamp(min=0)
    to_left, to_right = (timestamps - reference[left]).abs(), (timestamps - reference[right]).abs()
    return torch.where(to_left <= to_right, left, right), torch.minimum(to_left, to_right)


def interpolate_poses(
    trajectory: Trajectory, timestamps: Float[Tensor, " N"], tolerance: float
) -> tuple[Float[Tensor, "N 4 4"], Bool[Tensor, " N"]]:
    """Interpolate a trajectory along the geodesic between the two neighboring poses; constant beyond its ends.

    Args:
        trajectory: the poses.
        timestamps: seconds.
        tolerance: seconds to the nearest pose up to which the result is valid.

    Returns:
        T_wc, finite also where invalid, and validity.
    """
    times = trajectory.timestamps
    _, distances = nearest(timestamps, times)
    right = _next(timestamps, times)
    left = (right - 1).clamp(min=0)
    interval = times[right] - times[left]
    fraction = ((timestamps - times[left]) / torch.where(interval > 0, interval, 1.0)).clamp(0, 1)
    T_wc = se3_interpolate(trajectory.T_wc[left], trajectory.T_wc[right], fraction.to(trajectory.T_wc))
    # At a pose's own time and beyond the ends it is taken as it is, without the rounding of log and exp.
    exact = ((fraction >= 1) | (interval == 0))[:, None, None]
    return torch.where(exact, trajectory.T_wc[right], T_wc), distances <= tolerance


def _next(timestamps: Float[Tensor, " N"], reference: Float[Tensor, " M"]) -> Int[Tensor, " N"]:
    """Return the index of the first reference time at or after each timestamp, or the last one."""
    return torch.searchsorted(reference.contiguous(), timestamps.contiguous()).clamp(max=len(reference) - 1)


POSES, TIMES = "poses.txt", "times.txt"


def write_kitti(folder: Path, trajectory: Trajectory) -> None:
    """Write poses.txt and times.txt in KITTI odometry format: camera to world, one line per posed frame.

    The format has no place for frames without a pose; times.txt identifies the frames.
    """
    folder.mkdir(parents=True, exist_ok=True)
    rows = trajectory.T_wc[:, :3].flatten(1).tolist()
    poses = [" ".join(f"{value:.9e}" for value in row) + "\n" for row in rows]
    times = [f"{time!r}\n" for time in trajectory.timestamps.tolist()]
    (folder / POSES).write_text("".join(poses), encoding="utf-8")
    (folder / TIMES).write_text("".join(times), encoding="utf-8")
