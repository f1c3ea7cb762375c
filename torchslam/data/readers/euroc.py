"""Folders of the EuRoC MAV dataset: `mav0/cam0/{data.csv,sensor.yaml,data/}` and the body's ground truth.

Source: https://projects.asl.ethz.ch/datasets/doku.php?id=kmavvisualinertialdatasets
"""

from __future__ import annotations

import re
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.data.calibration import Calibration
from torchslam.data.camera_argument import GivenCamera
from torchslam.data.formats.text_file import check_later, numbered_lines, parse_count, parse_floats
from torchslam.data.readers.image_sequence import ImageEntry, ImageSequence
from torchslam.data.sequence import Reader
from torchslam.data.trajectories import checked_poses
from torchslam.errors import CalibrationError, SequenceError, TrajectoryError
from torchslam.geometry.lie import matrix_from_quaternion, rigid
from torchslam.types import Trajectory

NANOSECONDS = 1_000_000_000
TRUTH = Path("state_groundtruth_estimate0") / "data.csv"


def _is_euroc(path: str) -> bool:
    """Return True if the folder, or its `mav0`, has a camera in this layout."""
    return (_root(Path(path)) / "cam0" / "data.csv").is_file()


def _open_euroc(path: str, camera: GivenCamera | None, rate: float | None) -> ImageSequence:
    """The left camera of a EuRoC recording; `camera` overrides `sensor.yaml`.

    Raises SequenceError, CalibrationError or TrajectoryError naming file and line.
    """
    folder = Path(path)
    root = _root(folder)
    sensor = root / "cam0" / "sensor.yaml"
    camera = camera if camera is not None else _read_intrinsics(sensor)
    groundtruth = None
    if (root / TRUTH).is_file():
        groundtruth = _read_body_poses(root / TRUTH, _read_extrinsics(sensor))
    name = folder.resolve().parent.name if folder.name == "mav0" else folder.name
    return ImageSequence(name, "EuRoC folder", _read_images(root / "cam0"), camera, groundtruth)


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


def _read_intrinsics(path: Path) -> Calibration:
    model = re.search(r"^distortion_model:\s*(\S+)", _text(path), re.MULTILINE)
    models = {"radial-tangential": "radial_tangential", "equidistant": "fisheye"}
    if model is None or model[1] not in models:
        raise CalibrationError(f"{path}: distortion_model must be one of {', '.join(models)}")
    numbers = _numbers(path, "intrinsics", 4) + _numbers(path, "distortion_coefficients", 4)
    return Calibration.from_numbers(numbers, str(path), models[model[1]])


def _read_extrinsics(path: Path) -> Float[Tensor, "4 4"]:
    """T_bc: camera to body."""
    block = _text(path).partition("T_BS:")[2]
    return torch.tensor(
        _bracketed(block, f"{path}: T_BS", "data", 16), dtype=torch.float64, device="cpu"
    ).view(4, 4)


def _read_body_poses(path: Path, T_bc: Float[Tensor, "4 4"]) -> Trajectory:
    """Camera poses from the body's: nanoseconds, position, quaternion wxyz, then velocity and biases."""
    times: list[float] = []
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
        rows.append(row[:7])
    if not rows:
        raise TrajectoryError(f"{path}: no poses")
    table = torch.tensor(rows, dtype=torch.float64, device="cpu")
    T_wb = rigid(matrix_from_quaternion(table[:, [4, 5, 6, 3]]), table[:, :3])
    T_wc = checked_poses(T_wb @ T_bc, path)
    return Trajectory(torch.tensor(times, dtype=torch.float64, device="cpu"), T_wc)


def _text(path: Path) -> str:
    return "\n".join(line for _, line in numbered_lines(path, CalibrationError))


def _numbers(path: Path, key: str, count: int) -> list[float]:
    return _bracketed(_text(path), str(path), key, count)


def _bracketed(text: str, where: str, key: str, count: int) -> list[float]:
    """The numbers of `key: [1, 2, ...]`, over as many lines as it takes."""
    found = re.search(rf"\b{key}:\s*\[([^\]]*)\]", text)
    numbers = parse_floats(found[1], f"{where}: {key}", CalibrationError) if found else []
    if len(numbers) != count:
        raise CalibrationError(f"{where}: expected `{key}: [{count} numbers]`, got {len(numbers)}")
    return numbers


EUROC = Reader("mav0/cam0/data.csv (EuRoC)", _is_euroc, _open_euroc)
