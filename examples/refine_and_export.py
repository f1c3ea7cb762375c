"""Refine the poses of another program (a phone, a network, another SLAM system) with the images, and export to COLMAP.

    python -m examples.refine_and_export photos/ poses.txt 525,525,319.5,239.5 --output refined

poses.txt has lines `timestamp tx ty tz qx qy qz qw`, camera to world; a COLMAP model or a transforms.json works as
well. The result keeps the frame and the unit of the given poses, and has a covariance for every keyframe.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

from torchslam import open_sequence
from torchslam.data import write_trajectory
from torchslam.io.export.colmap import write_colmap
from torchslam.io.export.scene import scene_of
from torchslam.refine import CameraChoice, refine_poses


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("images", help="any input of `torchslam run`")
    parser.add_argument("poses", help="TUM trajectory, folder of a COLMAP model, or transforms.json")
    parser.add_argument("camera", nargs="?", help="required unless the images have a calibration")
    parser.add_argument("--output", type=Path, default=Path("refined"))
    arguments = parser.parse_args()

    torch.set_num_threads(1)  # a frame's tensors are small: more threads are slower
    sequence = open_sequence(arguments.images, arguments.camera)
    refined = refine_poses(sequence, arguments.poses, choice=CameraChoice.IF_CONTRADICTED, on_progress=print)
    run = refined.run
    if run.main is None:
        raise SystemExit(f"the poses could not be refined: {run.failure}")

    arguments.output.mkdir(parents=True, exist_ok=True)
    write_trajectory(arguments.output / "trajectory.txt", run.trajectory)
    scene = scene_of(run.main, run.camera, run.session, keyframes_alone=True)
    write_colmap(arguments.output / "sparse" / "0", scene)

    moved = (run.trajectory.positions_w - run.online.positions_w).norm(dim=-1)  # against the given poses
    deviations = run.map.keyframes["covariances"][:, :3, :3].diagonal(dim1=-2, dim2=-1).sum(-1).sqrt()
    print(
        f"{len(run.trajectory)} poses, {run.map.num_points} points, focal length {float(run.camera.focal):.1f} px"
    )
    print(
        f"moved by {float(moved.median()):.4f} (median), keyframe standard deviation {float(deviations.median()):.4f}"
    )
    print(f"mean reprojection error {float(scene.point_errors().mean()):.2f} px")


if __name__ == "__main__":
    main()
