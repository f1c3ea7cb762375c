"""Folders of RGB-D benchmarks, of which the color images are read: ETH3D-SLAM, TUM, ICL-NUIM, 7-Scenes, TartanAir.

ETH3D, TUM   `rgb.txt`, `groundtruth.txt`, `calibration.txt`: https://www.eth3d.net/slam_documentation,
             https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats
ICL-NUIM     the TUM-compatible form: `rgb/`, `*.gt.freiburg`: https://www.doc.ic.ac.uk/~ahanda/VaFRIC/iclnuim.html
7-Scenes     `frame-000000.color.png` and `.pose.txt` side by side:
             https://www.microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes/
TartanAir    `image_left/` and `pose_left.txt`, in version 2 with `lcam_front` in place of `left`; poses are camera to
             world, x forward, y right, z down: https://github.com/castacks/tartanair_tools/blob/master/data_type.md
"""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.data.calibration import PRESETS, GivenCamera
from torchslam.data.formats.depth_images import DEPTH_LIST, SEVEN_SCENES_DEPTH
from torchslam.data.formats.frame_names import find_frames, match_pattern
from torchslam.data.readers.image_sequence import (
    DEFAULT_RATE,
    ImageEntry,
    ImageSequence,
    at_rate,
    find_calibration,
)
from torchslam.data.sequence import Reader
from torchslam.data.text_file import listed_files, number_rows, parse_count, read_text
from torchslam.data.trajectories import ORTHOGONAL, checked_poses, poses_from_rows, read_trajectory
from torchslam.errors import SequenceError, TrajectoryError
from torchslam.geometry.lie import rigid
from torchslam.geometry.similarity import nearest_rotation
from torchslam.types import Trajectory

FREIBURG = re.compile(r"freiburg([123])(?!\d)")
ICL_TRUTH = "*.gt.freiburg"
ICL_MIRROR = (1.0, -1.0, 1.0, 1.0)
"""Frames are numbered, in place of times. The published camera has a negative fy, since its y axis points up; here it
points down, so that camera and world are mirrored."""
SEVEN_SCENES_COLOR = "frame-*.color.png"
SEVEN_SCENES_DEPTH_CAMERA = "585,585,320,240"
"""Of the depth images, which are not registered to the color images; the page of the dataset has it."""
TARTANAIR_CAMERAS = ("left", "lcam_front")
TARTANAIR_AXES = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
"""The axes of our cameras, right, down, forward, as columns in the dataset's: forward, right, down."""


def _open_tum(path: str, camera: GivenCamera | None, rate: float | None) -> ImageSequence:
    """A folder of ETH3D-SLAM or TUM RGB-D; `camera` overrides the folder's calibration.

    The archives of TUM contain no calibration; their name identifies the published camera.
    """
    folder = Path(path)
    entries = [
        ImageEntry(time, file, where) for where, time, file in listed_files(folder / "rgb.txt", SequenceError)
    ]
    camera = camera if camera is not None else find_calibration(folder)
    robot = FREIBURG.search(folder.resolve().name)
    if camera is None and robot is not None:
        camera = PRESETS[f"tum-fr{robot[1]}"]
    truth = folder / "groundtruth.txt"
    groundtruth = read_trajectory(truth) if truth.is_file() else None
    sequence = ImageSequence(folder.name, "ETH3D or TUM folder", entries, camera, groundtruth)
    return _with_depth(sequence, folder / DEPTH_LIST)


def _with_depth(sequence: ImageSequence, path: Path, camera: str = "") -> ImageSequence:
    """The sequence with its depth images, if they are there, for `--depth auto`."""
    if path.exists():
        sequence.measurements = {"depth": shlex.quote(str(path))} | (
            {"depth_camera": camera} if camera else {}
        )
    return sequence


def _open_icl_nuim(path: str, camera: GivenCamera | None, rate: float | None) -> ImageSequence:
    """A trajectory of the living room or the office."""
    folder = Path(path)
    rate = rate or DEFAULT_RATE
    found = find_frames(folder / "rgb")
    unnumbered = [file for file in found.frames if parse_count(file.stem) is None]
    if unnumbered:
        raise SequenceError(f"{unnumbered[0]}: frames of ICL-NUIM are named by their number")
    entries = [ImageEntry(int(file.stem) / rate, file, str(file)) for file in found.frames]
    numbered = read_trajectory(sorted(folder.glob(ICL_TRUTH))[0])
    mirror = torch.diag(torch.tensor(ICL_MIRROR, dtype=torch.float64, device="cpu"))
    groundtruth = Trajectory(numbered.timestamps / rate, mirror @ numbered.T_wc @ mirror)
    camera = PRESETS["icl"] if camera is None else camera
    sequence = ImageSequence(folder.name, "ICL-NUIM folder", entries, camera, groundtruth, found.notes)
    return _with_depth(sequence, folder / "depth")


