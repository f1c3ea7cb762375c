"""Track a live camera in your own program, for example to steer by the poses.

    python -m examples.live_camera 0 fov=65 --seconds 60
    python -m examples.live_camera rtsp://192.168.0.8/stream 640,640,639.5,359.5 --map map.safetensors

A few frames are queued while a slow one is processed; dropped frames are counted. With the map of an earlier run, the
camera is relocalized in it; if that fails for long, a new submap is initialized.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import torch

from torchslam import SLAM, StepResult, open_sequence
from torchslam.data import EndOfSequence


def steer(result: StepResult, delay: float) -> None:
    """Use a pose: here, print it. Poses in the state `uncertain` may be wrong."""
    if result.T_cw is None:
        print(f"{result.index:6d} {result.state.value}: {result.reason}")
        return
    x, y, z = result.T_cw.inverse()[:3, 3].tolist()
    print(f"{result.index:6d} {result.state.value} at {x:.3f} {y:.3f} {z:.3f}, {1000 * delay:.0f} ms old")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("source", help="a camera's number, or an rtsp:// or http:// address")
    parser.add_argument(
        "camera", help="fx,fy,cx,cy in pixels, or any other value of `torchslam run --camera`"
    )
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--map", type=Path, help="map of an earlier run with the same camera, to continue in")
    parser.add_argument("--save", type=Path, default=Path("map.safetensors"), help="file for the final map")
    arguments = parser.parse_args()

    torch.set_num_threads(1)  # a frame's tensors are small: more threads are slower
    source = open_sequence(arguments.source, arguments.camera)
    slam = SLAM(source.camera) if arguments.map is None else SLAM.load(arguments.map)
    until = time.time() + arguments.seconds
    try:
        for index in source.indices():
            frame = source[index]  # waits for the next frame; its timestamp is the time of capture
            steer(slam.step(frame), time.time() - frame.timestamp)
            if time.time() > until:
                break
    except (EndOfSequence, KeyboardInterrupt):
        pass
    slam.finalize()
    slam.save(arguments.save)
    print(f"{len(slam.trajectory())} poses, {slam.map.num_points} points, {source.dropped} frames dropped")


if __name__ == "__main__":
    main()
