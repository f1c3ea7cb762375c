"""A live camera, in a program that has something else to do with the poses, for instance to steer by them.

    python -m examples.live_camera 0 fov=65 --seconds 60
    python -m examples.live_camera rtsp://192.168.0.8/stream 640,640,639.5,359.5 --map map.safetensors

Frames that come while one takes long wait for a moment; what then has to be dropped is counted. With a map that an
earlier run wrote, the camera finds itself in it; where that fails for long, a new world begins beside it.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import torch

from torchslam import SLAM, StepResult, open_sequence
from torchslam.data import EndOfSequence


def steer(result: StepResult, delay: float) -> None:
    """What is done with a pose: here it is printed. Believe `tracking` alone; `uncertain` may be wrong."""
    if result.T_cw is None:
        print(f"{result.index:6d} {result.state.value}: {result.reason}")
        return
    x, y, z = result.T_cw.inverse()[:3, 3].tolist()
    print(f"{result.index:6d} {result.state.value} at {x:.3f} {y:.3f} {z:.3f}, {1000 * delay:.0f} ms old")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("source", help="a camera's number, or an rtsp:// or http:// address")
    parser.add_argument("camera", help="fx,fy,cx,cy in pixels, or what else `torchslam run --camera` takes")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--map", type=Path, help="of an earlier run with the same camera: go on in it")
    parser.add_argument("--save", type=Path, default=Path("map.safetensors"), help="the map, at the end")
    arguments = parser.parse_args()

    torch.set_num_threads(1)  # a frame's tensors are small: threads cost more than they bring
    source = open_sequence(arguments.source, arguments.camera)
    slam = SLAM(source.camera) if arguments.map is None else SLAM.load(arguments.map)
    until = time.time() + arguments.seconds
    try:
        for index in source.indices():
            frame = source[index]  # waits for the next one; its timestamp says when it was taken
            steer(slam.step(frame), time.time() - frame.timestamp)
            if time.time() > until:
                break
    except (EndOfSequence, KeyboardInterrupt):
        pass
    slam.conclude()
    slam.save(arguments.save)
    print(f"{len(slam.trajectory())} poses, {slam.map.num_points} points, {source.dropped} frames dropped")


if __name__ == "__main__":
    main()
