"""Folders of the EuRoC MAV dataset: `mav0/cam0/{data.csv,sensor.yaml,data/}`, the body's truth and inertial sensor.

Source: https://projects.asl.ethz.ch/datasets/doku.php?id=kmavvisualinertialdatasets
"""

from __future__ import annotations

import shlex
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.data.calibration import GivenCamera
from torchslam.data.formats.calibration_files import read_calibration, read_matrix
from torchslam.data.readers.image_sequence import ImageEntry, ImageSequence
from torchslam.data.sequence import Reader
from torchslam.data.text_file import check_later, numbered_lines, parse_count, parse_floats
from torchslam.data.trajectories import poses_from_rows
from torchslam.errors import SequenceError, TrajectoryError
from torchslam.types import Trajectory

NANOSECONDS = 1_000_000_000
"""Unit of the times in the files, per second."""
IMU = "imu0"
"""Folder of the inertial sensor, whose frame is the body's."""
TRUTH = Path("state_groundtruth_estimate0") / "data.csv"


def _open_euroc(path: str, camera: GivenCamera | None, rate: float | None) -> ImageSequence:
    """The left camera of a EuRoC recording; `camera` overrides `sensor.yaml`."""
    folder = Path(path)
    root = _root(folder)
    sensor = root / "cam0" / "sensor.yaml"
    groundtruth, notes, has_truth = None, [], (root / TRUTH).is_file()
    if not sensor.exists():
        unused = ", and the ground truth is not used, which is of the body" if has_truth else ""
        notes = [f"no {sensor}: the camera is unknown unless --camera is given{unused}"]
    else:
        camera = camera if camera is not None else read_calibration(sensor)
        if has_truth:
            T_bc = torch.tensor(read_matrix(sensor, "T_BS", 16), dtype=torch.float64, device="cpu").view(4, 4)
            groundtruth = _read_body_poses(root / TRUTH, T_bc)
    name = folder.resolve().parent.name if folder.name == "mav0" else folder.name
    sequence = ImageSequence(name, "EuRoC folder", _read_images(root / "cam0"), camera, groundtruth, notes)
    if sensor.exists() and (root / IMU / "data.csv").is_file():
        sequence.measurements = {"imu": shlex.quote(str(root / IMU)), "imu_camera": shlex.quote(str(sensor))}
    return sequence


def _root(path: Path) -> Path:
    return path / "mav0" if (path / "mav0").is_dir() else path


def _read_images(folder: Path) -> list[ImageEntry]:
    """The lines `nanoseconds,file` of `data.csv`."""
    entries = []
    for number, line in numbered_lines(folder / "data.csv", SequenceError):
        where = f"{folder / 'data.csv'}:{number}"
        words = [word.strip() for word in line.split(",")]
        nanoseconds = parse_count(words[0])
        if len(words) != 2 or nanoseconds is None:
            raise SequenceError(f"{where}: expected `nanoseconds,file`, got `{line}`")
        entries.append(ImageEntry(nanoseconds / NANOSECONDS, folder / "data" / words[1], where))
    return entries


def _read_body_poses(path: Path, T_bc: Float[Tensor, "4 4"]) -> Trajectory:
    """Camera poses from the body's: nanoseconds, position, quaternion wxyz, then velocity and biases."""
    times: list[float] = []
    places: list[str] = []
    rows: list[list[float]] = []
    for number, line in numbered_lines(path, TrajectoryError):
        where = f"{path}:{number}"
        first, _, rest = line.partition(",")
        nanoseconds = parse_count(first.strip())
        row = parse_floats(rest, where, TrajectoryError)
        if nanoseconds is None or len(row) < 7:
            raise TrajectoryError(f"{where}: expected nanoseconds, position and quaternion, got `{line}`")
        times.append(nanoseconds / NANOSECONDS)
        if rows:
            check_later(times[-1], times[-2], where, TrajectoryError)
        places.append(where)
        rows.append([*row[:3], *row[4:7], row[3]])
    if not rows:
        raise TrajectoryError(f"{path}: no poses")
    T_wb = poses_from_rows(torch.tensor(rows, dtype=torch.float64, device="cpu"), places)
    return Trajectory(torch.tensor(times, dtype=torch.float64, device="cpu"), T_wb @ T_bc)


EUROC = Reader(
    "mav0/cam0/data.csv (EuRoC)",
    lambda path: (_root(Path(path)) / "cam0" / "data.csv").is_file(),
    _open_euroc,
)
