"""Folders of benchmarks, of which the color or left images are read.

ETH3D, TUM   `rgb.txt`, `groundtruth.txt`, `calibration.txt`: https://www.eth3d.net/slam_documentation,
             https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats
ICL-NUIM     the TUM-compatible form: `rgb/`, `*.gt.freiburg`: https://www.doc.ic.ac.uk/~ahanda/VaFRIC/iclnuim.html
7-Scenes     `frame-000000.color.png` and `.pose.txt` side by side:
             https://www.microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes/
TartanAir    `image_left/` and `pose_left.txt`, in version 2 with `lcam_front` in place of `left`; poses are camera to
             world, x forward, y right, z down: https://github.com/castacks/tartanair_tools/blob/master/data_type.md
EuRoC MAV    `mav0/cam0/{data.csv,sensor.yaml,data/}`, the body's truth and inertial sensor:
             https://projects.asl.ethz.ch/datasets/doku.php?id=kmavvisualinertialdatasets
"""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.data.calibration import PRESETS, GivenCamera
from torchslam.data.formats.calibration_files import read_calibration
from torchslam.data.formats.depth_images import DEPTH_LIST, SEVEN_SCENES_DEPTH
from torchslam.data.formats.frame_names import find_frames, match_pattern
from torchslam.data.formats.key_files import read_keys
from torchslam.data.readers.image_sequence import (
    DEFAULT_RATE,
    ImageEntry,
    ImageSequence,
    at_rate,
    find_calibration,
)
from torchslam.data.sequence import Reader
from torchslam.data.text_file import (
    check_rising,
    float64,
    listed_files,
    number_rows,
    numbered_lines,
    parse_count,
    parse_floats,
    read_text,
)
from torchslam.data.trajectories import (
    ORTHOGONAL,
    checked_poses,
    orthogonality_error,
    poses_from_rows,
    read_trajectory,
)
from torchslam.errors import CalibrationError, SequenceError, TrajectoryError
from torchslam.geometry.lie import rigid
from torchslam.geometry.similarity import nearest_rotation
from torchslam.types import Trajectory

ICL_TRUTH = "*.gt.freiburg"
SEVEN_SCENES_COLOR = "frame-*.color.png"


def _open_tum(path: str, camera: GivenCamera | None, rate: float | None) -> ImageSequence:
    """A folder of ETH3D-SLAM or TUM RGB-D; `camera` overrides the folder's calibration.

    The archives of TUM contain no calibration; their name identifies the published camera.
    """
    folder = Path(path)
    listed = listed_files(folder / "rgb.txt", SequenceError)
    entries = [ImageEntry(time, file, where) for where, time, file in listed]
    robot = re.search(r"freiburg([123])(?!\d)", folder.resolve().name)
    published = PRESETS[f"tum-fr{robot[1]}"] if robot else None
    camera = camera or find_calibration(folder) or published
    truth = folder / "groundtruth.txt"
    groundtruth = read_trajectory(truth) if truth.is_file() else None
    sequence = ImageSequence(folder.name, "ETH3D or TUM folder", entries, camera, groundtruth)
    return _with_depth(sequence, folder / DEPTH_LIST)


def _with_depth(sequence: ImageSequence, path: Path, camera: str = "") -> ImageSequence:
    """The sequence with its depth images, if they are there, for `--depth auto`."""
    if path.exists():
        sequence.measurements = {"depth": shlex.quote(str(path))}
        sequence.measurements |= {"depth_camera": camera} if camera else {}
    return sequence


