"""Poses of images by another program: a TUM trajectory, a COLMAP model or a transforms.json."""

from __future__ import annotations

import contextlib
import os
import struct
from collections import Counter
from collections.abc import Sequence as Listed
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchslam.data.calibration import Calibration
from torchslam.data.formats.calibration_files import COLMAP_MODELS, from_colmap, has_cameras, read_calibration
from torchslam.data.sequence import GROUNDTRUTH_TOLERANCE, Sequence
from torchslam.data.text_file import are_numbers, float64, numbered_lines, parse_floats, read_text
from torchslam.data.trajectories import checked_poses, nearest, poses_from_rows, read_trajectory
from torchslam.errors import CalibrationError, FrameError, TrajectoryError
from torchslam.geometry.lie import rigid, se3_inverse
from torchslam.geometry.similarity import nearest_rotation
from torchslam.geometry.transforms import opengl
from torchslam.utils.files import JSON_BYTES, parse_json, read_bytes

TUM, COLMAP, NERFSTUDIO = "tum", "colmap", "nerfstudio"
TRANSFORMS = "transforms.json"
_MAX_BYTES = 1 << 30  # largest model that is read; a frame with 10,000 keypoints takes 240 kB of it


@dataclass(frozen=True)
class GivenPoses:
    """N poses, each of an image known by its time, seconds, or by its name.

    Attributes:
        kind: "tum", "colmap" or "nerfstudio"
        path: the file, or the folder of a COLMAP model
        T_cw: world to camera, camera axes x right, y down, z forward
        calibration: of the images, if known
    """

    kind: str
    path: Path
    T_cw: Float[Tensor, "N 4 4"]
    timestamps: Float[Tensor, " N"] | None = None
    names: tuple[str, ...] = ()
    calibration: Calibration | None = None

    def __post_init__(self) -> None:
        """Raise TrajectoryError for a name that could not be a word of a line, and for a pose that is none."""
        wrong = [name for name in self.names if not name.isprintable()]
        if wrong:
            raise TrajectoryError(f"{self.path}: the name of an image has control characters: {wrong[0]!r}")
        checked_poses(self.T_cw.cpu(), self.path)

    @property
    def is_world_to_camera(self) -> bool:
        """Whether the format has poses from world to camera."""
        return self.kind == COLMAP

    def __len__(self) -> int:
        return len(self.T_cw)

    def rows(self, sequence: Sequence) -> Int[Tensor, " F"]:
        """Return the row of the pose of each frame of a sequence, -1 without a pose; no pose belongs to two frames.

        Raises TrajectoryError where no frame has one, for poses that are left over where the times of images are
        counted, and for images that are turned by their EXIF orientation where the poses are of the stored images.
        """
        times = self.timestamps
        if times is None:
            found = rows_by_name(self.names, [sequence.image_name(i) for i in range(len(sequence))])
            how = f"no image has one of its names, such as {self.names[0]}"
        else:
            # The nearest pose of each frame, if near enough, and if the frame is the nearest of the pose in turn.
            nearest_row, distances = nearest(sequence.timestamps, times)
            back, _ = nearest(times, sequence.timestamps)
            is_pair = back[nearest_row] == torch.arange(len(nearest_row), device="cpu")
            found = torch.where((distances <= GROUNDTRUTH_TOLERANCE) & is_pair, nearest_row, -1)
            own, others = (
                f"from {each[0]} to {each[-1]} s" for each in (times.tolist(), sequence.timestamps.tolist())
            )
            how = f"its times, {own}, are not those of the images, {others}"
        frames = torch.nonzero(found >= 0)[:, 0].tolist()
        if not frames:
            raise TrajectoryError(f"{self.path}: no pose is that of an image of {sequence.name}: {how}")
        if times is not None and sequence.counted_until is not None:
            without_image = int((times > sequence.counted_until).sum())
            if without_image:
                raise TrajectoryError(
                    f"{self.path}: {without_image} of {len(self)} poses are of no image of {sequence.name}, whose "
                    "times are counted: with one image more or less, the others have wrong poses; name the images "
                    "by their times, or list them in rgb.txt"
                )
        # COLMAP, and what builds on it, sees images as they are stored.
        for frame in frames if times is None else ():
            with contextlib.suppress(FrameError):  # said when the frame is read
                if sequence.is_turned(frame):
                    raise TrajectoryError(
                        f"{sequence.image_name(frame)}: its EXIF orientation turns it, which {self.path} ignores: open "
                        "the sequence with the camera in there (without --camera), or remove the tag from the images"
                    )
        return found


