"""Trajectory files: written and read back, and every bad line."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from torchslam.data import read_trajectory, write_trajectory
from torchslam.errors import TrajectoryError
from torchslam.geometry.lie import se3_exp
from torchslam.types import Trajectory


def test_round_trip(tmp_path: Path, generator: torch.Generator) -> None:
    xi = torch.randn(50, 6, generator=generator, dtype=torch.float64) * 2
    timestamps = 1403636584.763556 + torch.arange(50, dtype=torch.float64) * 0.05
    write_trajectory(tmp_path / "trajectory.txt", Trajectory(timestamps, se3_exp(xi)))
    read = read_trajectory(tmp_path / "trajectory.txt")
    assert torch.equal(read.timestamps, timestamps)
    torch.testing.assert_close(read.T_wc, se3_exp(xi), atol=1e-8, rtol=0)


def test_known_values(tmp_path: Path) -> None:
    file = tmp_path / "t.txt"
    file.write_text(
        "# comment\n\n0.5 1 2 3 0 0 0.7071067811865476 0.7071067811865476 # a quarter turn about z\n"
    )
    trajectory = read_trajectory(file)
    assert trajectory.timestamps.tolist() == [0.5]
    expected = torch.tensor([[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]], dtype=torch.float64)
    torch.testing.assert_close(trajectory.T_wc[0], expected)


def test_a_trajectory_with_a_graph_is_written(tmp_path: Path) -> None:
    T_wc = se3_exp(torch.zeros(2, 6, dtype=torch.float64, requires_grad=True))
    write_trajectory(tmp_path / "t.txt", Trajectory(torch.tensor([0.0, 1.0], dtype=torch.float64), T_wc))
    assert len(read_trajectory(tmp_path / "t.txt")) == 2


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("2 0 0 0 0 0 1", "got 7 numbers"),
        ("2 0 0 0 0 0 0 1 9", "got 9 numbers"),
        ("2 0 0 0 0 0 0 x", "`x` is not a number"),
        ("2 0 nan 0 0 0 0 1", "`nan` is not a finite number"),
        ("2 0 0 0 0 0 0 0", "does not have unit length"),
        ("1 0 0 0 0 0 0 1", "timestamp 1.0 repeats the one before"),
        ("0.5 0 0 0 0 0 0 1", "timestamp 0.5 is earlier than the one before"),
    ],
)
def test_bad_line(tmp_path: Path, line: str, message: str) -> None:
    file = tmp_path / "bad.txt"
    file.write_text(f"# header\n1 0 0 0 0 0 0 1\n{line}\n")
    with pytest.raises(TrajectoryError, match=rf"bad\.txt:3: .*{message}"):
        read_trajectory(file)


def test_a_comment_with_another_order_of_the_columns_is_refused(tmp_path: Path) -> None:
    for names in (
        "timestamp tx ty tz qw qx qy qz",
        "timestamp [ns], p_x [m], p_y [m], p_z [m], q_RS_w [], q_RS_x []",
    ):
        (tmp_path / "t.txt").write_text(f"# {names}\n0 0 0 0 1 0 0 0\n")
        with pytest.raises(TrajectoryError, match="quaternions begin with qw"):
            read_trajectory(tmp_path / "t.txt")


def test_empty_and_missing(tmp_path: Path) -> None:
    (tmp_path / "empty.txt").write_text("# nothing\n")
    with pytest.raises(TrajectoryError, match=r"empty\.txt: is empty; expected"):
        read_trajectory(tmp_path / "empty.txt")
    with pytest.raises(TrajectoryError, match=r"missing\.txt: cannot be read"):
        read_trajectory(tmp_path / "missing.txt")