def _open_icl_nuim(path: str, camera: GivenCamera | None, rate: float | None) -> ImageSequence:
    """A trajectory of the living room or the office, whose frames are numbered, in place of times.

    The published camera has a negative fy, since its y axis points up; here it points down, so that camera and world
    are mirrored.
    """
    folder = Path(path)
    rate = rate or DEFAULT_RATE
    found = find_frames(folder / "rgb")
    unnumbered = [file for file in found.frames if parse_count(file.stem) is None]
    if unnumbered:
        raise SequenceError(f"{unnumbered[0]}: frames of ICL-NUIM are named by their number")
    entries = [ImageEntry(int(file.stem) / rate, file, str(file)) for file in found.frames]
    numbered = read_trajectory(sorted(folder.glob(ICL_TRUTH))[0])
    mirror = torch.diag(float64((1, -1, 1, 1)))
    groundtruth = Trajectory(numbered.timestamps / rate, mirror @ numbered.T_wc @ mirror)
    camera = camera or PRESETS["icl"]
    sequence = ImageSequence(folder.name, "ICL-NUIM folder", entries, camera, groundtruth, found.notes)
    return _with_depth(sequence, folder / "depth")


def _open_seven_scenes(path: str, camera: GivenCamera | None, rate: float | None) -> ImageSequence:
    """One sequence (`seq-01`), at the Kinect's 30 frames per second, with the poses of its depth camera.

    The dataset gives no calibration of the color camera; without `camera` its nominal focal length is a guess.
    """
    folder = Path(path)
    found = match_pattern(str(folder / SEVEN_SCENES_COLOR))
    entries = at_rate(found.frames, rate or DEFAULT_RATE)
    posed = {}
    for entry in entries:
        pose = entry.path.with_name(entry.path.name.replace(".color.png", ".pose.txt"))
        T_wc = _read_pose(pose) if pose.is_file() else None
        if T_wc is not None:
            posed[entry.timestamp] = T_wc
    groundtruth = Trajectory(float64([*posed]), torch.stack([*posed.values()])) if posed else None
    camera = camera or PRESETS["7-scenes"]
    name = f"{folder.resolve().parent.name}/{folder.name}" if folder.name.startswith("seq-") else folder.name
    sequence = ImageSequence(name, "7-Scenes folder", entries, camera, groundtruth, found.notes)
    # The depth images are not registered to the color images; the page of the dataset has their camera.
    has_depth = next(folder.glob(SEVEN_SCENES_DEPTH), None) is not None
    return _with_depth(sequence, folder, "585,585,320,240") if has_depth else sequence


def _read_pose(path: Path) -> Float[Tensor, "4 4"] | None:
    """T_wc; None where tracking had failed: the dataset then writes numbers that are no rotation."""
    text = read_text(path, TrajectoryError).lower()
    if "nan" in text or "inf" in text:
        return None
    rows = [row for _, row in number_rows(path, "r1 r2 r3 t", TrajectoryError)]
    if len(rows) != 4:
        raise TrajectoryError(f"{path}: expected four lines of four numbers")
    T_wc = float64(rows)
    R = T_wc[:3, :3]
    if orthogonality_error(R) > ORTHOGONAL:
        return None
    return checked_poses(rigid(nearest_rotation(R), T_wc[:3, 3])[None], path)[0]


def _open_tartanair(path: str, camera: GivenCamera | None, rate: float | None) -> ImageSequence:
    """The left camera of a trajectory; the dataset has no times, so that `rate` or 30 frames per second are taken."""
    folder = Path(path)
    name = _tartanair_camera(folder)
    found = find_frames(folder / f"image_{name}")
    entries = at_rate(found.frames, rate or DEFAULT_RATE)
    truth = folder / f"pose_{name}.txt"
    places, rows = zip(*number_rows(truth, "tx ty tz qx qy qz qw", TrajectoryError), strict=True)
    if len(rows) != len(entries):
        raise TrajectoryError(f"{truth}: {len(rows)} poses for {len(entries)} images")
    T_wc = poses_from_rows(float64(rows), places)
    # Our axes, right, down, forward, as columns in the dataset's: forward, right, down.
    T_wc = rigid(T_wc[:, :3, :3] @ float64(((0, 0, 1), (1, 0, 0), (0, 1, 0))), T_wc[:, :3, 3])
    groundtruth = Trajectory(float64([entry.timestamp for entry in entries]), T_wc)
    camera = camera or PRESETS["tartanair"]
    return ImageSequence(folder.name, "TartanAir folder", entries, camera, groundtruth, found.notes)


