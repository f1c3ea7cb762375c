"""A large bundle adjustment with the gradient to all its pixels, compared with Ceres, and many small ones at once.

    python -m experiments.benchmarks.bundle [--output FILE] [--no-page]

The large one has the size of theseus's issue 565: 100 cameras, 3500 points, 43,000 observations. Prints tables and
writes them to FILE,
and what docs/coming_from.md says of them, without --no-page.
"""

from __future__ import annotations

import math
import resource
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from experiments.benchmarks.solvers import camera, colmap_solve, rmse
from experiments.common import gradient_error, milliseconds, parser_of, publish_page, table, write_between
from torchslam.geometry import rigid, se3_exp, se3_inverse, so3_exp, transform
from torchslam.optim import BUNDLE_OPTIONS, BundleProblem, BundleSolution, solve_bundle

HERE = Path(__file__).parent
COMING_FROM = HERE.parents[1] / "docs" / "coming_from.md"
NOISE_PX = 0.5
WINDOWS, FRAMES, POINTS = 64, 8, 200


class Scene:
    """Poses and points, and what of them the camera sees, with noise; starts a little off."""

    def __init__(self, T_cw: Tensor, points_w: Tensor, seed: int, observations: int | None = None) -> None:
        self.generator = torch.Generator().manual_seed(seed)
        pixels, seen = camera().project(transform(T_cw, points_w))
        frame_index, point_index = (seen & camera().in_image(pixels)).nonzero().unbind(-1)
        if observations is not None:
            kept = torch.randperm(len(frame_index), generator=self.generator)[:observations].sort().values
            frame_index, point_index = frame_index[kept], point_index[kept]
        twist = 0.01 * self.normal(len(T_cw), 6)
        twist[:2] = 0
        self.problem = BundleProblem(
            se3_exp(twist) @ T_cw,
            points_w + 0.05 * self.normal(*points_w.shape),
            frame_index,
            point_index,
            pixels[frame_index, point_index] + NOISE_PX * self.normal(len(frame_index), 2),
            camera(),
            fixed_frames=(0, 1),
        )

    def normal(self, *shape: int) -> Tensor:
        return torch.randn(*shape, generator=self.generator, dtype=torch.float64)


