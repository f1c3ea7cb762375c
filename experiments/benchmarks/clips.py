"""What a training step through the poses of a clip costs, once the clip has been looked at.

    python -m experiments.benchmarks.clips [--output FILE]

Clips of 8 frames with 1000 ORB keypoints, chosen by their parallax. Before every step all keypoints move by half a
pixel at random, as learning would move them. Prints a table and writes it to FILE.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import torch
from torch import Tensor

from experiments.common import sequences, table
from torchslam import ORB, ClipGraph, ClipSLAM, Features, clip_loss
from torchslam.learning.clips import Clip, Clips
from torchslam.learning.losses import relative_ate

HERE = Path(__file__).parent
NAMES = ["redkitchen", "machine_hall", "fr2_desk_20", "shelf_bin", "synthetic:room"]
CLIPS, STEPS = 5, 5
MOVE_PX = 0.5

T = TypeVar("T")


def measure(clip: Clip) -> Tensor:
    """(4,) CPU milliseconds of the front end, of looking, and of a step forward and backward, medians; and (2,) how
    many keyframes and observations there are."""
    clip_slam = ClipSLAM(ORB(1000), weigh=lambda features: features.scores.clamp_min(1e-6).sqrt())
    with torch.no_grad():
        features, extract = timed(lambda: clip_slam.extract(clip.images))
    assert isinstance(features, Features)
    graph, look = timed(lambda: clip_slam.look(clip.images, clip.camera, features))
    (run,) = graph.runs
    if run is None:
        return torch.full((6,), torch.nan)
    generator = torch.Generator().manual_seed(0)
    steps = torch.tensor([step(clip_slam, clip, graph, features, generator) for _ in range(STEPS)])
    counts = [float(run.is_keyframe.sum()), float(len(run.pixels))]
    return torch.tensor([extract, look, *steps.median(0).values.tolist(), *counts])


def step(
    clip_slam: ClipSLAM, clip: Clip, graph: ClipGraph, features: Features, generator: torch.Generator
) -> tuple[float, float]:
    """CPU milliseconds forward and backward, with gradients to keypoints, scores and camera."""
    noise = MOVE_PX * torch.randn(features.keypoints.shape, generator=generator)
    keypoints = (features.keypoints + noise).requires_grad_()
    scores = features.scores.clone().requires_grad_()
    camera = clip.camera.with_params(clip.camera.params.clone().requires_grad_())
    moved = replace(features, keypoints=keypoints, scores=scores)

    def forward() -> Tensor:
        return clip_loss(clip_slam.pose(graph, moved, camera), clip.T_cw, relative_ate, on_failure=1.0).loss

    loss, ahead = timed(forward)
    _, back = timed(loss.backward)
    return ahead, back


def timed(call: Callable[[], T]) -> tuple[T, float]:
    start = time.process_time()
    result = call()
    return result, 1e3 * (time.process_time() - start)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--output", type=Path, default=HERE / "clips.md")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    for sequence in sequences(NAMES):
        clips = Clips([sequence], per_sequence=CLIPS)
        found = torch.stack([measure(clips[number]) for number in range(len(clips))])
        found = found[~found[:, 0].isnan()]
        extract, look, ahead, back, keyframes, observations = found.median(0).values.tolist()
        worst = float((found[:, 2] + found[:, 3]).max())
        size = "x".join(map(str, sequence.size))
        rows.append(
            [
                f"{sequence.name}, {size}",
                f"{len(found)} of {len(clips)}",
                f"{keyframes:.0f}, {observations:.0f}",
                *(f"{each:.0f}" for each in (extract, look, ahead, back, ahead + back, worst)),
            ]
        )
        print(rows[-1], flush=True)
    header = ["sequence", "clips with a map", "keyframes, observations", "front end, ms", "look", "pose"]
    header += ["backward", "step", "slowest step"]
    text = (
        "# Training through clips\n\nClips of 8 frames, 1000 ORB keypoints each, moved by half a pixel before every "
        "step; gradients of the ATE to keypoints, weights and camera. Medians of the CPU time of one thread, in "
        "milliseconds; a step is pose and backward, and needs neither the front end nor another look.\n\n"
        f"    python -m experiments.benchmarks.clips\n\n{table(header, rows)}"
    )
    print(text)
    arguments.output.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