def _tartanair_camera(folder: Path) -> str | None:
    for name in ("left", "lcam_front"):
        if (folder / f"image_{name}").is_dir() and (folder / f"pose_{name}.txt").is_file():
            return name
    return None


def _open_euroc(path: str, camera: GivenCamera | None, rate: float | None) -> ImageSequence:
    """The left camera of a EuRoC recording; `camera` overrides `sensor.yaml`."""
    folder = Path(path)
    root = _euroc_root(folder)
    images, sensor, imu = root / "cam0" / "data.csv", root / "cam0" / "sensor.yaml", root / "imu0"
    truth = root / "state_groundtruth_estimate0" / "data.csv"
    groundtruth, notes = None, []
    if not sensor.exists():
        unused = ", and the ground truth is not used, which is of the body" if truth.is_file() else ""
        notes = [f"no {sensor}: the camera is unknown unless --camera is given{unused}"]
    else:
        camera = camera or read_calibration(sensor)
        groundtruth = _read_body_poses(truth, sensor) if truth.is_file() else None
    entries = []
    for where, line in numbered_lines(images, SequenceError):
        words = [word.strip() for word in line.split(",")]
        nanoseconds = parse_count(words[0])
        if len(words) != 2 or nanoseconds is None:
            raise SequenceError(f"{where}: expected `nanoseconds,file`, got `{line}`")
        entries.append(ImageEntry(nanoseconds / 1_000_000_000, images.parent / "data" / words[1], where))
    name = folder.resolve().parent.name if folder.name == "mav0" else folder.name
    sequence = ImageSequence(name, "EuRoC folder", entries, camera, groundtruth, notes)
    if sensor.exists() and (imu / "data.csv").is_file():
        sequence.measurements = {"imu": shlex.quote(str(imu)), "imu_camera": shlex.quote(str(sensor))}
    return sequence


def _euroc_root(path: Path) -> Path:
    return path / "mav0" if (path / "mav0").is_dir() else path


def _read_body_poses(path: Path, sensor: Path) -> Trajectory:
    """Camera poses from the body's: nanoseconds, position, quaternion wxyz, then velocity and biases."""
    T_bc = next(read_keys(sensor)).numbers("tbs")
    if len(T_bc) != 16:
        raise CalibrationError(f"{sensor}: T_BS: expected 16 numbers, got {len(T_bc)}")
    times, places, rows = list[float](), list[str](), list[list[float]]()
    for where, line in numbered_lines(path, TrajectoryError):
        first, _, rest = line.partition(",")
        nanoseconds = parse_count(first.strip())
        row = parse_floats(rest, where, TrajectoryError)
        if nanoseconds is None or len(row) < 7:
            raise TrajectoryError(f"{where}: expected nanoseconds, position and quaternion, got `{line}`")
        times.append(nanoseconds / 1_000_000_000)
        places.append(where)
        rows.append([*row[:3], *row[4:7], row[3]])
    if not rows:
        raise TrajectoryError(f"{path}: no poses")
    check_rising(times, places, TrajectoryError)
    return Trajectory(float64(times), poses_from_rows(float64(rows), places) @ float64(T_bc).view(4, 4))


TUM = Reader("rgb.txt (ETH3D, TUM)", lambda path: Path(path, "rgb.txt").is_file(), _open_tum)
ICL_NUIM = Reader(
    "rgb/ with *.gt.freiburg (ICL-NUIM)",
    lambda path: Path(path, "rgb").is_dir() and any(Path(path).glob(ICL_TRUTH)),
    _open_icl_nuim,
)
SEVEN_SCENES = Reader(
    "frame-*.color.png (7-Scenes)",
    lambda path: Path(path).is_dir() and any(Path(path).glob(SEVEN_SCENES_COLOR)),
    _open_seven_scenes,
)
TARTANAIR = Reader(
    "image_left/ with pose_left.txt (TartanAir)",
    lambda path: _tartanair_camera(Path(path)) is not None,
    _open_tartanair,
)
EUROC = Reader(
    "mav0/cam0/data.csv (EuRoC)",
    lambda path: (_euroc_root(Path(path)) / "cam0" / "data.csv").is_file(),
    _open_euroc,
)
