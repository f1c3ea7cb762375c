"""The refined poses in the form in which they were given: a TUM trajectory, a COLMAP model, a transforms.json."""

from __future__ import annotations

import json
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchslam.data.formats.given_poses import COLMAP, NERFSTUDIO
from torchslam.data.formats.text_file import read_text
from torchslam.data.formats.trajectory_file import write_trajectory
from torchslam.errors import TrajectoryError
from torchslam.geometry import se3_inverse
from torchslam.geometry.conventions import opengl
from torchslam.io.export.colmap import write_colmap
from torchslam.io.export.nerfstudio import nerfstudio_camera
from torchslam.io.export.scene import Scene, scene_of
from torchslam.refine.pose_refinement import Refined
from torchslam.types import Trajectory
from torchslam.utils.bounded_read import JSON_BYTES, parse_json

COVARIANCES = "covariances.txt"
# What a transforms.json says of a camera: all of it is replaced.
CAMERA_KEYS = (
    *("camera_model", "w", "h", "fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2"),
    *("camera_angle_x", "camera_angle_y"),
)


@dataclass(frozen=True)
class NamedScene(Scene):
    """A scene whose images are called as another program calls them: names by number of the frame."""

    names: dict[int, str]

    @property
    def image_names(self) -> list[str]:
        return [self.names[index] for index in self.frame_ids.tolist()]


def write_refined(folder: Path, refined: Refined) -> Path:
    """Write the poses, and the covariances of those of the keyframes, into a folder that is made if need be.

    Poses that were not refined are left out. Returns the file, of COLMAP the folder.
    """
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
    times = given.timestamps[refined.rows[frames]]
    write_trajectory(path, Trajectory(times, se3_inverse(T_cw)))
    return path


def refined_poses(refined: Refined) -> tuple[Tensor, Tensor]:
    """(n,) the frames of the sequence that have a refined pose, ascending, and (n, 4, 4) T_cw."""
    posed_frames, slam_map = refined.run.posed_frames, refined.run.map
    frames = posed_frames.frames["frame_index"].cpu()
    order = torch.argsort(frames)
    return frames[order], posed_frames.T_cw(slam_map).cpu()[order]


def _name(refined: Refined, frame: int) -> str:
    """What the image of a frame is called where its pose came from: its name, or its time."""
    row, given = int(refined.rows[frame]), refined.given
    return given.names[row] if given.timestamps is None else repr(float(given.timestamps[row]))


def _write_covariances(path: Path, refined: Refined) -> None:
    """A line for each keyframe: its image and the upper triangle of the covariance of its pose, row by row."""
    keyframes = refined.run.map.keyframes
    upper = torch.triu_indices(6, 6)
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


def _write_colmap(folder: Path, refined: Refined) -> None:
    """The model with the map's points; images are numbered anew, in the order of the frames."""
    assert refined.run.main is not None
    scene = scene_of(refined.run.main, refined.run.camera, refined.run.session, keyframes_alone=False)
    names = {frame: _name(refined, frame) for frame in scene.frame_ids.tolist()}
    columns: dict[str, Any] = {column.name: getattr(scene, column.name) for column in fields(Scene)}
    write_colmap(folder, NamedScene(names=names, **columns))


def _write_transforms(path: Path, refined: Refined, frames: Tensor, T_cw: Tensor) -> None:
    """The file as it was, with other poses and the camera; what else it says of its frames stays."""
    content = parse_json(read_text(refined.given.path, TrajectoryError, JSON_BYTES))
    rows = refined.rows[frames].tolist()
    poses = dict(zip(rows, opengl(se3_inverse(T_cw)).tolist(), strict=True))
    kept = [
        {key: value for key, value in frame.items() if key not in CAMERA_KEYS}
        | {"transform_matrix": poses[row]}
        for row, frame in enumerate(content["frames"])
        if row in poses
    ]
    about = {key: value for key, value in content.items() if key not in CAMERA_KEYS}
    written = nerfstudio_camera(refined.run.camera) | about | {"frames": kept}
    path.write_text(json.dumps(written, indent=2) + "\n", encoding="utf-8")
