"""What a training step through the poses of a clip costs, once the clip has been looked at.

    python -m experiments.benchmarks.clips [--output FILE]

Clips of 8 frames with 1000 ORB keypoints, chosen by their parallax. Before every step all keypoints move by half a
pixel at random, as learning would move them. Prints a table and writes it to FILE.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor

from experiments.common import parser_of, sequences, table
from torchslam import ORB, ClipGraph, ClipSLAM, Features, clip_loss
from torchslam.learning.clips import Clip, Clips
from torchslam.learning.losses import relative_ate

HERE = Path(__file__).parent
NAMES = ["redkitchen", "machine_hall", "fr2_desk_20", "shelf_bin", "synthetic:room"]
CLIPS, STEPS = 5, 5
MOVE_PX = 0.5

T = TypeVar("T")


class Step(NamedTuple):
    """A training step: CPU milliseconds per clip forward and backward, and the gradient (B, C) to the cameras."""

    ahead_ms: float
    back_ms: float
    gradient: Tensor

    @property
    def ms(self) -> float:
        return self.ahead_ms + self.back_ms


class Looked(NamedTuple):
    """A clip that was looked at, and what that and the front end cost in CPU milliseconds."""

    clip: Clip
    features: Features
    graph: ClipGraph
    extract_ms: float
    look_ms: float


def build_graph(clip_slam: ClipSLAM, clip: Clip) -> Looked:
    with torch.no_grad():
        features, extract_ms = timed(lambda: clip_slam.extract(clip.images))
    assert isinstance(features, Features)
    graph, look_ms = timed(lambda: clip_slam.build_graph(clip.images, clip.camera, features))
    return Looked(clip, features, graph, extract_ms, look_ms)


def step(clip_slam: ClipSLAM, looked: Sequence[Looked], together: bool, seed: int) -> Step:
    """A step with gradients to keypoints, scores and cameras.

    together: all clips in one call, or in one after the other; seed: of how keypoints move
    """
    generator = torch.Generator().manual_seed(seed)
    cameras = torch.stack([each.clip.camera.params for each in looked]).requires_grad_()
    moved = []
    for each in looked:
        features, noise = each.features, torch.randn(each.features.keypoints.shape, generator=generator)
        keypoints = (features.keypoints + MOVE_PX * noise).requires_grad_()
        moved.append(replace(features, keypoints=keypoints, scores=features.scores.clone().requires_grad_()))
    camera = looked[0].clip.camera.with_params(cameras)
    truths = torch.stack([each.clip.T_cw for each in looked])

    def forward() -> Tensor:
        if together:
            poses = clip_slam.pose(ClipGraph.stack([each.graph for each in looked]), moved, camera)
            return clip_loss(poses, truths, relative_ate, on_failure=1.0).loss
        losses = []
        for row, each in enumerate(looked):
            poses = clip_slam.pose(each.graph, moved[row], camera[row])
            losses.append(clip_loss(poses, truths[row], relative_ate, on_failure=1.0).loss)
        return torch.stack(losses).mean()

    loss, ahead = timed(forward)
    _, back = timed(loss.backward)
    assert cameras.grad is not None
    return Step(ahead / len(looked), back / len(looked), cameras.grad)


def alone(clip_slam: ClipSLAM, looked: Looked) -> list[float]:
    """CPU milliseconds forward and backward for one clip, medians."""
    steps = [step(clip_slam, [looked], False, seed) for seed in range(STEPS)]
    return torch.tensor([each[:2] for each in steps]).median(0).values.tolist()


class Compared(NamedTuple):
    """Clips in turn and in one call: CPU milliseconds per clip, medians of steps of either kind in alternation; by what
    shares of their length the gradients to the cameras differ, (STEPS, B)."""

    in_turn_ms: float
    at_once_ms: float
    apart: Tensor


def compared(clip_slam: ClipSLAM, looked: Sequence[Looked]) -> Compared:
    pairs = [[step(clip_slam, looked, together, seed) for together in (False, True)] for seed in range(STEPS)]
    in_turn, at_once = (torch.tensor([pair[kind].ms for pair in pairs]).median() for kind in (0, 1))
    apart = [(one.gradient - other.gradient).norm(dim=-1) / one.gradient.norm(dim=-1) for one, other in pairs]
    return Compared(float(in_turn), float(at_once), torch.stack(apart))


def timed(call: Callable[[], T]) -> tuple[T, float]:
    start = time.process_time()
    result = call()
    return result, 1e3 * (time.process_time() - start)


def main() -> None:
    parser = parser_of(__doc__, HERE / "clips.md")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    clip_slam = ClipSLAM(ORB(1000), keypoint_weight=lambda features: features.scores.clamp_min(1e-6).sqrt())
    for sequence in sequences(NAMES):
        clips = Clips([sequence], per_sequence=CLIPS)
        looked = [build_graph(clip_slam, clips[number]) for number in range(len(clips))]
        found = [each for each in looked if each.graph.runs[0] is not None]
        runs = [each.graph.runs[0] for each in found]
        counts = [[float(run.is_keyframe.sum()), float(len(run.pixels))] for run in runs if run is not None]
        keyframes, observations = torch.tensor(counts).median(0).values.tolist()
        before = [[each.extract_ms, each.look_ms] for each in found]
        single = torch.tensor([alone(clip_slam, each) for each in found])
        ahead, back = single.median(0).values.tolist()
        both = compared(clip_slam, found)
        size = "x".join(map(str, sequence.size))
        rows.append(
            [
                f"{sequence.name}, {size}",
                f"{len(found)} of {len(clips)}",
                f"{keyframes:.0f}, {observations:.0f}",
                *(f"{each:.0f}" for each in torch.tensor(before).median(0).values.tolist()),
                *(f"{each:.0f}" for each in (ahead, back, ahead + back, float(single.sum(1).max()))),
                f"{both.at_once_ms:.0f}",
                f"{both.in_turn_ms / both.at_once_ms:.1f}",
                f"{both.apart.median():.0e}, {both.apart.max():.0e}",
            ]
        )
        print(rows[-1], flush=True)
    header = [
        "sequence",
        "clips with a map",
        "keyframes, observations",
        "front end, ms",
        "build_graph",
        "pose",
    ]
    header += ["backward", "step", "slowest step", "step, all clips in one call", "times faster"]
    header += ["gradients differ by"]
    text = (
        "# Training through clips\n\nClips of 8 frames, 1000 ORB keypoints each, moved by half a pixel before every "
        "step; gradients of the ATE to keypoints, weights and camera. Medians of the CPU time of one thread, in "
        "milliseconds per clip; a step is pose and backward, and needs neither the front end nor another look. The "
        "columns after them pose all clips of a row in one call, each with a camera of its own, in turn with one after "
        "the other, and say by what share of its length the gradient to a camera differs between the two: median, "
        "and the most.\n\n"
        f"    python -m experiments.benchmarks.clips\n\n{table(header, rows)}"
    )
    print(text)
    arguments.output.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
