"""KITTI odometry folders."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from tests.fuzz import valid_inputs
from tests.fuzz.valid_inputs import place
from torchslam.data import open_sequence
from torchslam.errors import CalibrationError, SequenceError, TrajectoryError

P0 = "P0: 70 0 31 0 0 71 23 0 0 0 1 0"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """dataset/sequences/03 with three gray images, and dataset/poses/03.txt, with a turn to the right by 90 degrees."""
    folder = place(tmp_path / "dataset" / "sequences" / "03", valid_inputs.kitti())
    poses = tmp_path / "dataset" / "poses"
    poses.mkdir()
    (folder / "poses.txt").rename(poses / "03.txt")
    return folder


def test_reads_frames_camera_and_poses(folder: Path) -> None:
    sequence = open_sequence(folder)
    assert (len(sequence), sequence.name, sequence.kind) == (3, "03", "KITTI odometry, image_0")
    assert sequence.camera.params.tolist() == [70.0, 71.0, 31.0, 23.0]
    assert sequence[1].timestamp == 0.103743
    assert sequence.groundtruth is not None
    assert sequence.groundtruth.positions_w.tolist() == [[0, 0, 0], [5, 0, 0], [0, 0, 2]]
    point_w = torch.tensor([5.0, 0, 0, 1], dtype=torch.float64)
    torch.testing.assert_close(
        (sequence[1].T_cw_groundtruth @ point_w)[:3], torch.zeros(3, dtype=torch.float64)
    )


def test_poses_are_those_of_the_color_camera(folder: Path) -> None:
    (folder / "image_0").rename(folder / "image_2")
    sequence = open_sequence(folder)
    # P2 = K [I | t] with t_x = 4.2 / 70 m: the camera sits 6 cm to the left, seen in its own axes.
    assert sequence.groundtruth is not None
    torch.testing.assert_close(
        sequence.groundtruth.positions_w,
        torch.tensor([[-0.06, 0, 0], [5, 0, 0.06], [-0.06, 0, 2]], dtype=torch.float64),
    )


def test_poses_in_the_folder_come_first_and_none_is_fine(folder: Path) -> None:
    other = folder.parent.parent / "poses" / "03.txt"
    (folder / "poses.txt").write_text("1 0 0 7 0 1 0 0 0 0 1 0\n" * 3)
    groundtruth = open_sequence(folder).groundtruth
    assert groundtruth is not None
    assert groundtruth.positions_w[:, 0].tolist() == [7.0, 7.0, 7.0]
    (folder / "poses.txt").unlink()
    other.unlink()
    assert open_sequence(folder).groundtruth is None


def test_relative_paths_find_the_poses(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    assert open_sequence(".").groundtruth is not None


@pytest.mark.parametrize(
    ("file", "text", "error", "message"),
    [
        ("times.txt", "0\n0.1\n", SequenceError, r"times\.txt has 2 lines, image_0/ has 3 images"),
        ("times.txt", "0\n0.1\n0.1\n", SequenceError, r"times\.txt:3: timestamp 0.1 repeats"),
        ("times.txt", "0\nabc\n0.2\n", SequenceError, r"times\.txt:2: `abc` is not a number"),
        ("times.txt", "", SequenceError, r"times\.txt: is empty"),
        ("calib.txt", "P1: 1 2 3\n", CalibrationError, r"calib\.txt: expected a line `P0:` of 12 numbers"),
        ("calib.txt", "P0: 70 0 31\n", CalibrationError, r"calib\.txt: expected a line `P0:` of 12 numbers"),
        (
            "calib.txt",
            P0.replace("70", "-70"),
            CalibrationError,
            r"calib\.txt: focal lengths must be positive",
        ),
        ("calib.txt", P0.replace("70", "nan"), CalibrationError, r"calib\.txt:1: `nan`"),
        ("poses.txt", "1 0 0 7 0 1 0 0 0 0 1 0\n", TrajectoryError, r"poses\.txt: 1 poses for 3 times"),
        ("poses.txt", "1 0 0\n", TrajectoryError, r"poses\.txt:1: expected .* got 3 numbers"),
    ],
)
def test_bad_files(folder: Path, file: str, text: str, error: type[Exception], message: str) -> None:
    (folder / file).write_text(text)
    with pytest.raises(error, match=message):
        open_sequence(folder)


def test_given_camera_needs_no_calibration(folder: Path) -> None:
    (folder / "calib.txt").unlink()
    assert float(open_sequence(folder, camera="50,50,32,24").camera.fx) == 50.0
    with pytest.raises(CalibrationError, match=r"calib\.txt: cannot be read"):
        open_sequence(folder)


def test_a_sequence_without_times_is_refused(folder: Path) -> None:
    """Not read as any folder of images, three times too fast."""
    (folder / "times.txt").unlink()
    with pytest.raises(
        SequenceError, match=r"no times\.txt, which comes with calib\.txt .*image_0 alone .*--fps 10"
    ):
        open_sequence(folder)
    assert len(open_sequence(folder / "image_0", fps=10)) == 3
