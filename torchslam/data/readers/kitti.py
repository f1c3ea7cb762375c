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
from torchslam.data.formats.vehicle_files import Packet, read_day_times, read_oxts
from torchslam.data.readers.image_sequence import ImageEntry, ImageSequence
from torchslam.data.sequence import Reader
from torchslam.data.text_file import float64, in_seconds, number_rows, numbered_lines, parse_floats, read_text
from torchslam.data.trajectories import checked_poses
from torchslam.errors import CalibrationError, SequenceError, TrajectoryError
from torchslam.geometry.lie import rigid, se3_inverse, so3_exp
from torchslam.types import Trajectory

RAW_CAMERAS = ("image_00", "image_02")
"""The left cameras, gray and color; those of the odometry benchmark have one digit."""


def _odometry_camera(base: Path) -> Path | None:
    return next((base / name for name in ("image_0", "image_2") if (base / name).is_dir()), None)


def _is_kitti(path: str) -> bool:
    """Return True for a sequence of the odometry benchmark, also one without times, which is then refused."""
    base, calibration = Path(path), Path(path) / "calib.txt"
    if _odometry_camera(base) is None:
        return False
    text = read_text(calibration, CalibrationError) if calibration.is_file() else ""
    return text.lstrip().startswith("P0:") or (base / "times.txt").is_file()


def _open_kitti(path: str, camera: GivenCamera | None, rate: float | None) -> ImageSequence:
    """A KITTI odometry sequence, left gray images before left color ones; `camera` overrides `calib.txt`.

    Ground truth, if any, comes from `poses.txt` in the folder, or `poses/NN.txt` next to `sequences/NN`: the poses of
    camera 0, shifted to the camera that took the images.
    """
    base = Path(path)
    folder = _odometry_camera(base) or base
    listed = base / "times.txt"
    if not listed.is_file():
        raise SequenceError(
            f"{path}: no times.txt, which comes with calib.txt in data_odometry_calib.zip; {folder} alone is read as "
            "images of --fps 10, with --camera"
        )
    found = find_frames(folder)
    rows = list(number_rows(listed, "time", SequenceError))
    if len(found.frames) != len(rows):
        raise SequenceError(
            f"{path}: times.txt has {len(rows)} lines, {folder.name}/ has {len(found.frames)} images"
        )
    entries = [
        ImageEntry(in_seconds(time, where, SequenceError), image, where)
        for (where, (time,)), image in zip(rows, found.frames, strict=True)
    ]
    T_0c = torch.eye(4, dtype=torch.float64, device="cpu")
    if camera is None:
        calibration = base / "calib.txt"
        # K [I | t] of a rectified camera.
        P = _row(_read_rows(calibration), f"P{folder.name[-1]}", 12, calibration)
        camera = Calibration.from_numbers([P[0], P[5], P[2], P[6]], str(calibration))
        T_0c[0, 3] = -((P[3] - P[2] * P[11]) / P[0])  # meters
    resolved = base.resolve()
    candidates = (base / "poses.txt", resolved.parent.parent / "poses" / f"{resolved.name}.txt")
    poses = next((candidate for candidate in candidates if candidate.is_file()), None)
    groundtruth = None
    if poses is not None:
        columns = "r11 r12 r13 tx r21 r22 r23 ty r31 r32 r33 tz"
        T_w0 = float64([row for _, row in number_rows(poses, columns, TrajectoryError)]).view(-1, 3, 4)
        if len(T_w0) != len(entries):
            raise TrajectoryError(f"{poses}: {len(T_w0)} poses for {len(entries)} times")
        times = float64([entry.timestamp for entry in entries])
        T_wc = rigid(T_w0[..., :3], T_w0[..., 3]) @ T_0c
        groundtruth = Trajectory(times, checked_poses(T_wc, poses))
    kind = f"KITTI odometry, {folder.name}"
    return ImageSequence(base.name, kind, entries, camera, groundtruth, found.notes)


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
    calibration = _find_file(drive, "calib_cam_to_cam.txt")
    side = folder.name[-2:]
    if camera is None and calibration is not None:
        rows = _read_rows(calibration)
        if drive.resolve().name.endswith("_extract"):
            K, D = _row(rows, f"K_{side}", 9, calibration), _row(rows, f"D_{side}", 5, calibration)
            numbers = [K[0], K[4], K[2], K[5], *D]
        else:
            P = _row(rows, f"P_rect_{side}", 12, calibration)
            numbers = [P[0], P[5], P[2], P[6]]
        camera = Calibration.from_numbers(numbers, str(calibration))
    truth = _read_truth(drive, side, calibration)
    return ImageSequence(drive.name, f"KITTI raw, {folder.name}", entries, camera, truth, found.notes)


