"""Write refined poses in their original format: TUM trajectory, COLMAP model or transforms.json."""

from __future__ import annotations

import json
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchslam.data.formats.given_poses import COLMAP, NERFSTUDIO
from torchslam.data.text_file import read_text
from torchslam.data.trajectories import write_trajectory
from torchslam.errors import TrajectoryError
from torchslam.geometry import se3_inverse
from torchslam.geometry.transforms import opengl
from torchslam.io.export.colmap import write_colmap
from torchslam.io.export.nerfstudio import nerfstudio_camera
from torchslam.io.export.scene import ExportedScene, scene_of
from torchslam.refine.pose_refinement import RefinementResult
from torchslam.types import Trajectory
from torchslam.utils.files import JSON_BYTES, parse_json

COVARIANCES = "covariances.txt"
# Keys of a camera in a transforms.json; all of them are replaced.
CAMERA_KEYS = (
    *("camera_model", "w", "h", "fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2"),
    *("camera_angle_x", "camera_angle_y"),
)


@dataclass(frozen=True)
class NamedScene(ExportedScene):
    """A scene with the image names of another program.

    Attributes:
        names: By frame number.
    """

    names: dict[int, str]

    @property
    def image_names(self) -> list[str]:
        """The names of the images, one per frame."""
        return [self.names[index] for index in self.frame_ids.tolist()]


def write_refined(folder: Path, refined: RefinementResult) -> Path:
    """Write the refined poses, and the covariances of the keyframes, into a folder; return the file or folder."""
    folder.mkdir(parents=True, exist_ok=True)
    frames, T_cw = refined_poses(refined)
    given = refined.given
    _write_covariances(folder / COVARIANCES, refined)
    if given.kind == COLMAP:
        _write_colmap(folder, refined)
        return folder
    if given.kind == NERFSTUDIO:
        path = folder / given.path.name
        _write_transforms(path, refined, frames, T_cw)
        return path
    path = folder / (given.path.name or "trajectory.txt")
    assert given.timestamps is not None
    times = given.timestamps[refined.pose_rows[frames]]
    write_trajectory(path, Trajectory(times, se3_inverse(T_cw)))
    return path


def refined_poses(refined: RefinementResult) -> tuple[Int[Tensor, " F"], Float[Tensor, "F 4 4"]]:
    """Return the frames with a refined pose, ascending, and their T_cw."""
    posed_frames, slam_map = refined.run.posed_frames, refined.run.map
    frames = posed_frames.frames["frame_index"].cpu()
    order = torch.argsort(frames)
    return frames[order], posed_frames.T_cw(slam_map).cpu()[order]


def _name(refined: RefinementResult, frame: int) -> str:
    """The image of a frame in the given poses: its name, or its time."""
    row, given = int(refined.pose_rows[frame]), refined.given
    return given.names[row] if given.timestamps is None else repr(float(given.timestamps[row]))


def _write_covariances(path: Path, refined: RefinementResult) -> None:
    """Write a line per keyframe: image and upper triangle of the covariance of its pose, row by row."""
    keyframes = refined.run.map.keyframes
    upper = torch.triu_indices(6, 6, device="cpu")
    lines = [
        "# image, and the 21 numbers of the upper triangle of the covariance (6, 6) of T_cw, row by row:\n"
        "# of its left perturbation, translation then rotation, relative to the first keyframe (zero)\n"
    ]
    rows = torch.argsort(keyframes["frame_index"]).tolist()
    for row in rows:
        name = _name(refined, int(keyframes["frame_index"][row]))
        numbers = keyframes["covariances"][row].cpu()[upper[0], upper[1]].tolist()
        lines.append(" ".join([name, *(f"{number:.6e}" for number in numbers)]) + "\n")
    path.write_text("".join(lines), encoding="utf-8")


def _write_colmap(folder: Path, refined: RefinementResult) -> None:
    """Write the model with the map's points; images are renumbered in the order of the frames."""
    assert refined.run.main is not None
    scene = scene_of(refined.run.main, refined.run.camera, refined.run.session, keyframes_alone=False)
    names = {frame: _name(refined, frame) for frame in scene.frame_ids.tolist()}
    columns: dict[str, Any] = {column.name: getattr(scene, column.name) for column in fields(ExportedScene)}
    write_colmap(folder, NamedScene(names=names, **columns))


def _write_transforms(path: Path, refined: RefinementResult, frames: Tensor, T_cw: Tensor) -> None:
    """Write the original file with new poses and camera; other content stays."""
    content = parse_json(read_text(refined.given.path, TrajectoryError, JSON_BYTES))
    rows = refined.pose_rows[frames].tolist()
    poses = dict(zip(rows, opengl(se3_inverse(T_cw)).tolist(), strict=True))
    written_frames = [
        {key: value for key, value in frame.items() if key not in CAMERA_KEYS}
        | {"transform_matrix": poses[row]}
        for row, frame in enumerate(content["frames"])
        if row in poses
    ]
    about = {key: value for key, value in content.items() if key not in CAMERA_KEYS}
    written = nerfstudio_camera(refined.run.camera) | about | {"frames": written_frames}
    path.write_text(json.dumps(written, indent=2) + "\n", encoding="utf-8")
