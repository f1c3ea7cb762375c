"""One window of the batch of `bundle`, by every differentiable solver that installs, and by Ceres.

    python -m venv --system-site-packages peers && peers/bin/pip install pypose theseus-ai
    peers/bin/python -m experiments.benchmarks.bundle_peers [--output FILE]

theseus-ai builds where it finds torch: `--no-build-isolation`; of its linear solvers the dense one needs nothing else.
Each solver runs in a process of its own, for its memory. Prints a table and writes it to FILE.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor, nn

from experiments.benchmarks.bundle import FRAMES, POINTS, window
from experiments.benchmarks.solvers import CENTRE, FOCAL, colmap_solve, rmse
from experiments.common import table
from torchslam.solvers import BundleProblem, bundle_adjust

HERE = Path(__file__).parent
ITERATIONS = 5  # of the peers, which have converged then; ours stops by itself
ANCHOR = 1e4  # weight of what holds theseus's first two frames, px per unit


class Result(NamedTuple):
    """RMSE at the end, the process time of one solve, its iterations, and the most memory that the process had."""

    rmse_px: float
    solve_ms: float
    iterations: int | None
    memory_mb: float = 0.0


def torchslam(problem: BundleProblem) -> Result:
    bundle_adjust(problem, "none", backward="detached")
    begin = time.process_time()
    solution = bundle_adjust(problem, "none", backward="detached")
    elapsed = 1e3 * (time.process_time() - begin)
    reached = rmse(replace(problem, T_cw=solution.T_cw, points_w=solution.points_w))
    return Result(reached, elapsed, int(solution.convergence.iterations))


def ceres(problem: BundleProblem) -> Result:
    solved = colmap_solve(problem)
    return Result(solved.rmse, solved.solve_ms, None)


def pypose(problem: BundleProblem) -> Result:
    """Its Levenberg-Marquardt, which takes the whole Jacobian by autograd."""
    import pypose as pp

    start = pp.mat2SE3(problem.T_cw)
    centre = torch.tensor(CENTRE, dtype=torch.float64)

    class Errors(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.poses, self.points = pp.Parameter(start[2:]), nn.Parameter(problem.points_w.clone())

        def forward(self, pixels: Tensor) -> Tensor:
            poses = pp.SE3(torch.cat([start[:2].tensor(), self.poses.tensor()]))
            points_c = poses[problem.frame_index].Act(self.points[problem.point_index])
            return points_c[:, :2] / points_c[:, 2:] * FOCAL + centre - pixels

    errors = Errors()
    optimizer = pp.optim.LM(errors, strategy=pp.optim.strategy.TrustRegion(radius=1e4))
    begin = time.process_time()
    for _ in range(ITERATIONS):
        squared = float(optimizer.step(input=problem.pixels))
    elapsed = 1e3 * (time.process_time() - begin)
    return Result((squared / len(problem.pixels)) ** 0.5, elapsed, ITERATIONS)


def theseus(problem: BundleProblem) -> Result:
    """Its Levenberg-Marquardt with the dense linear solver; its camera looks along -z, which turns the pixels."""
    import theseus as th

    def scalar(value: float, name: str) -> object:
        return th.Vector(tensor=torch.full((1, 1), value, dtype=torch.float64), name=name)

    objective = th.Objective(dtype=torch.float64)
    one = th.ScaleCostWeight(torch.ones(1, 1, dtype=torch.float64))
    focal, k1, k2 = scalar(FOCAL, "focal"), scalar(0.0, "k1"), scalar(0.0, "k2")
    start = {f"T{i}": T[None, :3].clone() for i, T in enumerate(problem.T_cw)}
    start |= {f"X{j}": x[None].clone() for j, x in enumerate(problem.points_w)}
    poses = [th.SE3(tensor=start[f"T{i}"], name=f"T{i}") for i in range(len(problem.T_cw))]
    points = [th.Point3(tensor=start[f"X{j}"], name=f"X{j}") for j in range(len(problem.points_w))]
    turned = torch.tensor(CENTRE, dtype=torch.float64) - problem.pixels
    rows = zip(problem.frame_index.tolist(), problem.point_index.tolist(), turned, strict=True)
    for number, (i, j, xy) in enumerate(rows):
        seen = th.Point2(tensor=xy[None], name=f"xy{number}")
        objective.add(
            th.eb.Reprojection(
                camera_pose=poses[i],
                world_point=points[j],
                image_feature_point=seen,
                focal_length=focal,
                calib_k1=k1,
                calib_k2=k2,
                weight=one,
                name=f"c{number}",
            )
        )
    anchor = th.ScaleCostWeight(torch.full((1, 1), ANCHOR, dtype=torch.float64))
    for i in (0, 1):
        target = th.SE3(tensor=start[f"T{i}"], name=f"P{i}")
        objective.add(th.Difference(poses[i], target, anchor, name=f"fixed{i}"))
    optimizer = th.LevenbergMarquardt(
        objective, max_iterations=ITERATIONS, linear_solver_cls=th.CholeskyDenseSolver
    )
    layer = th.TheseusLayer(optimizer)
    with torch.no_grad():
        begin = time.process_time()
        found, _ = layer.forward(start, optimizer_kwargs={"damping": 1e-4})
        elapsed = 1e3 * (time.process_time() - begin)
    T_cw = problem.T_cw.clone()
    T_cw[:, :3] = torch.cat([found[f"T{i}"] for i in range(len(T_cw))])
    points_w = torch.cat([found[f"X{j}"] for j in range(len(problem.points_w))])
    return Result(rmse(replace(problem, T_cw=T_cw, points_w=points_w)), elapsed, ITERATIONS)


def seen_twice(problem: BundleProblem) -> BundleProblem:
    """Without the points that the peers can not determine."""
    counts = torch.bincount(problem.point_index, minlength=len(problem.points_w))
    rows = counts[problem.point_index] >= 2
    kept, point_index = torch.unique(problem.point_index[rows], return_inverse=True)
    return replace(
        problem,
        points_w=problem.points_w[kept],
        frame_index=problem.frame_index[rows],
        point_index=point_index,
        pixels=problem.pixels[rows],
    )


def alone(solve: Callable[[BundleProblem], Result]) -> Result:
    """The result, found in this process, with its memory."""
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    result = solve(seen_twice(window(0)))
    return result._replace(memory_mb=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--output", type=Path, default=HERE / "bundle_peers.md")
    arguments = parser.parse_args()
    peers = {"torchslam": torchslam, "Ceres (pycolmap)": ceres, "theseus": theseus, "pypose": pypose}
    gradients = {"torchslam": "implicit", "theseus": "implicit", "pypose": "none of its optimiser"}
    rows = []
    for name, solve in peers.items():
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            result = pool.apply(alone, (solve,))
        iteration = "" if result.iterations is None else f"{result.solve_ms / result.iterations:.1f}"
        rows.append(
            [
                name,
                f"{result.rmse_px:.4f}",
                f"{result.solve_ms:.0f}",
                iteration,
                f"{result.memory_mb:.0f}",
                gradients.get(name, "none"),
            ]
        )
    header = ["", "RMSE, px", "solve, ms", "an iteration, ms", "memory, MB", "gradient"]
    text = (
        f"# One window of {FRAMES} frames and {POINTS} points\n\n"
        "One thread, float64, CPU time of one solve; memory with all that is imported.\n\n"
        "    python -m experiments.benchmarks.bundle_peers\n\n"
        f"{table(header, rows)}"
    )
    print(text)
    arguments.output.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
