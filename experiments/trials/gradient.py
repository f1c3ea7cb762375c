"""Is the gradient of a run right in which a loop was closed? A simulated round, solved anew on both sides."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from experiments.common import table, write_between
from experiments.trials.edited import Edited, shots
from torchslam.data.sequence import Sequence
from torchslam.evaluation import ate
from torchslam.geometry import Camera, rigid, so3_exp
from torchslam.optim.run_graph import ObservationGraph, solve_graph
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
ITERATIONS = 12


class Round(Sequence):
    """A camera that walks a circle, looks outwards, and comes back to where it began; without images."""

    def __init__(self, frames: int = ROUND + BEYOND) -> None:
        phase = torch.arange(frames, dtype=torch.float64) * (2 * math.pi / ROUND)
        sway = 0.1 * torch.sin(phase / 2.3)  # no two rounds are the same
        centers_w = torch.stack((2 * phase.cos(), sway, 2 * phase.sin()), -1)
        zero = torch.zeros_like(phase)
        R_wc = so3_exp(torch.stack((zero, math.pi / 2 - phase, zero), -1))
        camera = Camera.pinhole(400.0, 400.0, 319.5, 239.5, size=(640, 480))
        timestamps = phase * ROUND / (2 * math.pi) / 30
        super().__init__("round", "poses", camera, timestamps, Trajectory(timestamps, rigid(R_wc, centers_w)))

    @classmethod
    def shots(cls) -> Edited:
        """All of it."""
        whole = cls()
        return Edited(whole.name, whole.camera, shots(whole, range(len(whole))))

    def image(self, index: int) -> Tensor:
        return torch.zeros(1, 1, self.camera.height, self.camera.width)

    def image_name(self, index: int) -> str:
        return f"pose {index}"


def check(run: Run, sequence: Sequence) -> list[list[str]]:
    """Rows: the derivative of the ATE along camera parameters and pixels, by the gradient and by differences."""
    graph = run.graph
    T_true = torch.stack([pose for i in graph.frame_ids.tolist() if (pose := sequence.pose(i)) is not None])
    assert len(graph.submaps) == 1
    assert len(T_true) == len(graph.T_cw)
    pixels, params = graph.pixels.clone().requires_grad_(), graph.camera.params.clone().requires_grad_()
    ate(solve_graph(_moved(graph, pixels, params)).T_cw, T_true).backward()
    assert pixels.grad is not None
    assert params.grad is not None

    def error(step_pixels: Tensor, step_params: Tensor) -> float:
        moved = _moved(graph, graph.pixels + step_pixels, graph.camera.params + step_params)
        solution = solve_graph(moved, backward="detached", iterations=ITERATIONS, tolerance=0.0)
        return float(ate(solution.T_cw, T_true))

    rows = []
    for name, along_pixels, along_params in _directions(graph):
        analytic = float((pixels.grad * along_pixels).sum() + (params.grad * along_params).sum())
        ahead, behind = (error(s * STEP_PX * along_pixels, s * STEP_PX * along_params) for s in (1, -1))
        numeric = (ahead - behind) / (2 * STEP_PX)
        off = abs(analytic - numeric) / abs(numeric)
        rows.append([name, f"{1e3 * analytic:.6f}", f"{1e3 * numeric:.6f}", f"{off:.1e}"])
    return rows


def report(run: Run, sequence: Sequence, file: Path, loop_closures: list[tuple[int, int]]) -> None:
    """Check the gradient and write the result between the marks of a file; loop closures: frames and their places."""
    closed = ", ".join(f"frame {frame} at {place}" for frame, place in loop_closures)
    graph = run.graph
    counts = (
        f"{len(graph.T_cw)} frames, {int(graph.is_keyframe.sum())} of them keyframes, {len(graph.points_w)} points, "
        f"{len(graph.pixels)} observations; loops closed: {closed}.\n\n"
    )
    header = ["direction", "gradient (mm/px)", "central differences (mm/px)", "relative error"]
    text = counts + table(header, check(run, sequence))
    print(text, flush=True)
    write_between(file, text)


def _directions(graph: ObservationGraph) -> list[tuple[str, Tensor, Tensor]]:
    """Names, and where pixels and parameters go: every parameter, some single keypoints, all keypoints at random."""
    still, fixed = torch.zeros_like(graph.pixels), torch.zeros_like(graph.camera.params)
    found = []
    for row, name in enumerate(("fx", "fy", "cx", "cy")):
        along = fixed.clone()
        along[row] = 1.0
        found.append((name, still, along))
    generator = torch.Generator().manual_seed(0)
    seen = torch.nonzero(graph.is_keyframe[graph.frame_index])[:, 0]
    for row in seen[torch.randperm(len(seen), generator=generator)[:PIXELS]].tolist():
        along = still.clone()
        along[row, 0] = 1.0
        found.append((f"x of observation {row}, in a keyframe", along, fixed))
    noise = torch.randn(still.shape, generator=generator, dtype=still.dtype)
    return [*found, ("all keypoints, at random", noise, fixed)]


def _moved(graph: ObservationGraph, pixels: Tensor, params: Tensor) -> ObservationGraph:
    return replace(graph, pixels=pixels, camera=graph.camera.with_params(params))