def read_poses(path: str | Path, with_camera: bool = True) -> GivenPoses:
    """The poses in a TUM trajectory, a folder with a COLMAP model, or a transforms.json (or a folder with one).

    with_camera: whether the camera is read as well, which must be one.

    Raises TrajectoryError or CalibrationError naming the file.
    """
    path = Path(path)
    models = ("images.bin", "images.txt")
    if os.path.isdir(path):  # Path.is_dir raises for a name that is too long
        inside = next((name for name in (TRANSFORMS, *models) if (path / name).is_file()), None)
        if inside is None:
            raise TrajectoryError(f"{path}: neither {' or '.join(models)} of COLMAP nor {TRANSFORMS} in it")
        path = path / inside
    if path.name in models:
        return _read_colmap(path.parent, path.suffix == ".bin", with_camera)
    if path.suffix.lower() == ".json":
        return _read_transforms(path, with_camera)
    trajectory = read_trajectory(path)
    return GivenPoses(TUM, path, se3_inverse(trajectory.T_wc), trajectory.timestamps)


def rows_by_name(names: Listed[str], images: list[str]) -> Int[Tensor, " F"]:
    """The row of each image's name, with most in common from its end: `0/a.png` is that of `rgb/0/a.png`; -1 for none.

    Without a suffix as well (the first transforms.json had none); a name that two images have is that of none.
    """
    for key in (lambda name: PurePath(name).parts, lambda name: PurePath(name).with_suffix("").parts):
        for length in range(max(len(key(name)) for name in names), 0, -1):
            ends = [key(name)[-length:] for name in names]
            image_ends = [key(image)[-length:] for image in images]
            single, own = Counter(ends), Counter(image_ends)
            rows = {end: row for row, end in enumerate(ends) if single[end] == 1}
            found = [rows.get(end, -1) if own[end] == 1 else -1 for end in image_ends]
            if max(found, default=-1) >= 0:
                return torch.tensor(found, device="cpu")
    return torch.full((len(images),), -1, device="cpu")


def _read_colmap(folder: Path, binary: bool, with_camera: bool) -> GivenPoses:
    """Source: https://colmap.github.io/format.html."""
    read = _binary_images if binary else _text_images
    images = sorted(read(folder / f"images.{'bin' if binary else 'txt'}"))
    if not images:
        raise TrajectoryError(f"{folder}: no images in the model")
    names, rows, cameras = zip(*images, strict=True)
    T_cw = poses_from_rows(float64(rows)[:, [4, 5, 6, 1, 2, 3, 0]], [f"{folder}: {name}" for name in names])
    calibration = None
    if with_camera:
        path = folder / f"cameras.{'bin' if binary else 'txt'}"
        lines = (
            _binary_cameras(path) if binary else [line for _, line in numbered_lines(path, CalibrationError)]
        )
        calibration = from_colmap(path, lines, cameras)
    return GivenPoses(COLMAP, folder, T_cw, None, names, calibration)


def _text_images(path: Path) -> list[tuple[str, list[float], str]]:
    """Names, `qw qx qy qz tx ty tz` and camera; the line after an image lists its points, and may be left out."""
    images, is_points = [], False
    for line in read_text(path, TrajectoryError).splitlines():
        if line.startswith("#"):
            continue
        words = line.split(maxsplit=9)
        numbers = line.split()  # observations in threes; ten words are an image whose name is a number
        if not words or (is_points and len(numbers) != 10 and are_numbers(numbers)):
            is_points = False
            continue
        if len(words) != 10:
            raise TrajectoryError(f"{path}: expected `id qw qx qy qz tx ty tz camera name`, got `{line}`")
        numbers_of_pose = parse_floats(" ".join(words[1:8]), str(path), TrajectoryError)
        images.append((words[9].strip(), numbers_of_pose, words[8]))
        is_points = True
    return images