def _raw_camera(drive: Path) -> Path | None:
    folders = (drive / name for name in RAW_CAMERAS)
    return next((f for f in folders if (f / "data").is_dir() and (f / "timestamps.txt").is_file()), None)


def _find_file(drive: Path, name: str) -> Path | None:
    """Return a file of the drive or of its recording day."""
    return next((path for path in (drive / name, drive.resolve().parent / name) if path.is_file()), None)


def _read_rows(path: Path) -> dict[str, list[float]]:
    """Lines `name: numbers`; those of dates are left out."""
    rows: dict[str, list[float]] = {}
    for where, line in numbered_lines(path, CalibrationError):
        name, _, numbers = line.partition(":")
        if name not in ("calib_time", "corner_dist"):
            rows[name] = parse_floats(numbers, where, CalibrationError)
    return rows


def _row(rows: dict[str, list[float]], name: str, count: int, path: Path) -> list[float]:
    if len(rows.get(name, [])) != count:
        raise CalibrationError(f"{path}: expected a line `{name}:` of {count} numbers")
    return rows[name]


def _read_truth(drive: Path, side: str, calibration: Path | None) -> Trajectory | None:
    """The camera's poses from those of the GPS/INS; None where a file for it is missing."""
    oxts = drive / "oxts"
    velo_to_cam, imu_to_velo = (
        _find_file(drive, f"calib_{name}.txt") for name in ("velo_to_cam", "imu_to_velo")
    )
    if calibration is None or velo_to_cam is None or imu_to_velo is None or not (oxts / "data").is_dir():
        return None
    rows = _read_rows(calibration)
    P, R = _row(rows, f"P_rect_{side}", 12, calibration), _row(rows, "R_rect_00", 9, calibration)
    # Meters from camera 0 to this one.
    T_rect = rigid(float64(R).view(3, 3), float64([P[3] / P[0], 0.0, 0.0]))
    T_ci = T_rect @ _read_rigid(velo_to_cam) @ _read_rigid(imu_to_velo)
    packets = read_oxts(oxts)
    T_wc = checked_poses(_poses_of(packets) @ se3_inverse(T_ci), oxts / "data")
    return Trajectory(float64([packet.time for packet in packets]), T_wc)


def _read_rigid(path: Path) -> Float[Tensor, "4 4"]:
    rows = _read_rows(path)
    return rigid(float64(_row(rows, "R", 9, path)).view(3, 3), float64(_row(rows, "T", 3, path)))


def _poses_of(packets: list[Packet]) -> Float[Tensor, "N 4 4"]:
    """T_wi of the GPS/INS: east, north, up, by a Mercator projection, from the first one."""
    table = float64([packet.numbers[:6] for packet in packets])
    latitude, longitude = table[:, 0].deg2rad(), table[:, 1].deg2rad()
    scale = 6378137.0 * math.cos(latitude[0])
    north = scale * (math.pi / 4 + latitude / 2).tan().log()
    positions = torch.stack((scale * longitude, north, table[:, 2]), dim=-1)
    axes = torch.eye(3, dtype=torch.float64, device="cpu")
    roll, pitch, yaw = (so3_exp(table[:, 3 + axis, None] * axes[axis]) for axis in range(3))
    return rigid(yaw @ pitch @ roll, positions - positions[0])


KITTI = Reader("image_0/ or image_2/ with times.txt (KITTI odometry)", _is_kitti, _open_kitti)
KITTI_RAW = Reader(
    "image_00/data/ with timestamps.txt (KITTI raw)",
    lambda path: _raw_camera(Path(path)) is not None,
    _open_kitti_raw,
)
