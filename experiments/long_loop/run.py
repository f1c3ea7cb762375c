"""Does the cost of a frame grow with the length of the run? See README.md."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from experiments.common import parser_of, table, write_between
from torchslam.config import load_config
from torchslam.geometry import Camera, rigid, se3_inverse, so3_exp
from torchslam.system.front_end import Simulated
from torchslam.system.slam import SLAM
from torchslam.types import Frame


def loop_poses(frames: int, frames_per_lap: int = 500) -> Tensor:
    """(F, 4, 4) T_cw of a camera that walks an ellipse, looks ahead and outwards, and never quite repeats itself."""
    s = torch.arange(frames, dtype=torch.float64) * (2 * math.pi / frames_per_lap)
    drift = 0.5 * torch.sin(s / 7.3)
    centers = torch.stack([10 * torch.cos(s), drift, 6 * torch.sin(s)], -1)
    heading = -(s + 0.4)
    zero = torch.zeros_like(s)
    about_y = torch.stack([zero, heading, zero], -1)
    return se3_inverse(rigid(so3_exp(about_y), centers))


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--frames", type=int, default=3000)
    frames = parser.parse_args().frames
    torch.set_num_threads(1)
    poses = loop_poses(frames)
    camera = Camera.pinhole(500.0, 500.0, 319.5, 239.5, size=(640, 480))
    config = load_config(None, ["features.kind=simulated", "simulated.noise_px=0.5"])
    slam, eyes = SLAM(camera, config), Simulated(config, camera, poses)
    blank = torch.zeros(1, 1, 480, 640)
    ms, states = [], []
    for i, T_cw in enumerate(poses):
        before = time.process_time()
        frame = Frame(i, i / 30, blank, f"frame {i}", T_cw)
        result = slam.step(replace(frame, features=eyes(frame)))
        ms.append(1e3 * (time.process_time() - before))
        states.append(result.state.value)
        if i % 300 == 299:
            print(
                i + 1,
                f"{torch.tensor(ms[-300:]).median():.1f} ms",
                slam.map.num_keyframes,
                slam.map.num_points,
                flush=True,
            )
    cost = torch.tensor(ms, dtype=torch.float64)
    rows = []
    for start in range(0, frames - 299, 300):
        part = cost[start : start + 300]
        rows.append([f"{start} to {start + 300}", f"{part.median():.1f}", f"{part.quantile(0.95):.1f}"])
    ratio = cost[-300:].median() / cost[300:600].median()
    summary = (
        f"\nMedian of the last 300 frames over that of frames 300 to 600: {ratio:.2f}. "
        f"{slam.map.num_keyframes} keyframes, {slam.map.num_points} points, {states.count('lost')} frames lost.\n"
    )
    write_between(
        Path(__file__).parent / "README.md", table(["frames", "median (ms)", "95 % (ms)"], rows) + summary
    )
    print(summary)


if __name__ == "__main__":
    main()