def _open_seven_scenes(path: str, camera: GivenCamera | None, rate: float | None) -> ImageSequence:
    """One sequence (`seq-01`), at the Kinect's 30 frames per second, with the poses of its depth camera.

    The dataset gives no calibration of the color camera; without `camera` its nominal focal length is a guess.
    """
    folder = Path(path)
    found = match_pattern(str(folder / SEVEN_SCENES_COLOR))
    entries = at_rate(found.frames, rate or DEFAULT_RATE)
    times: list[float] = []
    poses: list[Tensor] = []
    for entry in entries:
        pose = entry.path.with_name(entry.path.name.replace(".color.png", ".pose.txt"))
        T_wc = _read_pose(pose) if pose.is_file() else None
        if T_wc is not None:
            times.append(entry.timestamp)
            poses.append(T_wc)
    groundtruth = None
    if poses:
        groundtruth = Trajectory(torch.tensor(times, dtype=torch.float64, device="cpu"), torch.stack(poses))
    camera = PRESETS["7-scenes"] if camera is None else camera
    name = f"{folder.resolve().parent.name}/{folder.name}" if folder.name.startswith("seq-") else folder.name
    sequence = ImageSequence(name, "7-Scenes folder", entries, camera, groundtruth, found.notes)
    has_depth = next(folder.glob(SEVEN_SCENES_DEPTH), None) is not None
    return _with_depth(sequence, folder, SEVEN_SCENES_DEPTH_CAMERA) if has_depth else sequence


def _read_pose(path: Path) -> Float[Tensor, "4 4"] | None:
    """T_wc; None where tracking had failed: the dataset then writes numbers that are no rotation."""
    text = read_text(path, TrajectoryError).lower()
    if "nan" in text or "inf" in text:
        return None
    rows = [row for _, row in number_rows(path, "r1 r2 r3 t", TrajectoryError)]
    if len(rows) != 4:
        raise TrajectoryError(f"{path}: expected four lines of four numbers")
    T_wc = torch.tensor(rows, dtype=torch.float64, device="cpu")
    R = T_wc[:3, :3]
    if (R @ R.mT - torch.eye(3, dtype=R.dtype, device="cpu")).abs().max() > ORTHOGONAL:
        return None
    return checked_poses(rigid(nearest_rotation(R), T_wc[:3, 3])[None], path)[0]


def _open_tartanair(path: str, camera: GivenCamera | None, rate: float | None) -> ImageSequence:
    """The left camera of a trajectory; the dataset has no times, so that `rate` or 30 frames per second are taken."""
    folder = Path(path)
    name = _tartanair_camera(folder) or TARTANAIR_CAMERAS[0]
    found = find_frames(folder / f"image_{name}")
    entries = at_rate(found.frames, rate or DEFAULT_RATE)
    truth = _read_tartanair_poses(folder / f"pose_{name}.txt", [entry.timestamp for entry in entries])
    camera = PRESETS["tartanair"] if camera is None else camera
    return ImageSequence(folder.name, "TartanAir folder", entries, camera, truth, found.notes)


def _tartanair_camera(folder: Path) -> str | None:
    for name in TARTANAIR_CAMERAS:
        if (folder / f"image_{name}").is_dir() and (folder / f"pose_{name}.txt").is_file():
            return name
    return None


def _read_tartanair_poses(path: Path, times: list[float]) -> Trajectory:
    """One line `tx ty tz qx qy qz qw` per frame."""
    places, rows = zip(*number_rows(path, "tx ty tz qx qy qz qw", TrajectoryError), strict=True)
    if len(rows) != len(times):
        raise TrajectoryError(f"{path}: {len(rows)} poses for {len(times)} images")
    T_wc = poses_from_rows(torch.tensor(rows, dtype=torch.float64, device="cpu"), places)
    axes = torch.tensor(TARTANAIR_AXES, dtype=torch.float64, device="cpu")
    T_wc = rigid(T_wc[:, :3, :3] @ axes, T_wc[:, :3, 3])
    return Trajectory(torch.tensor(times, dtype=torch.float64, device="cpu"), T_wc)


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
