"""Folders of KITTI: sequences of the odometry benchmark, and drives of the raw data.

Sources: the development kit of https://www.cvlibs.net/datasets/kitti/eval_odometry.php;
https://www.cvlibs.net/datasets/kitti/raw_data.php and dataformat.txt of its development kit; A. Geiger et al.,
Vision meets Robotics: The KITTI Dataset, IJRR 2013 (coordinate systems, Mercator projection).
"""

from __future__ import annotations

import math
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.data.calibration import Calibration, GivenCamera
from torchslam.data.formats.frame_names import find_frames
from torchslam.data.formats.oxts import Packet, read_day_times, read_oxts
from torchslam.data.readers.image_sequence import ImageEntry, ImageSequence
from torchslam.data.sequence import Reader
from torchslam.data.text_file import in_seconds, number_rows, numbered_lines, parse_floats, read_text
from torchslam.data.trajectories import checked_poses
from torchslam.errors import CalibrationError, SequenceError, TrajectoryError
from torchslam.geometry.lie import rigid, se3_inverse, so3_exp
from torchslam.types import Trajectory

CAMERAS = ("image_0", "image_2")
RAW_CAMERAS = ("image_00", "image_02")
"""The left cameras, gray and color."""
CALIBRATION = "calib_cam_to_cam.txt"
POSE_COLUMNS = "r11 r12 r13 tx r21 r22 r23 ty r31 r32 r33 tz"
EARTH_RADIUS = 6378137.0  # meters


def _is_kitti(path: str) -> bool:
    """Return True for a sequence of the odometry benchmark, also one without times, which is then refused."""
    base = Path(path)
    if not any((base / name).is_dir() for name in CAMERAS):
        return False
    return (base / "times.txt").is_file() or _is_calibrated(base / "calib.txt")


def _is_calibrated(path: Path) -> bool:
    """Return whether a file has projections, `P0: ...`."""
    return path.is_file() and read_text(path, CalibrationError).lstrip().startswith("P0:")


def _open_kitti(path: str, camera: GivenCamera | None, rate: float | None) -> ImageSequence:
    """A KITTI odometry sequence, left gray images before left color ones; `camera` overrides `calib.txt`.

    Ground truth, if any, comes from `poses.txt` in the folder, or `poses/NN.txt` next to `sequences/NN`.
    """
    base = Path(path)
    folder = next(base / name for name in CAMERAS if (base / name).is_dir())
    if not (base / "times.txt").is_file():
        raise SequenceError(
            f"{path}: no times.txt, which comes with calib.txt in data_odometry_calib.zip; {folder} alone is read as "
            "images of --fps 10, with --camera"
        )
    seconds = [
        in_seconds(time, where, SequenceError)
        for where, (time,) in number_rows(base / "times.txt", "time", SequenceError)
    ]
    times = torch.tensor(seconds, dtype=torch.float64, device="cpu")
    found = find_frames(folder)
    images = found.frames
    if len(images) != len(times):
        raise SequenceError(
            f"{path}: times.txt has {len(times)} lines, {folder.name}/ has {len(images)} images"
        )
    entries = [
        ImageEntry(time, image, f"{base / 'times.txt'}:{line}")
        for line, (time, image) in enumerate(zip(times.tolist(), images, strict=True), start=1)
    ]
    offset_x = 0.0
    if camera is None:
        camera, offset_x = _read_projection(base / "calib.txt", f"P{folder.name[-1]}")
    groundtruth = _read_odometry_poses(base, times, offset_x)
    kind = f"KITTI odometry, {folder.name}"
    return ImageSequence(base.name, kind, entries, camera, groundtruth, found.notes)


def _read_projection(path: Path, label: str) -> tuple[Calibration, float]:
    """The rectified camera K [I | t] of a line `P0: ...` and t_x, meters, its offset from camera 0."""
    for number, line in numbered_lines(path, CalibrationError):
        if not line.startswith(f"{label}:"):
            continue
        where = f"{path}:{number}"
        P = parse_floats(line.split(":", 1)[1], where, CalibrationError)
        if len(P) != 12:
            raise CalibrationError(f"{where}: expected the 12 numbers of a 3x4 projection, got {len(P)}")
        calibration = Calibration.from_numbers([P[0], P[5], P[2], P[6]], where)
        return calibration, (P[3] - P[2] * P[11]) / P[0]
    raise CalibrationError(f"{path}: no line `{label}: ...`")


def _read_odometry_poses(path: Path, times: Float[Tensor, " N"], offset_x: float) -> Trajectory | None:
    """The poses of camera 0, shifted to the camera that took the images."""
    resolved = path.resolve()
    candidates = (path / "poses.txt", resolved.parent.parent / "poses" / f"{resolved.name}.txt")
    found = next((candidate for candidate in candidates if candidate.is_file()), None)
    if found is None:
        return None
    rows = [row for _, row in number_rows(found, POSE_COLUMNS, TrajectoryError)]
    if len(rows) != len(times):
        raise TrajectoryError(f"{found}: {len(rows)} poses for {len(times)} times")
    T_w0 = torch.eye(4, dtype=torch.float64, device="cpu").repeat(len(rows), 1, 1)
    T_w0[:, :3] = torch.tensor(rows, dtype=torch.float64, device="cpu").view(-1, 3, 4)
    T_0c = torch.eye(4, dtype=torch.float64, device="cpu")
    T_0c[0, 3] = -offset_x
    return Trajectory(times, checked_poses(T_w0 @ T_0c, found))


