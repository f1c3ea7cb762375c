"""Export map and trajectory of a run to other programs: COLMAP, nerfstudio, MeshLab, rerun, evo.

  colmap      sparse/0/ with the model (binary and text) and images/: keyframes, points and tracks
  nerfstudio  transforms.json (OpenGL axes, z up), sparse_pc.ply and images/: keyframes; a slow camera has few, and
              --frames all provides more images for training
  ply         colored points, keyframes in red, z up
  rerun       recording (.rrd): points, path and all cameras; undistorted images and keypoints of the keyframes; z up
  tum, kitti  all poses, camera to world: a file with timestamps; a folder with poses.txt and times.txt

Lengths are in map units. Up is the mean up direction of the keyframes, since gravity is unknown. Images are read again
from the sequence of the run.

Then, for example, `ns-train splatfacto --data DIR/export/nerfstudio`, `train.py -s DIR/export/colmap` (3D Gaussian
Splatting knows pinhole cameras alone: --undistort), `rerun DIR/export/recording.rrd`, `evo_traj tum
DIR/export/trajectory.txt`.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float

from torchslam.cli import arguments
from torchslam.data.trajectories import read_trajectory, write_kitti, write_trajectory
from torchslam.errors import ConfigError, ResultsError
from torchslam.geometry import Camera, se3_inverse
from torchslam.geometry.transforms import upright_rotation
from torchslam.io.export.colmap import colmap_camera, write_colmap
from torchslam.io.export.nerfstudio import IMAGES, write_nerfstudio
from torchslam.io.export.ply import write_map_cloud
from torchslam.io.export.recording import import_rerun, write_recording
from torchslam.io.export.scene import (
    WITHOUT,
    ExportedScene,
    Images,
    open_images,
    scene_of,
    undistorted,
    write_images,
)
from torchslam.io.results import MAP, OTHER_TRAJECTORY, TRAJECTORY, read_metrics
from torchslam.map.atlas import Submap
from torchslam.map.file import read_atlas
from torchslam.system.run import keyframe_rows, keyframe_trajectory
from torchslam.types import Trajectory
from torchslam.utils.console import table

FOLDER = "export"  # in the folder of results
MODEL = Path("sparse") / "0"  # where COLMAP's programs and trainers of splats look for it


@dataclass(frozen=True)
class Job:
    """An export: what to write and where.

    Attributes:
        directory: results folder; `metrics`: its metrics.
        submap, camera: from its map.
        source, fps: path and frame rate of the images; None if they are not exported.
        undistort: convert images and keypoints to a pinhole camera.
    """

    directory: Path
    metrics: dict[str, Any]
    submap: Submap
    camera: Camera
    output: Path
    keyframes_alone: bool
    undistort: bool
    source: str | None
    fps: float | None

    @property
    def session(self) -> int:
        """Number of the run on the map."""
        return int(self.metrics["session"])

    @property
    def R_up(self) -> Float[torch.Tensor, "3 3"]:
        """Rotation from the map frame to the upright one, the same for every format."""
        return upright_rotation(se3_inverse(self.submap.map.T_cw).double())

    def scene(self) -> tuple[ExportedScene, Images | None]:
        """The exported scene and its images, if requested. Raises ResultsError if they cannot be read."""
        scene = scene_of(self.submap, self.camera, self.session, self.keyframes_alone)
        images = None
        if self.source is not None:
            images = open_images(self.source, scene, self.undistort, self.fps)
        return (undistorted(scene) if self.undistort else scene), images

    def trajectory(self) -> Trajectory:
        """The poses of the run in the submap; those of all frames are read, since localization adds none to the map."""
        if self.keyframes_alone:
            return keyframe_trajectory(self.submap.map, self.session)
        is_main = self.submap.number == self.metrics["submap"]
        name = TRAJECTORY if is_main else OTHER_TRAJECTORY.format(self.submap.number)
        return read_trajectory(self.directory / name)


@dataclass(frozen=True)
class Target:
    """An export format.

    Attributes:
        write: writes the export and returns rows for `table`.
        name: file or folder name.
        is_of_images: whether the format includes images.
        keyframes: whether only keyframes are exported by default.
    """

    write: Callable[[Job], dict[str, str]]
    name: str
    is_of_images: bool
    keyframes: bool


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `torchslam export`."""
    parser.add_argument("directory", type=Path, metavar="DIR", help="folder that `torchslam run` wrote")
    parser.add_argument("--to", choices=TARGETS, required=True, help="export format")
    parser.add_argument(
        "--output",
        "-o",
        type=Path,
        metavar="PATH",
        help=f"file or folder to write (default: in DIR/{FOLDER})",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace existing files")
    parser.add_argument(
        "--frames",
        choices=("all", "keyframes"),
        help="which of the posed frames to export (default: see above)",
    )
    parser.add_argument(
        "--submap", type=arguments.not_negative, metavar="N", help="submap to export (default: the main one)"
    )
    parser.add_argument(
        "--undistort", action="store_true", help="undistort images and keypoints (always done for rerun)"
    )
    parser.add_argument("--sequence", metavar="PATH", help="new location of the sequence, if it was moved")
    parser.add_argument("--no-images", action="store_true", help="export no images")


def execute(options: argparse.Namespace) -> int:
    """Execute `torchslam export`; returns the exit status."""
    target = TARGETS[options.to]
    if options.undistort and not target.is_of_images:
        raise ConfigError(f"--undistort: an export to {options.to} contains no images")
    if options.to == "rerun":
        import_rerun()
    job = _job(options, target)
    _make_way(job.output, options.overwrite)
    written = target.write(job)
    print(table(written | {"written": str(job.output)}))
    return 0


def _job(options: argparse.Namespace, target: Target) -> Job:
    """Build the export from the arguments. Raises ResultsError if the results lack something."""
    directory = options.directory
    if not directory.is_dir():
        raise ResultsError(f"{directory}: no such results folder")
    metrics, saved = read_metrics(directory), read_atlas(directory / MAP)
    number = metrics["submap"] if options.submap is None else options.submap
    submaps = {submap.number: submap for submap in saved.atlas}
    if not submaps:
        raise ResultsError(f"{directory}: contains no map: {metrics.get('failure', '')}")
    if number not in submaps:
        raise ResultsError(f"{directory}: no submap {number}: there are {', '.join(map(str, submaps))}")
    keyframes_alone = options.frames == "keyframes" or (options.frames is None and target.keyframes)
    source = None
    if target.is_of_images and not options.no_images:
        source = options.sequence or metrics.get("source")
        if source is None:
            raise ResultsError(f"{directory}: the location of the images is unknown: {WITHOUT}")
    return Job(
        directory=directory,
        metrics=metrics,
        submap=submaps[number],
        camera=saved.camera,
        output=options.output or directory / FOLDER / target.name,
        keyframes_alone=keyframes_alone,
        undistort=options.undistort or options.to == "rerun",
        source=source,
        fps=metrics.get("source_fps"),
    )


def _make_way(output: Path, overwrite: bool) -> None:
    """Create the parent folder of an export. Raises ResultsError if it would replace something."""
    is_taken = any(output.iterdir()) if output.is_dir() else output.exists()
    if is_taken and not overwrite:
        raise ResultsError(f"{output}: already exists; --overwrite replaces it")
    output.parent.mkdir(parents=True, exist_ok=True)


def _colmap(job: Job) -> dict[str, str]:
    scene, images = job.scene()
    if images is not None:
        write_images(job.output / IMAGES, scene, images)
    write_colmap(job.output / MODEL, scene)
    return {"camera": colmap_camera(scene.camera)[0]} | _describe_scene(job, scene)


def _nerfstudio(job: Job) -> dict[str, str]:
    scene, images = job.scene()
    if images is not None:
        write_images(job.output / IMAGES, scene, images)
    write_nerfstudio(job.output, scene, job.R_up)
    return _describe_scene(job, scene)


def _rerun(job: Job) -> dict[str, str]:
    scene, images = job.scene()
    write_recording(job.output, scene, job.R_up, images)
    return _describe_scene(job, scene)


def _describe_scene(job: Job, scene: ExportedScene) -> dict[str, str]:
    error = float(scene.point_errors().mean()) if len(scene.points_w) else 0.0
    frames = f"{len(scene.T_cw)}, {int(scene.is_keyframe.sum())} of them keyframes"
    if job.keyframes_alone:
        posed = job.submap.posed_frames.count(job.session)
        frames = f"{len(scene.T_cw)} keyframes of {posed} posed frames; --frames all exports all of them"
    return {
        "frames": frames,
        "points": f"{len(scene.points_w)} in {len(scene.pixels)} observations",
        "error": f"{error:.4f} px, mean over the points",
    }


def _ply(job: Job) -> dict[str, str]:
    write_map_cloud(job.output, job.submap.map, job.session)
    keyframes = len(keyframe_rows(job.submap.map, job.session))
    return {"points": f"{job.submap.map.num_points}, and {keyframes} keyframes"}


def _tum(job: Job) -> dict[str, str]:
    trajectory = job.trajectory()
    write_trajectory(job.output, trajectory)
    return {"poses": str(len(trajectory))}


def _kitti(job: Job) -> dict[str, str]:
    trajectory = job.trajectory()
    write_kitti(job.output, trajectory)
    return {"poses": str(len(trajectory))}


TARGETS = {
    "colmap": Target(_colmap, "colmap", is_of_images=True, keyframes=True),
    "nerfstudio": Target(_nerfstudio, "nerfstudio", is_of_images=True, keyframes=True),
    "ply": Target(_ply, "map.ply", is_of_images=False, keyframes=True),
    "rerun": Target(_rerun, "recording.rrd", is_of_images=True, keyframes=False),
    "tum": Target(_tum, "trajectory.txt", is_of_images=False, keyframes=False),
    "kitti": Target(_kitti, "kitti", is_of_images=False, keyframes=False),
}
