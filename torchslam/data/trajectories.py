"""Trajectory files (TUM, KITTI) and association of poses by timestamp."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchslam.data.text_file import check_rising, float64, in_seconds, number_rows, read_text
from torchslam.errors import TrajectoryError
from torchslam.geometry.lie import matrix_from_quaternion, quaternion_from_matrix, rigid, se3_interpolate
from torchslam.types import Trajectory

ORTHOGONAL = 0.05
"""Tolerated deviation of R R^T from the identity, and of quaternions from length one; some files have few digits."""
FARTHEST = 1e12  # maximum coordinate of a position, in meters
COLUMNS = "timestamp tx ty tz qx qy qz qw"


def read_trajectory(path: str | Path) -> Trajectory:
    """Read a TUM trajectory file; `#` starts a comment.

    Raises TrajectoryError naming file and line: a missing or empty file, not eight finite numbers, a
    quaternion far from unit length, timestamps out of order or doubled, a comment with another order of the columns.
    """
    if re.search(r"(?m)^#.*\bq\w*w\b\W+q\w*x\b", read_text(path, TrajectoryError)):
        raise TrajectoryError(
            f"{path}: quaternions begin with qw, as a comment says; the columns must be {COLUMNS}"
        )
    places, rows = zip(*number_rows(path, COLUMNS, TrajectoryError), strict=True)
    times = [in_seconds(row[0], where, TrajectoryError) for where, row in zip(places, rows, strict=True)]
    check_rising(times, places, TrajectoryError)
    return Trajectory(float64(times), poses_from_rows(float64(rows)[:, 1:], places))


def poses_from_rows(rows: Float[Tensor, "N 7"], places: Sequence[str]) -> Float[Tensor, "N 4 4"]:
    """Convert rows `tx ty tz qx qy qz qw` to poses.

    Raises TrajectoryError, at the place of the row, for a quaternion far from unit length, and as `checked_poses`.
    """
    lengths = rows[:, 3:].norm(dim=-1, keepdim=True)
    _check((lengths[:, 0] - 1).abs() <= ORTHOGONAL, places, "a quaternion does not have unit length")
    return checked_poses(rigid(matrix_from_quaternion(rows[:, 3:] / lengths), rows[:, :3]), places)


def checked_poses(T_wc: Float[Tensor, "N 4 4"], places: Path | Sequence[str]) -> Float[Tensor, "N 4 4"]:
    """Return poses unchanged. Raises TrajectoryError for an invalid rotation or position, at its place or its file."""
    is_rigid = orthogonality_error(T_wc[:, :3, :3]) < ORTHOGONAL
    _check(is_rigid, places, "a pose is not a rigid transformation")
    is_proper = torch.linalg.det(T_wc[:, :3, :3]) > 0
    _check(
        is_proper,
        places,
        f"{int((~is_proper).sum())} of {len(T_wc)} poses are mirrored (determinant -1), which no camera can be: "
        "reverse one axis of the world, or of the camera, in all of them",
    )
    is_near = T_wc[:, :3, 3].abs().amax(1) < FARTHEST
    _check(is_near, places, f"a position is farther away than {FARTHEST:g}")
    return T_wc


def _check(is_right: Bool[Tensor, " N"], places: Path | Sequence[str], what: str) -> None:
    """Raise TrajectoryError for the first row that is not right; NaN never is."""
    if not is_right.all():
        first = int(torch.nonzero(~is_right)[0])
        raise TrajectoryError(f"{places if isinstance(places, Path) else places[first]}: {what}")


def orthogonality_error(R: Float[Tensor, "... 3 3"]) -> Float[Tensor, " ..."]:
    """Return the largest deviation of an element of R R^T from the identity."""
    return (R @ R.mT - torch.eye(3, dtype=R.dtype, device="cpu")).abs().flatten(-2).amax(-1)


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

    `reference` is sorted and not empty. Returns indices into it, and distances, seconds.
    """
    right = _next(timestamps, reference)
    left = (right - 1).clamp(min=0)
    to_left, to_right = (timestamps - reference[left]).abs(), (timestamps - reference[right]).abs()
    return torch.where(to_left <= to_right, left, right), torch.minimum(to_left, to_right)


def interpolate_poses(
    trajectory: Trajectory, timestamps: Float[Tensor, " N"], tolerance: float
) -> tuple[Float[Tensor, "N 4 4"], Bool[Tensor, " N"]]:
    """Interpolate a trajectory along the geodesic between the two neighboring poses; constant beyond its ends.

    Returns T_wc, finite also where invalid, and validity: `tolerance` seconds or less to the nearest pose.
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


def write_kitti(folder: Path, trajectory: Trajectory) -> None:
    """Write poses.txt and times.txt in KITTI odometry format: camera to world, one line per posed frame.

    The format has no place for frames without a pose; times.txt identifies the frames.
    """
    folder.mkdir(parents=True, exist_ok=True)
    rows = trajectory.T_wc[:, :3].flatten(1).tolist()
    poses = [" ".join(f"{value:.9e}" for value in row) + "\n" for row in rows]
    times = [f"{time!r}\n" for time in trajectory.timestamps.tolist()]
    (folder / "poses.txt").write_text("".join(poses), encoding="utf-8")
    (folder / "times.txt").write_text("".join(times), encoding="utf-8")