def _binary_images(path: Path) -> list[tuple[str, list[float], str]]:
    images = []
    try:
        data = read_bytes(path, _MAX_BYTES, "a model that is read")
        (count,) = struct.unpack_from("<Q", data)
        at = 8
        for _ in range(count):
            _, *numbers, camera = struct.unpack_from("<I7dI", data, at)
            end = data.index(b"\0", at + 64)
            (points,) = struct.unpack_from("<Q", data, end + 1)
            images.append((data[at + 64 : end].decode(), numbers, str(camera)))
            at = end + 9 + 24 * points
    except (OSError, struct.error, ValueError, OverflowError) as cause:
        raise TrajectoryError(f"{path}: not COLMAP's images: {cause}") from cause
    return images


def _binary_cameras(path: Path) -> list[str]:
    """The cameras of a cameras.bin as lines of a cameras.txt."""
    # By its number (src/colmap/sensor/models.h); 7, FOV, is not modeled.
    models = dict(zip((*range(7), *range(8, 10)), COLMAP_MODELS, strict=True))
    lines, at = [], 8
    try:
        data = read_bytes(path, _MAX_BYTES, "a model that is read")
        (count,) = struct.unpack_from("<Q", data)
        for _ in range(count):
            number, model, width, height = struct.unpack_from("<IiQQ", data, at)
            if model not in models:
                raise CalibrationError(f"{path}: camera model {'FOV' if model == 7 else model} is not known")
            params = struct.unpack_from(f"<{len(COLMAP_MODELS[models[model]].split())}d", data, at + 24)
            at += 24 + 8 * len(params)
            lines.append(" ".join(map(str, (number, models[model], width, height, *params))))
    except (OSError, struct.error, OverflowError) as cause:
        raise TrajectoryError(f"{path}: not COLMAP's cameras: {cause}") from cause
    return lines


def _read_transforms(path: Path, with_camera: bool) -> GivenPoses:
    """Frames as nerfstudio, instant-ngp and the first NeRF write them; a world that was moved stays as it is."""
    try:
        content: Any = parse_json(read_text(path, TrajectoryError, JSON_BYTES))
        frames = [(str(frame["file_path"]), frame["transform_matrix"]) for frame in content["frames"]]
        T_wc = float64([matrix for _, matrix in frames])
    except (ValueError, KeyError, TypeError, RuntimeError, OverflowError) as cause:
        raise TrajectoryError(f"{path}: not the frames of a transforms.json: {cause!r}") from cause
    if T_wc.shape[1:] not in ((4, 4), (3, 4)):
        raise TrajectoryError(f"{path}: no frames with a transform_matrix of 4 x 4 numbers")
    places = [f"{path}: frame {name[:80]}" for name, _ in frames]
    checked_poses(T_wc, places)
    last = T_wc.new_tensor((0.0, 0.0, 0.0, 1.0))
    for row in torch.nonzero((T_wc[:, 3:] != last).any(-1).any(-1))[:1, 0].tolist():
        hint = ": it is transposed" if bool((T_wc[row, :, 3] == last).all()) else ""
        raise TrajectoryError(f"{places[row]}: the last row of transform_matrix is not 0 0 0 1{hint}")
    T_cw = se3_inverse(opengl(rigid(nearest_rotation(T_wc[:, :3, :3]), T_wc[:, :3, 3])))
    # Else the sequence or the user must know it.
    has_camera = "fl_x" in content or "camera_angle_x" in content or has_cameras(content["frames"])
    calibration = read_calibration(path) if with_camera and has_camera else None
    return GivenPoses(NERFSTUDIO, path, T_cw, None, tuple(name for name, _ in frames), calibration)
