"""evo reads what is written in the formats of TUM and KITTI."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from torchslam.data.trajectories import write_kitti, write_trajectory
from torchslam.types import Trajectory


def test_evo_reads_kitti(tmp_path: Path, trajectory: Trajectory) -> None:
    evo = pytest.importorskip("evo.tools.file_interface", reason="evo is not installed")
    write_kitti(tmp_path / "kitti", trajectory)
    path = evo.read_kitti_poses_file(str(tmp_path / "kitti" / "poses.txt"))
    np.testing.assert_allclose(np.stack(path.poses_se3), trajectory.T_wc.numpy(), atol=1e-8)
    assert path.check()[0]
    times = np.loadtxt(tmp_path / "kitti" / "times.txt")
    np.testing.assert_array_equal(times, trajectory.timestamps.numpy())


def test_evo_reads_tum(tmp_path: Path, trajectory: Trajectory) -> None:
    evo = pytest.importorskip("evo.tools.file_interface", reason="evo is not installed")
    write_trajectory(tmp_path / "trajectory.txt", trajectory)
    path = evo.read_tum_trajectory_file(str(tmp_path / "trajectory.txt"))
    np.testing.assert_allclose(np.stack(path.poses_se3), trajectory.T_wc.numpy(), atol=1e-8)
    np.testing.assert_allclose(path.timestamps, trajectory.timestamps.numpy(), atol=1e-9)