def _open_kitti_raw(path: str, camera: GivenCamera | None, rate: float | None) -> ImageSequence:
    """The left camera of a drive, gray before color; times are seconds since the day began, UTC.

    The calibration is read from the drive or the folder of its day: the rectified one, or for a drive `..._extract`
    that of the raw images. The ground truth is that of `oxts/`, if both calib_velo_to_cam.txt and calib_imu_to_velo.txt
    exist.
    """
    drive = Path(path)
    folder = _raw_camera(drive) or drive / RAW_CAMERAS[0]
    times = read_day_times(folder / "timestamps.txt", SequenceError)
    found = find_frames(folder / "data")
    entries = []
    for file in found.frames:
        number = int(file.stem) if file.stem.isdecimal() else -1
        if not 0 <= number < len(times):
            raise SequenceError(f"{file}: timestamps.txt has no line for it among its {len(times)}")
        entries.append(ImageEntry(times[number], file, f"{folder / 'timestamps.txt'}:{number + 1}"))
    calibration = _find_file(drive, CALIBRATION)
    if camera is None and calibration is not None:
        camera = _read_raw_camera(calibration, folder.name[-2:], drive.resolve().name.endswith("_extract"))
    truth = _read_truth(drive, folder.name[-2:], calibration)
    return ImageSequence(drive.name, f"KITTI raw, {folder.name}", entries, camera, truth, found.notes)


def _raw_camera(drive: Path) -> Path | None:
    for name in RAW_CAMERAS:
        if (drive / name / "data").is_dir() and (drive / name / "timestamps.txt").is_file():
            return drive / name
    return None


def _find_file(drive: Path, name: str) -> Path | None:
    """Return a file of the drive or of its recording day."""
    return next((path for path in (drive / name, drive.resolve().parent / name) if path.is_file()), None)


def _read_rows(path: Path) -> dict[str, list[float]]:
    """Lines `name: numbers`; those of dates are left out."""
    rows: dict[str, list[float]] = {}
    for number, line in numbered_lines(path, CalibrationError):
        name, _, numbers = line.partition(":")
        if name not in ("calib_time", "corner_dist"):
            rows[name] = parse_floats(numbers, f"{path}:{number}", CalibrationError)
    return rows


def _row(rows: dict[str, list[float]], name: str, count: int, path: Path) -> list[float]:
    if len(rows.get(name, [])) != count:
        raise CalibrationError(f"{path}: expected a line `{name}:` of {count} numbers")
    return rows[name]


def _read_raw_camera(path: Path, number: str, as_taken: bool) -> Calibration:
    rows = _read_rows(path)
    if as_taken:
        K, D = _row(rows, f"K_{number}", 9, path), _row(rows, f"D_{number}", 5, path)
        return Calibration.from_numbers([K[0], K[4], K[2], K[5], *D], str(path))
    P = _row(rows, f"P_rect_{number}", 12, path)
    return Calibration.from_numbers([P[0], P[5], P[2], P[6]], str(path))


def _read_truth(drive: Path, number: str, calibration: Path | None) -> Trajectory | None:
    """The camera's poses from those of the GPS/INS; None where a file for it is missing."""
    velo_to_cam, imu_to_velo = (
        _find_file(drive, "calib_velo_to_cam.txt"),
        _find_file(drive, "calib_imu_to_velo.txt"),
    )
    packets = drive / "oxts" / "data"
    if calibration is None or velo_to_cam is None or imu_to_velo is None or not packets.is_dir():
        return None
    rows = _read_rows(calibration)
    P = _row(rows, f"P_rect_{number}", 12, calibration)
    T_rect = torch.eye(4, dtype=torch.float64, device="cpu")
    T_rect[:3, :3] = torch.tensor(
        _row(rows, "R_rect_00", 9, calibration), dtype=torch.float64, device="cpu"
    ).view(3, 3)
    T_rect[0, 3] = P[3] / P[0]  # meters from camera 0 to this one
    T_ci = T_rect @ _read_rigid(velo_to_cam) @ _read_rigid(imu_to_velo)
    oxts = read_oxts(drive / "oxts")
    times = [packet.time for packet in oxts]
    T_wc = checked_poses(_poses_of(oxts) @ se3_inverse(T_ci), packets)
    return Trajectory(torch.tensor(times, dtype=torch.float64, device="cpu"), T_wc)


def _read_rigid(path: Path) -> Float[Tensor, "4 4"]:
    rows = _read_rows(path)
    R, t = (
        torch.tensor(_row(rows, name, count, path), dtype=torch.float64, device="cpu")
        for name, count in (("R", 9), ("T", 3))
    )
    return rigid(R.view(3, 3), t)


def _poses_of(packets: list[Packet]) -> Float[Tensor, "N 4 4"]:
    """T_wi of the GPS/INS: east, north, up, by a Mercator projection, from the first one."""
    rows = [packet.numbers[:6] for packet in packets]
    table = torch.tensor(rows, dtype=torch.float64, device="cpu")
    latitude, longitude = table[:, 0].deg2rad(), table[:, 1].deg2rad()
    scale = EARTH_RADIUS * math.cos(latitude[0])
    north = scale * (math.pi / 4 + latitude / 2).tan().log()
    positions = torch.stack((scale * longitude, north, table[:, 2]), dim=-1)
    roll, pitch, yaw = (
        so3_exp(angle[:, None] * axis)
        for angle, axis in zip(
            table[:, 3:].unbind(-1), torch.eye(3, dtype=torch.float64, device="cpu"), strict=True
        )
    )
    return rigid(yaw @ pitch @ roll, positions - positions[0])


KITTI = Reader("image_0/ or image_2/ with times.txt (KITTI odometry)", _is_kitti, _open_kitti)
KITTI_RAW = Reader(
    "image_00/data/ with timestamps.txt (KITTI raw)",
    lambda path: _raw_camera(Path(path)) is not None,
    _open_kitti_raw,
)
