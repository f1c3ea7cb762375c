"""Is the gradient of a run with a loop closure right? A simulated round, compared with central differences."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from torch import Tensor

from experiments.common import write_between
from experiments.run_gradient.run import Direction, Inputs, check, differentiate
from experiments.trials.edited import Edited, shots
from torchslam.data.sequence import Sequence
from torchslam.geometry import Camera, rigid, so3_exp
from torchslam.optim.observation_graph import ObservationGraph
from torchslam.system.run import Run
from torchslam.types import Trajectory

SETTINGS = (
    "features.kind=simulated",
    "features.num_keypoints=400",
    "simulated.points_per_view=250",
    "simulated.depth_near=0.4",
    "simulated.noise_px=0.5",
)
ROUND, BEYOND = 120, 30  # frames of a round, and after it
PIXELS = 3  # observations that are moved one by one
STEP_PX = 1e-3


class Round(Sequence):
    """A camera that walks a circle, looks outwards and returns to its start."""

    def __init__(self, frames: int = ROUND + BEYOND) -> None:
        phase = torch.arange(frames, dtype=torch.float64) * (2 * math.pi / ROUND)
        sway = 0.1 * torch.sin(phase / 2.3)  # no two rounds are the same
        centers_w = torch.stack((2 * phase.cos(), sway, 2 * phase.sin()), -1)
        zero = torch.zeros_like(phase)
        R_wc = so3_exp(torch.stack((zero, math.pi / 2 - phase, zero), -1))
        camera = Camera.pinhole(400.0, 400.0, 319.5, 239.5, size=(640, 480))
        timestamps = phase * ROUND / (2 * math.pi) / 30
        super().__init__("round", "poses", camera, timestamps, Trajectory(timestamps, rigid(R_wc, centers_w)))

    def image(self, index: int) -> Tensor:
        """A blank image: the features are simulated."""
        return torch.zeros(1, 1, self.camera.height, self.camera.width)

    def image_name(self, index: int) -> str:
        return f"pose {index}"

    @classmethod
    def shots(cls) -> Edited:
        """All of it."""
        whole = cls()
        return Edited(whole.name, whole.camera, shots(whole, range(len(whole))))


def gradient_table(run: Run, sequence: Sequence) -> str:
    """The derivative of the ATE along camera parameters and pixels, by the gradient and by central differences."""
    graph = run.graph
    T_true = torch.stack([pose for i in graph.frame_ids.tolist() if (pose := sequence.pose(i)) is not None])
    assert len(graph.submaps) == 1
    known = torch.ones(len(T_true), dtype=torch.bool)
    _, _, gradient = differentiate(graph, T_true, known)
    return check(graph, T_true, known, gradient, _directions(graph))


def report(run: Run, sequence: Sequence, file: Path, loop_closures: list[tuple[int, int]]) -> None:
    """Check the gradient and write the result between the marks of a file; loop closures: frames and their places."""
    closed = ", ".join(f"frame {frame} at {place}" for frame, place in loop_closures)
    graph = run.graph
    counts = (
        f"{len(graph.T_cw)} frames, {int(graph.is_keyframe.sum())} of them keyframes, {len(graph.points_w)} points, "
        f"{len(graph.pixels)} observations; loops closed: {closed}.\n\n"
    )
    text = counts + gradient_table(run, sequence)
    print(text, flush=True)
    write_between(file, text)


def _directions(graph: ObservationGraph) -> list[Direction]:
    """Every parameter, some single keypoints, and all keypoints at random."""
    still = Inputs.of(graph).zeros()
    found = []
    for row, name in enumerate(("fx", "fy", "cx", "cy")):
        along = still.params.clone()
        along[row] = 1.0
        found.append(Direction(f"{name}, by 1 px", still._replace(params=along), STEP_PX))
    generator = torch.Generator().manual_seed(0)
    seen = torch.nonzero(graph.is_keyframe[graph.frame_index])[:, 0]
    for row in seen[torch.randperm(len(seen), generator=generator)[:PIXELS]].tolist():
        along = still.pixels.clone()
        along[row, 0] = 1.0
        name = f"x of observation {row}, in a keyframe, by 1 px"
        found.append(Direction(name, still._replace(pixels=along), STEP_PX))
    noise = torch.randn(still.pixels.shape, generator=generator, dtype=still.pixels.dtype)
    return [*found, Direction("all keypoints, at random by 1 px", still._replace(pixels=noise), STEP_PX)]
