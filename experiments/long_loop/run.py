"""Does the cost of a frame, or the map of one room, grow with the length of the run? See README.md.

python -m experiments.long_loop.run rounds
python -m experiments.long_loop.run to_and_fro
python -m experiments.long_loop.run storeys
python -m experiments.long_loop.run covered
"""

from __future__ import annotations

import math
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from experiments.common import parser_of, place_of, publish, table
from experiments.storey import render
from torchslam.config import Config, load_config
from torchslam.data import open_sequence
from torchslam.data.sequence import Sequence
from torchslam.data.synthetic.sequence import FOCAL, SIZE
from torchslam.evaluation import evaluate
from torchslam.geometry import Camera, rigid, se3_inverse, so3_exp
from torchslam.io.results import read_metrics
from torchslam.system.front_end import Simulated
from torchslam.system.online_run import finish
from torchslam.system.slam import SLAM
from torchslam.types import Frame, StepResult, Trajectory

FRAMES = {"rounds": 3000, "to_and_fro": 5000}
WINDOWS = 10
"""Rows of the table."""
HEADER = "frames | median (ms) | mean (ms) | 95 % (ms) | keyframes | points | rows of points | peak (MB)"
FRAMES_PER_LAP = 500
STOREYS = Path("results") / "storeys"
"""Folder of the rendered walk and of its runs."""
STOREYS_FRAMES = 1250, 2500, 5000
COVERED, COVERED_FRAMES, COVERED_WINDOW = range(600, 612), 1250, 80
"""Frames of the walk that show nothing, as those of a covered lens; frames of that run, and images of its windows."""
STOREYS_HEADER = "frames | posed | map kept | keyframes | ATE | online ATE | CPU, s | memory, MB"


def rounds(frames: int) -> Tensor:
    """(F, 4, 4) T_cw of a camera that walks an ellipse, looks ahead and outwards, and never quite repeats itself."""
    s = torch.arange(frames, dtype=torch.float64) * (2 * math.pi / FRAMES_PER_LAP)
    drift = 0.5 * torch.sin(s / 7.3)
    centers = torch.stack([10 * torch.cos(s), drift, 6 * torch.sin(s)], -1)
    zero = torch.zeros_like(s)
    about_y = torch.stack([zero, -(s + 0.4), zero], -1)
    return se3_inverse(rigid(so3_exp(about_y), centers))


class ToAndFro(Sequence):
    """The frames of a sequence forwards, backwards, forwards, with timestamps that go on."""

    def __init__(self, whole: Sequence, frames: int) -> None:
        period = 2 * (len(whole) - 1)
        self._whole = whole
        self._order = [min(i % period, period - i % period) for i in range(frames)]
        timestamps = torch.arange(frames, dtype=torch.float64) / whole.frame_rate
        posed = [(i, pose) for i, j in enumerate(self._order) if (pose := whole.pose(j)) is not None]
        truth = Trajectory(
            timestamps[[i for i, _ in posed]], se3_inverse(torch.stack([pose for _, pose in posed]))
        )
        super().__init__(whole.name, whole.kind, whole.camera, timestamps, truth)

    def image(self, index: int) -> Tensor:
        return self._whole.image(self._order[index])

    def image_name(self, index: int) -> str:
        return self._whole.image_name(self._order[index])


def simulated(frames: int) -> tuple[SLAM, Iterable[Frame]]:
    """Rounds of an ellipse with simulated features, 0.5 px of noise."""
    camera = Camera.pinhole(500.0, 500.0, 319.5, 239.5, size=(640, 480))
    config = load_config(None, ["features.kind=simulated", "simulated.noise_px=0.5"])
    poses, blank = rounds(frames), torch.zeros(1, 1, 480, 640)
    eyes = Simulated(config, camera, poses)

    def seen() -> Iterable[Frame]:
        for i, T_cw in enumerate(poses):
            frame = Frame(i, i / 30, blank, f"frame {i}", T_cw)
            yield replace(frame, features=eyes(frame))

    return SLAM(camera, config), seen()