def ring(frames: int = 100, points: int = 3500, observations: int = 43_000) -> BundleProblem:
    """A ring of cameras that look outwards at a round wall, each at a part of it."""
    uniform = torch.rand(3, points, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    around, radius, height = 2 * math.pi * uniform[0], 6 + 2 * uniform[1], 3 * (uniform[2] - 0.5)
    points_w = torch.stack((radius * around.sin(), height, radius * around.cos()), dim=-1)
    angle = torch.arange(frames, dtype=torch.float64) * (2 * math.pi / frames)
    zero = torch.zeros_like(angle)
    center = 2 * torch.stack((angle.sin(), 0.1 * (3 * angle).sin(), angle.cos()), dim=-1)
    T_cw = se3_inverse(rigid(so3_exp(torch.stack((zero, angle, zero), dim=-1)), center))
    return Scene(T_cw, points_w, 0, observations).problem


def window(seed: int) -> BundleProblem:
    """A few frames side by side, before points of which each sees most."""
    generator = torch.Generator().manual_seed(seed)
    twist = 0.05 * torch.randn(FRAMES, 6, generator=generator, dtype=torch.float64)
    twist[:, 0] += torch.linspace(-1, 1, FRAMES, dtype=torch.float64)
    points_w = torch.randn(POINTS, 3, generator=generator, dtype=torch.float64)
    points_w = points_w * torch.tensor([1.2, 1.0, 1.0], dtype=torch.float64)
    points_w[:, 2] = (points_w[:, 2] + 5).clamp_min(3)
    return Scene(se3_exp(twist), points_w, seed).problem


def batch_of(problems: list[BundleProblem]) -> BundleProblem:
    """Problems of as many frames and points each, with observations filled up."""
    most = max(len(problem.pixels) for problem in problems)

    def stacked(name: str) -> Tensor:
        columns = [getattr(problem, name) for problem in problems]
        return torch.stack([torch.cat((x, x.new_zeros(most - len(x), *x.shape[1:]))) for x in columns])

    return replace(
        problems[0],
        T_cw=torch.stack([problem.T_cw for problem in problems]),
        points_w=torch.stack([problem.points_w for problem in problems]),
        frame_index=stacked("frame_index"),
        point_index=stacked("point_index"),
        pixels=stacked("pixels"),
        mask=torch.stack([torch.arange(most) < len(problem.pixels) for problem in problems]),
    )


def loss_of(solution: BundleSolution) -> Tensor:
    return points_loss(solution.points_w)


def points_loss(points_w: Tensor) -> Tensor:
    points = points_w.flatten()
    return points @ torch.linspace(-1, 1, len(points)).to(points)


def large() -> list[str]:
    """The table of the large problem."""
    problem = ring()
    pixels = problem.pixels.clone().requires_grad_()

    def backward() -> float:
        loss = loss_of(
            solve_bundle(replace(problem, pixels=pixels), options=BUNDLE_OPTIONS.replace(kernel="none"))
        )
        begin = time.process_time()
        loss.backward()
        return 1e3 * (time.process_time() - begin)

    ours, ceres, back = milliseconds(
        lambda: solve_bundle(problem, options=BUNDLE_OPTIONS.replace(kernel="none", backward="detached")),
        lambda: colmap_solve(problem).solve_ms,
        backward,
        repeats=5,
    )
    solution = solve_bundle(problem, options=BUNDLE_OPTIONS.replace(kernel="none", backward="detached"))
    reached = rmse(replace(problem, T_cw=solution.T_cw, points_w=solution.points_w))
    iterations = int(solution.convergence.iterations)
    error = gradient_error(
        lambda pixels: points_loss(
            solve_bundle(
                replace(problem, pixels=pixels),
                options=BUNDLE_OPTIONS.replace(kernel="none", iterations=40, tolerance=1e-28),
            ).points_w
        ),
        {"pixels": problem.pixels},
        {"pixels": 1e-4},
    )
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    header = ["", "RMSE, px", "solve, ms", "iterations", "an iteration, ms", "gradient to all pixels, ms"]
    rows = [
        [
            "torchslam",
            f"{reached:.4f}",
            f"{ours:.0f}",
            f"{iterations}",
            f"{ours / iterations:.0f}",
            f"{back:.0f}",
        ],
        ["Ceres (pycolmap)", f"{colmap_solve(problem).rmse:.4f}", f"{ceres:.0f}", "", "", "none"],
    ]
    said = (
        f"{len(problem.T_cw)} cameras, {len(problem.points_w)} points, {len(problem.pixels)} observations. The "
        f"gradient against central differences: {error:.0e}. At most {memory:.0f} MB, with all that is imported."
    )
    return [said, "", table(header, rows)]


def single() -> list[str]:
    """The table of one small problem."""
    problem = window(0)
    views = torch.bincount(problem.point_index, minlength=POINTS)
    rows, kept = views[problem.point_index] > 1, views > 1  # Ceres takes no point that is seen once
    problem = replace(
        problem,
        points_w=problem.points_w[kept],
        frame_index=problem.frame_index[rows],
        point_index=(kept.cumsum(0) - 1)[problem.point_index[rows]],
        pixels=problem.pixels[rows],
    )
    options = BUNDLE_OPTIONS.replace(kernel="none", backward="detached")
    ours, ceres = milliseconds(
        lambda: solve_bundle(problem, options=options), lambda: colmap_solve(problem).solve_ms, repeats=31
    )
    said = f"{len(problem.T_cw)} frames, {int(kept.sum())} points, {len(problem.pixels)} observations."
    return [said, "", table("torchslam, ms | Ceres (pycolmap), ms", [[f"{ours:.0f}", f"{ceres:.0f}"]])]


def windows() -> list[str]:
    """The table of many small problems."""
    problems = [window(seed) for seed in range(WINDOWS)]
    batch = batch_of(problems)

    def solve(problem: BundleProblem) -> Callable[[], Any]:
        return lambda: solve_bundle(problem, options=BUNDLE_OPTIONS.replace(scale=2.45, backward="detached"))

    def step(problem: BundleProblem) -> None:
        pixels = problem.pixels.clone().requires_grad_()
        loss_of(
            solve_bundle(replace(problem, pixels=pixels), options=BUNDLE_OPTIONS.replace(scale=2.45))
        ).backward()

    def each(task: Callable[[BundleProblem], Any]) -> None:
        for problem in problems:
            task(problem)

    together, loop, step_together, step_loop = milliseconds(
        solve(batch),
        lambda: each(lambda problem: solve(problem)()),
        lambda: step(batch),
        lambda: each(step),
        repeats=5,
    )
    header = [f"{WINDOWS} windows", "in a loop, ms", "in one call, ms", "throughput"]
    rows = [
        [what, f"{apart:.0f}", f"{at_once:.0f}", f"{apart / at_once:.1f}"]
        for what, apart, at_once in (
            ("solve", loop, together),
            ("solve and gradient to all pixels", step_loop, step_together),
        )
    ]
    found = solve_bundle(batch, options=BUNDLE_OPTIONS.replace(scale=2.45))
    alone = torch.stack(
        [solve_bundle(problem, options=BUNDLE_OPTIONS.replace(scale=2.45)).T_cw for problem in problems]
    )
    said = (
        f"Windows of {FRAMES} frames and {POINTS} points, {len(batch.pixels[0])} observations at most; the largest "
        f"difference of a pose to that found alone: {float((found.T_cw - alone).detach().abs().max()):.0e}."
    )
    return [said, "", table(header, rows)]


def cells(text: str) -> dict[str, str]:
    """What docs/coming_from.md says of the tables of bundle.md, by the marks before it."""
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line[:1] == "|"]
    (ours,) = (row for row in rows if row[0] == "torchslam")
    (one,) = (rows[i + 2] for i, row in enumerate(rows) if row[0] == "torchslam, ms")
    factor, with_gradient = (row[-1] for row in rows if row[0].startswith("solve"))
    return {
        "<!-- window -->": f"a window of {FRAMES} frames and {POINTS} points in {one[0]} ms, Ceres {one[1]} ms; 100 "
        f"cameras and 43,000 observations in {ours[4]} ms an iteration",
        "<!-- large -->": f"{ours[4]} ms per iteration on one thread; the gradient takes "
        f"{float(ours[5]) / float(ours[2]):.2f} of a solve",
        "<!-- windows -->": f"{WINDOWS} windows in one call are {factor} times as fast as in a loop, {with_gradient} "
        "times with the gradient",
    }


def main() -> None:
    parser = parser_of(__doc__, HERE / "bundle.md")
    parser.add_argument("--no-page", action="store_true", help="leave docs/coming_from.md as it is")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    lines = [
        "One thread, float64, median CPU time of the process, interleaved.",
        "",
        "    python -m experiments.benchmarks.bundle",
        "",
        "## As large as theseus's issue 565",
        "",
        *large(),
        "The issue reports 30 s per iteration. Other libraries on this problem: [bundle_peers.md](bundle_peers.md).",
        "",
        "## One small one",
        "",
        *single(),
        "## Many small ones at once",
        "",
        *windows(),
    ]
    text = "\n".join(lines)
    publish_page("Bundle adjustment, large and in batches", text, arguments)
    if not arguments.no_page:
        for mark, cell in cells(text).items():
            write_between(COMING_FROM, cell, mark)


if __name__ == "__main__":
    main()
