"""KITTI's odometry format: the upper three rows of each pose, camera to world, and the times in a file beside them."""

from __future__ import annotations

from pathlib import Path

from torchslam.types import Trajectory

POSES, TIMES = "poses.txt", "times.txt"


def write_kitti(folder: Path, trajectory: Trajectory) -> None:
    """Write poses.txt and times.txt, one line a posed frame, into a folder that is made if need be.

    The format has no place for frames without a pose: times.txt says which frames the lines are of.
    """
    folder.mkdir(parents=True, exist_ok=True)
    rows = trajectory.T_wc[:, :3].flatten(1).tolist()
    poses = [" ".join(f"{value:.9e}" for value in row) + "\n" for row in rows]
    times = [f"{time!r}\n" for time in trajectory.timestamps.tolist()]
    (folder / POSES).write_text("".join(poses), encoding="utf-8")
    (folder / TIMES).write_text("".join(times), encoding="utf-8")
