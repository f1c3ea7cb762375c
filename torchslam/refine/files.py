"""Write refined poses in their original format: TUM trajectory, COLMAP model or transforms.json."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch

from torchslam.data.formats.given_poses import COLMAP, NERFSTUDIO
from torchslam.data.text_file import read_text
from torchslam.data.trajectories import write_trajectory
from torchslam.errors import TrajectoryError
from torchslam.geometry import se3_inverse
from torchslam.geometry.transforms import opengl
from torchslam.io.export.colmap import write_colmap
from torchslam.io.export.nerfstudio import nerfstudio_camera
from torchslam.io.export.scene import scene_of
from torchslam.refine.pose_refinement import RefinementResult
from torchslam.types import Trajectory
from torchslam.utils.files import JSON_BYTES, parse_json

# Keys of a camera in a transforms.json; all of them are replaced.
CAMERA_KEYS = (
    *("camera_model", "w", "h", "fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2"),
    *("camera_angle_x", "camera_angle_y", "is_fisheye"),
)


def write_refined(folder: Path, refined: RefinementResult) -> Path:
    """Write the refined poses, and the covariances of the keyframes, into a folder; return the file or folder."""
    folder.mkdir(parents=True, exist_ok=True)
    given, run = refined.given, refined.run
    _write_covariances(folder / "covariances.txt", refined)
    if given.kind == COLMAP:  # images are renumbered in the order of the frames
        assert run.main is not None
        scene = scene_of(run.main, run.camera, run.session, keyframes_alone=False)
        write_colmap(folder, scene, [_name(refined, frame) for frame in scene.frame_ids.tolist()])
        return folder
    frames, order = run.posed_frames.frames["frame_index"].cpu().sort()
    T_wc = se3_inverse(run.posed_frames.T_cw(run.map).cpu()[order])
    rows = refined.pose_rows[frames]
    if given.kind == NERFSTUDIO:
        path = folder / given.path.name
        _write_transforms(path, refined, dict(zip(rows.tolist(), opengl(T_wc).tolist(), strict=True)))
        return path
    path = folder / (given.path.name or "trajectory.txt")
    assert given.timestamps is not None
    write_trajectory(path, Trajectory(given.timestamps[rows], T_wc))
    return path


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


def _write_transforms(path: Path, refined: RefinementResult, poses: dict[int, Any]) -> None:
    """Write the original file with new poses by its rows, and the new camera; other content stays."""
    content = parse_json(read_text(refined.given.path, TrajectoryError, JSON_BYTES))
    frames = [
        {key: value for key, value in frame.items() if key not in CAMERA_KEYS}
        | {"transform_matrix": poses[row]}
        for row, frame in enumerate(content["frames"])
        if row in poses
    ]
    about = {key: value for key, value in content.items() if key not in CAMERA_KEYS}
    written = nerfstudio_camera(refined.run.camera) | about | {"frames": frames}
    path.write_text(json.dumps(written, indent=2) + "\n", encoding="utf-8")
