"""evo reads what is written in the formats of TUM and KITTI."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from torchslam.data.trajectories import write_kitti, write_trajectory
from torchslam.types import Trajectory


def test_evo_reads_kitti_and_tum(tmp_path: Path, trajectory: Trajectory) -> None:
    evo = pytest.importorskip("evo.tools.file_interface", reason="evo is not installed")
    write_kitti(tmp_path / "kitti", trajectory)
    write_trajectory(tmp_path / "trajectory.txt", trajectory)
    timed = evo.read_tum_trajectory_file(str(tmp_path / "trajectory.txt"))
    for path in (evo.read_kitti_poses_file(str(tmp_path / "kitti" / "poses.txt")), timed):
        np.testing.assert_allclose(np.stack(path.poses_se3), trajectory.T_wc.numpy(), atol=1e-8)
    for times in (np.loadtxt(tmp_path / "kitti" / "times.txt"), timed.timestamps):
        np.testing.assert_allclose(times, trajectory.timestamps.numpy(), atol=1e-9)