def peak_mb() -> int:
    """Peak memory of the process (Linux)."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 2**10


def processed(slam: SLAM, frames: Iterable[Frame], window: int) -> tuple[list[list[str]], list[StepResult]]:
    """The rows of the table, one for so many frames, and all results."""
    rows, results, ms = list[list[str]](), list[StepResult](), list[float]()
    for frame in frames:
        before = time.process_time()
        results.append(slam.step(frame))
        ms.append(1e3 * (time.process_time() - before))
        if len(ms) == window:
            cost, end = torch.tensor(ms, dtype=torch.float64), len(results)
            times = cost.median(), cost.mean(), cost.quantile(0.95)
            sizes = slam.map.num_keyframes, slam.map.num_points, len(slam.map.points), peak_mb()
            row = [f"{end - window} to {end}", *(f"{each:.1f}" for each in times), *map(str, sizes)]
            print(*row, sep=" | ", flush=True)
            rows.append(row)
            ms.clear()
    return rows, results


def walk_recording() -> Path:
    """The walk through three storeys, which is rendered once."""
    recording = STOREYS / "recording"
    if not (recording / "rgb.txt").exists():
        render("synthetic:storeys", recording)
    return recording


def run_walk(recording: Path, output: Path, frames: int, *more: str) -> tuple[list[str], float]:
    """A row of the table, and CPU seconds per frame, of `torchslam run`; a run that is there is not repeated."""
    camera = f"{FOCAL},{FOCAL},{(SIZE[0] - 1) / 2},{(SIZE[1] - 1) / 2}"
    command = ["run", str(recording), "--stop", str(frames), "--camera", camera, "--output", str(output)]
    if not output.exists():
        words = [sys.executable, "-m", "torchslam", *command, *more]
        subprocess.run(words, check=True, capture_output=True)
    found = read_metrics(output)
    row = [
        f"{frames}",
        f"{found['posed']}",
        f"{found['mapping']}",
        f"{found['keyframes']}",
        f"{found['ate_m']:.3f} m ({found['ate_m'] / found['path_length_m']:.2%} of {found['path_length_m']:.0f} m)",
        f"{found['online_ate_m']:.3f} m",
        f"{found['cpu_s']:.0f}",
        f"{found['peak_memory_mb']:.0f}",
    ]
    return row, found["cpu_s"] / frames


def storeys() -> str:
    """Table of `torchslam run` on the first frames of a walk through three storeys."""
    recording = walk_recording()
    runs = [run_walk(recording, STOREYS / str(frames), frames) for frames in STOREYS_FRAMES]
    growth = runs[-1][1] / runs[0][1]
    ratio = f"CPU time per frame of the last row to that of the first: {growth:.2f}."
    return f"{table(STOREYS_HEADER, [row for row, _ in runs])}\n{ratio}\n"


def covered() -> str:
    """Table of `torchslam run` on that walk with a few frames that show nothing, frame by frame and by default."""
    whole, recording = walk_recording(), STOREYS / "covered"
    if not (recording / "rgb.txt").exists():
        shutil.copytree(whole, recording)
        for frame in COVERED:
            path = str(recording / "rgb" / f"{frame:05d}.jpg")
            cv2.imwrite(path, np.full((SIZE[1], SIZE[0]), 127, np.uint8))
    window = "--set", f"global_mapping.window_images={COVERED_WINDOW}"
    ways = ("online", "--mapping", "online"), ("auto", *window)
    runs = [
        run_walk(recording, STOREYS / f"covered_{name}", COVERED_FRAMES, *more)[0] for name, *more in ways
    ]
    return table(STOREYS_HEADER, runs)


def main() -> None:
    parser = parser_of(__doc__, readme=True)
    walks = {"storeys": storeys, "covered": covered}
    parser.add_argument("path", choices=[*FRAMES, *walks])
    parser.add_argument("--frames", type=int)
    parser.add_argument("--sequence", default="redkitchen", help="of to_and_fro")
    options = parser.parse_args()
    torch.set_num_threads(1)
    marks = f"<!-- {options.path} -->\n", f"<!-- end {options.path} -->"
    if options.path in walks:
        publish(walks[options.path](), options, __file__, *marks)
        return
    count = options.frames or FRAMES[options.path]
    if options.path == "rounds":
        slam, frames = simulated(count)
        truth = None
    else:
        frames = ToAndFro(open_sequence(place_of(options.sequence)), count)
        slam, truth = SLAM(frames.camera, Config()), frames.groundtruth
    rows, results = processed(slam, frames, count // WINDOWS)
    ratio = float(rows[-1][1]) / float(rows[1][1])
    summary = f"\nMedian of the last row over that of the second: {ratio:.2f}. "
    if truth is None:
        lost = sum(result.state.value == "lost" for result in results)
        summary += f"{slam.map.num_keyframes} keyframes, {slam.map.num_points} points, {lost} frames lost.\n"
    else:
        before = time.process_time()
        run = finish(slam, results, [], interrupted=False)
        summary += (
            f"Final adjustment: {time.process_time() - before:.1f} s, at most {peak_mb()} MB. "
            f"{run.map.num_keyframes} keyframes, {len(run.trajectory)} of {count} frames posed, "
            f"ATE {evaluate(run.trajectory, truth).ate_m:.4f} m.\n"
        )
    publish(table(HEADER, rows) + summary, options, __file__, *marks)


if __name__ == "__main__":
    main()
