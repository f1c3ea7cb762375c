"""Cost of a training step through the poses of a clip, once its graph is built.

    python -m experiments.benchmarks.clips [--output FILE]

Clips of 8 frames with 1000 ORB keypoints, selected by their parallax. Before every step all keypoints move by half a
pixel at random, as training would move them. Prints a table and writes it to FILE.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from experiments.common import parser_of, publish_page, sequences, table, timed
from torchslam import ORB, ClipGraph, ClipSLAM, Features, clip_loss
from torchslam.learning.dataset import Clip, Clips
from torchslam.learning.losses import relative_ate

HERE = Path(__file__).parent
NAMES = ["redkitchen", "machine_hall", "fr2_desk_20", "shelf_bin", "synthetic:room"]
CLIPS, STEPS = 5, 5
MOVE_PX = 0.5


class Step(NamedTuple):
    """A training step: CPU milliseconds per clip forward and backward, and the gradient (B, C) to the cameras."""

    forward_ms: float
    backward_ms: float
    gradient: Tensor

    @property
    def ms(self) -> float:
        return self.forward_ms + self.backward_ms


class PreparedClip(NamedTuple):
    """A clip with its graph, and the CPU milliseconds of feature extractor and graph."""

    clip: Clip
    features: Features
    graph: ClipGraph
    extract_ms: float
    build_ms: float


def prepare(clip_slam: ClipSLAM, clip: Clip) -> PreparedClip:
    with torch.no_grad():
        features, extract_ms = timed(lambda: clip_slam.extract(clip.images))
    assert isinstance(features, Features)
    graph, build_ms = timed(lambda: clip_slam.build_graph(clip.images, clip.camera, features))
    return PreparedClip(clip, features, graph, extract_ms, build_ms)


def step(clip_slam: ClipSLAM, prepared: Sequence[PreparedClip], together: bool, seed: int) -> Step:
    """A step with gradients to keypoints, scores and cameras.

    together: all clips in one call, or one call each; seed: of how keypoints move
    """
    generator = torch.Generator().manual_seed(seed)
    cameras = torch.stack([each.clip.camera.params for each in prepared]).requires_grad_()
    moved = []
    for each in prepared:
        features, noise = each.features, torch.randn(each.features.keypoints.shape, generator=generator)
        keypoints = (features.keypoints + MOVE_PX * noise).requires_grad_()
        moved.append(replace(features, keypoints=keypoints, scores=features.scores.clone().requires_grad_()))
    camera = prepared[0].clip.camera.with_params(cameras)
    truths = torch.stack([each.clip.T_cw for each in prepared])

    def forward() -> Tensor:
        if together:
            poses = clip_slam.pose(ClipGraph.stack([each.graph for each in prepared]), moved, camera)
            return clip_loss(poses, T_cw_groundtruth=truths, error=relative_ate, on_failure=1.0).loss
        losses = []
        for row, each in enumerate(prepared):
            poses = clip_slam.pose(each.graph, moved[row], camera[row])
            losses.append(
                clip_loss(poses, T_cw_groundtruth=truths[row], error=relative_ate, on_failure=1.0).loss
            )
        return torch.stack(losses).mean()

    loss, ahead = timed(forward)
    _, back = timed(loss.backward)
    assert cameras.grad is not None
    return Step(ahead / len(prepared), back / len(prepared), cameras.grad)


def alone(clip_slam: ClipSLAM, prepared: PreparedClip) -> list[float]:
    """CPU milliseconds forward and backward for one clip, medians."""
    steps = [step(clip_slam, [prepared], False, seed) for seed in range(STEPS)]
    return torch.tensor([each[:2] for each in steps]).median(0).values.tolist()


class Compared(NamedTuple):
    """Clips in separate calls and in one call.

    in_turn_ms, at_once_ms: CPU time per clip, medians of interleaved steps
    apart: (STEPS, B) relative difference of the gradients to the cameras
    """

    in_turn_ms: float
    at_once_ms: float
    apart: Tensor


def compared(clip_slam: ClipSLAM, prepared: Sequence[PreparedClip]) -> Compared:
    pairs = [
        [step(clip_slam, prepared, together, seed) for together in (False, True)] for seed in range(STEPS)
    ]
    in_turn, at_once = (torch.tensor([pair[kind].ms for pair in pairs]).median() for kind in (0, 1))
    apart = [(one.gradient - other.gradient).norm(dim=-1) / one.gradient.norm(dim=-1) for one, other in pairs]
    return Compared(float(in_turn), float(at_once), torch.stack(apart))


def main() -> None:
    parser = parser_of(__doc__, HERE / "clips.md")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    clip_slam = ClipSLAM(ORB(1000), keypoint_weight=lambda features: features.scores.clamp_min(1e-6).sqrt())
    for sequence in sequences(NAMES):
        clips = Clips([sequence], per_sequence=CLIPS)
        prepared = [prepare(clip_slam, clips[number]) for number in range(len(clips))]
        found = [each for each in prepared if each.graph.runs[0] is not None]
        runs = [each.graph.runs[0] for each in found]
        counts = [[float(run.is_keyframe.sum()), float(len(run.pixels))] for run in runs if run is not None]
        keyframes, observations = torch.tensor(counts).median(0).values.tolist()
        before = [[each.extract_ms, each.build_ms] for each in found]
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
    header = (
        "sequence | clips with a map | keyframes, observations | feature extractor, ms | build_graph"
        " | pose | backward | step | slowest step | step, all clips in one call | times faster"
        " | gradients differ by"
    )
    text = (
        "Clips of 8 frames, 1000 ORB keypoints each, moved by half a pixel before every "
        "step; gradients of the ATE to keypoints, weights and camera. Medians of the CPU time of one thread, in "
        "milliseconds per clip; a step is pose and backward, without the feature extractor and `build_graph`. The "
        "columns after them pose all clips of a row in one call, each with its own camera, alternating with one call "
        "each, and give the relative difference of the camera gradient between the two: median, "
        "maximum.\n\n"
        f"    python -m experiments.benchmarks.clips\n\n{table(header, rows)}"
    )
    publish_page("Training through clips", text, arguments)


if __name__ == "__main__":
    main()
