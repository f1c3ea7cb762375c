"""Run SLAM in your own loop: pass images one by one and get the pose of each.

    python -m examples.own_loop 'photos/*.png' 525,525,319.5,239.5

The online poses are printed. The final trajectory is written to trajectory.txt, and the map to map.safetensors for
`torchslam run --map` or `SLAM.load`.
"""

from __future__ import annotations

import argparse
import glob
from pathlib import Path

import cv2
import torch

from torchslam import SLAM, TorchslamError
from torchslam.data import parse_camera, write_trajectory

RATE = 30.0  # images per second, for images without timestamps


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("images", help="quoted pattern of files; read in the order of their names")
    parser.add_argument(
        "camera", help="fx,fy,cx,cy in pixels, or any other value of `torchslam run --camera`"
    )
    parser.add_argument("--output", type=Path, default=Path("."), help="folder for trajectory and map")
    arguments = parser.parse_args()

    torch.set_num_threads(1)  # a frame's tensors are small: more threads are slower
    slam = None
    for number, name in enumerate(sorted(glob.glob(arguments.images))):
        image = cv2.imread(name)  # (H, W, 3) uint8, blue first
        if image is None:
            continue
        if slam is None:
            slam = SLAM(parse_camera(arguments.camera, (image.shape[1], image.shape[0])))
        try:
            result = slam.step_image(image, timestamp=number / RATE, channels="bgr")
        except TorchslamError as error:  # the size differs from that of the images before
            print(f"{name}: skipped: {error}")
            continue
        where = (
            ""
            if result.T_cw is None
            else " ".join(f"{x:8.4f}" for x in result.T_cw.inverse()[:3, 3].tolist())
        )
        print(f"{name}: {result.state.value} {where} {result.reason}")
    if slam is None:
        raise SystemExit(f"no image at {arguments.images}")

    slam.finalize()  # accept the pending frames with their poses
    arguments.output.mkdir(parents=True, exist_ok=True)
    write_trajectory(arguments.output / "trajectory.txt", slam.trajectory())  # camera to world
    slam.save(arguments.output / "map.safetensors")
    print(f"{len(slam.trajectory())} poses, {slam.map.num_points} points")


if __name__ == "__main__":
    main()
