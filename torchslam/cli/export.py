"""Export map and trajectory of a run to other programs: COLMAP, nerfstudio, MeshLab, rerun, evo.

  colmap      sparse/0/ with the model (binary and text) and images/: keyframes, points and tracks
  nerfstudio  transforms.json (OpenGL axes, z up), sparse_pc.ply and images/: keyframes; a slow camera has few, and
              --frames all provides more images for training
  ply         colored points, keyframes in red, z up
  rerun       recording (.rrd): points, path and all cameras; undistorted images and keypoints of the keyframes; z up
  tum, kitti  all poses, camera to world: a file with timestamps; a folder with poses.txt and times.txt
  mesh        triangles of the surfaces as PLY, z up, from depth maps: extra `mesh` (Open3D)

Depth maps and the dense cloud, if the folder has them (`torchslam densify`), are part of the export. colmap: the
workspace `dense/` for stereo_fusion and poisson_mesher, and sparse/0/points3D.ply, from which 3D Gaussian Splatting
starts. nerfstudio: undistorted images with depth images, and dense_pc.ply, from which splatfacto starts. rerun: depth
images and points.

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
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float, Int

from torchslam.cli import arguments
from torchslam.data.trajectories import read_trajectory, write_kitti, write_trajectory
from torchslam.dense.cloud import PointCloud
from torchslam.dense.depth_maps import read_frames
from torchslam.errors import ConfigError, ResultsError
from torchslam.geometry import Camera
from torchslam.io.export.colmap import colmap_camera, write_colmap, write_workspace
from torchslam.io.export.mesh import import_open3d, write_mesh
from torchslam.io.export.nerfstudio import IMAGES, write_nerfstudio
from torchslam.io.export.ply import MAX_DRAWN, read_cloud, upright_from_map, write_cloud, write_map_cloud
from torchslam.io.export.recording import import_rerun, write_recording
from torchslam.io.export.scene import (
    ExportedScene,
    Images,
    enlarged,
    pinhole_within,
    undistorted,
    write_images,
)
from torchslam.io.results import DENSE_CLOUD, DEPTHS, OTHER_TRAJECTORY, TRAJECTORY, SavedRun, open_run
from torchslam.map.atlas import Submap
from torchslam.types import Trajectory
from torchslam.utils.console import table

FOLDER = "export"  # in the folder of results
MODEL = Path("sparse") / "0"  # where COLMAP's programs and trainers of splats look for it


@dataclass(frozen=True)
class Job:
    """An export: what to write and where.

    Attributes:
        run: what is exported, of its `submap`.
        output: file or folder to write.
        keyframes_alone: export keyframes instead of all posed frames.
        undistort: convert images and keypoints to a pinhole camera.
        has_images: images are part of it.
        sequence: new location of the images, if they were moved.
    """

    run: SavedRun
    submap: Submap
    output: Path
    keyframes_alone: bool
    undistort: bool
    has_images: bool
    sequence: str | None

    @property
    def R_up(self) -> Float[torch.Tensor, "3 3"]:
        """Rotation from the map frame to the upright one, the same for every format."""
        return upright_from_map(self.submap.map, self.submap.metric)

    @property
    def depths(self) -> Path | None:
        """The file of the depth maps of the exported submap; None if there are none."""
        path = self.run.directory / DEPTHS
        return path if self.submap is self.run.main and path.exists() else None

    @property
    def cloud(self) -> PointCloud | None:
        """The dense cloud in the world of the exported submap; None if there is none."""
        path = self.run.directory / DENSE_CLOUD
        return read_cloud(path, self.R_up) if self.submap is self.run.main and path.exists() else None

    def scene(
        self, pinhole: Camera | None = None, frame_ids: Int[torch.Tensor, " R"] | None = None
    ) -> tuple[ExportedScene, Images | None]:
        """The exported scene and its images, if requested, as requested or of other frames and another camera.

        Raises ResultsError if the images cannot be read.
        """
        scene = self.run.scene(self.submap, self.keyframes_alone and frame_ids is None)
        if frame_ids is not None:
            scene = scene.of_frames(frame_ids)
        if pinhole is None and self.undistort:
            pinhole = pinhole_within(scene.camera)
        images = self.run.images(scene, pinhole, self.sequence) if self.has_images else None
        return (scene if pinhole is None else undistorted(scene, pinhole)), images


class Target(NamedTuple):
    """An export format: its writer, which returns rows for `table`, and the name of its file or folder."""

    write: Callable[[Job], dict[str, str]]
    name: str
    is_of_images: bool = True
    """The format includes images."""
    keyframes: bool = True
    """By default only keyframes are exported."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `torchslam export`."""
    arguments.add_directory(parser)
    parser.add_argument("--to", choices=TARGETS, required=True, help="export format")
    about = f"file or folder to write (default: in DIR/{FOLDER})"
    parser.add_argument("--output", "-o", type=Path, metavar="PATH", help=about)
    parser.add_argument("--overwrite", action="store_true", help="replace existing files")
    parser.add_argument(
        "--frames",
        choices=("all", "keyframes"),
        help="which of the posed frames to export (default: see above)",
    )
    parser.add_argument(
        "--submap", type=arguments.at_least(0), metavar="N", help="submap to export (default: the main one)"
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
    if options.to == "mesh":
        import_open3d()
    run = open_run(options.directory)
    number = run.metrics["submap"] if options.submap is None else options.submap
    submaps = {submap.number: submap for submap in run.submaps}
    if not submaps:
        raise ResultsError(f"{run.directory}: contains no map: {run.metrics.get('failure', '')}")
    if number not in submaps:
        raise ResultsError(f"{run.directory}: no submap {number}: there are {', '.join(map(str, submaps))}")
    job = Job(
        run,
        submaps[number],
        output=options.output or run.directory / FOLDER / target.name,
        keyframes_alone=target.keyframes if options.frames is None else options.frames == "keyframes",
        undistort=options.undistort or options.to == "rerun",
        has_images=target.is_of_images and not options.no_images,
        sequence=options.sequence,
    )
    is_taken = any(job.output.iterdir()) if job.output.is_dir() else job.output.exists()
    if is_taken and not options.overwrite:
        raise ResultsError(f"{job.output}: already exists; --overwrite replaces it")
    job.output.parent.mkdir(parents=True, exist_ok=True)
    print(table(target.write(job) | {"written": str(job.output)}))
    return 0


def _colmap(job: Job) -> dict[str, str]:
    scene, images = job.scene()
    if images is not None:
        write_images(job.output / IMAGES, scene, images)
    write_colmap(job.output / MODEL, scene)
    about = {"camera": colmap_camera(scene.camera)[0]} | _describe_scene(job, scene)
    # What 3D Gaussian Splatting reads instead of the points of the model.
    cloud, start = job.cloud, job.output / MODEL / "points3D.ply"
    start.unlink(missing_ok=True)
    if cloud is not None:
        write_cloud(start, cloud.thinned(MAX_DRAWN))
    if job.depths is not None:
        frame_ids, camera = read_frames(job.depths)
        dense, small_images = job.scene(camera, frame_ids)
        write_workspace(job.output / "dense", dense, job.depths, cloud, small_images)
    return about | _describe_dense(job, cloud)


def _nerfstudio(job: Job) -> dict[str, str]:
    depths = job.depths if job.keyframes_alone else None  # nerfstudio wants depth for all frames or none
    if depths is None:
        scene, images = job.scene()
    else:
        frame_ids, camera = read_frames(depths)
        scene, images = job.scene(enlarged(camera, job.run.camera), frame_ids)
    if images is not None:
        write_images(job.output / IMAGES, scene, images)
    cloud = job.cloud
    write_nerfstudio(job.output, scene, job.R_up, cloud, depths)
    return _describe_scene(job, scene) | _describe_dense(job, cloud)


def _rerun(job: Job) -> dict[str, str]:
    (scene, images), cloud = job.scene(), job.cloud
    write_recording(job.output, scene, job.R_up, images, cloud, job.depths)
    return _describe_scene(job, scene) | _describe_dense(job, cloud)


def _mesh(job: Job) -> dict[str, str]:
    if job.depths is None:
        raise ResultsError(f"{job.run.directory / DEPTHS}: no depth maps: `torchslam densify` writes them")
    frame_ids, camera = read_frames(job.depths)
    images = job.scene(camera, frame_ids)[1]
    size = write_mesh(job.output, job.depths, job.R_up, images)
    return {
        "depth maps": str(len(frame_ids)),
        "voxels": f"{size.voxel:.3g} map units wide",
        "mesh": f"{size.triangles} triangles, {size.vertices} vertices",
    }


def _describe_dense(job: Job, cloud: PointCloud | None) -> dict[str, str]:
    about = {}
    if job.depths is not None:
        about["depth maps"] = str(len(read_frames(job.depths)[0]))
    if cloud is not None:
        about["dense cloud"] = f"{len(cloud)} points"
    return about


def _describe_scene(job: Job, scene: ExportedScene) -> dict[str, str]:
    error = float(scene.point_errors().mean()) if len(scene.points_w) else 0.0
    frames = f"{len(scene.T_cw)}, {int(scene.is_keyframe.sum())} of them keyframes"
    if job.keyframes_alone:
        posed = job.submap.posed_frames.count(job.run.session)
        frames = f"{len(scene.T_cw)} keyframes of {posed} posed frames; --frames all exports all of them"
    about = {
        "frames": frames,
        "points": f"{len(scene.points_w)} in {len(scene.pixels)} observations",
        "error": f"{error:.4f} px, mean over the points",
    }
    if readout := job.run.readout:
        about["keypoints"] = (
            f"corrected to the middle row of each image, for a readout of {readout.description()}; images are not"
        )
    return about


def _ply(job: Job) -> dict[str, str]:
    write_map_cloud(job.output, job.submap.map, job.run.session, job.submap.metric)
    keyframes = len(job.submap.map.keyframe_rows(job.run.session))
    return {"points": f"{job.submap.map.num_points}, and {keyframes} keyframes"}


def _poses(write: Callable[[Path, Trajectory], None], job: Job) -> dict[str, str]:
    if job.keyframes_alone:
        trajectory = job.submap.map.keyframe_trajectory(job.run.session)
    else:  # from the file, since localization adds no poses to the map
        is_main, number = job.submap is job.run.main, job.submap.number
        name = TRAJECTORY if is_main else OTHER_TRAJECTORY.format(number)
        trajectory = read_trajectory(job.run.directory / name)
    write(job.output, trajectory)
    return {"poses": str(len(trajectory))}


TARGETS = {
    "colmap": Target(_colmap, "colmap"),
    "nerfstudio": Target(_nerfstudio, "nerfstudio"),
    "ply": Target(_ply, "map.ply", is_of_images=False),
    "rerun": Target(_rerun, "recording.rrd", keyframes=False),
    "tum": Target(partial(_poses, write_trajectory), "trajectory.txt", is_of_images=False, keyframes=False),
    "kitti": Target(partial(_poses, write_kitti), "kitti", is_of_images=False, keyframes=False),
    "mesh": Target(_mesh, "mesh.ply"),
}
