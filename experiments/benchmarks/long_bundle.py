"""What does the adjustment of a long recording cost, by its number of images?

    python -m experiments.benchmarks.long_bundle [--dense IMAGES] [--output FILE]

A camera walks three times round a block. Points are seen by some eight images in turn, and at a few places by those of
the next lap as well. The same adjustment factorizes the reduced system as one dense matrix, up to IMAGES, and as blocks
of covisible pairs. Every row is a process of its own, so that its memory can be told. Prints a table and writes it to
FILE.
"""

from __future__ import annotations

import math
import multiprocessing
import resource
import time
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from experiments.benchmarks.solvers import camera, colmap_solve, rmse
from experiments.common import parser_of, publish_page, table
from torchslam.geometry import rigid, se3_exp, se3_inverse, so3_exp, transform
from torchslam.optim import BUNDLE_OPTIONS, BundleProblem, solve_bundle
from torchslam.optim.bundle import _schur as schur

HERE = Path(__file__).parent
SIZES = 250, 500, 1000, 2000
LAPS, STEP = 3, 0.25  # meters from image to image
POINTS, TRACK = 40, 8  # that begin in an image; images that see a point in turn
SEEN_AGAIN, PLACE, EVERY = (
    0.1,
    12,
    40,
)  # share of points, in so many of so many images, that the next lap sees
NOISE_PX, DRIFT = 0.5, 2e-4
LARGE_IMAGES, LARGE_POINTS = 1000, 400  # 3.2 million observations
ITERATIONS = 5
MOST_INVERTED = (
    500  # images up to which the dense matrix is inverted for the covariances: beyond, it takes minutes
)


def walk(images: int, points: int = POINTS) -> BundleProblem:
    """The adjustment of a walk, from poses that drift; so many points begin in each image."""
    generator = torch.Generator().manual_seed(0)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    lap = images // LAPS
    radius, angle = lap * STEP / (2 * math.pi), 2 * math.pi * torch.arange(images, dtype=torch.float64) / lap
    zero = torch.zeros_like(angle)
    centers_w = torch.stack((radius * angle.cos(), 0.05 * (7 * angle).sin(), radius * angle.sin()), dim=-1)
    R_wc = so3_exp(torch.stack((zero, -angle, zero), dim=-1))
    T_cw = se3_inverse(rigid(R_wc, centers_w))

    first = torch.arange(images).repeat_interleave(points)
    pixels = torch.tensor([40.0, 40.0]) + uniform(len(first), 2) * torch.tensor([560.0, 400.0])
    rays = camera().unproject(pixels.double())
    points_c = rays / rays[:, 2:] * (2 + 6 * uniform(len(first), 1))
    points_w = (R_wc[first] @ points_c[..., None])[..., 0] + centers_w[first]
    again = (uniform(len(first)) < SEEN_AGAIN) & (first % lap % EVERY < PLACE)
    around = torch.arange(TRACK) - TRACK // 2
    frame_index = (first[:, None] + torch.cat((around, lap + around))).flatten()
    point_index = torch.arange(len(first)).repeat_interleave(2 * TRACK)
    is_later = torch.arange(2 * TRACK).repeat(len(first)) >= TRACK
    there = (frame_index >= 0) & (frame_index < images) & (~is_later | again[point_index])
    frame_index, point_index = frame_index[there], point_index[there]

    seen, valid = camera().project(transform(T_cw[frame_index], points_w[point_index][:, None])[:, 0])
    rows = valid & camera().in_image(seen)
    rows &= (torch.bincount(point_index[rows], minlength=len(first)) >= 3)[point_index]
    kept, point_index = torch.unique(point_index[rows], return_inverse=True)
    drift = (DRIFT * normal(images, 6)).cumsum(0)
    drift[0] = 0
    return BundleProblem(
        se3_exp(drift) @ T_cw,
        points_w[kept] + 0.05 * normal(len(kept), 3),
        frame_index[rows],
        point_index,
        seen[rows] + NOISE_PX * normal(int(rows.sum()), 2),
        camera(),
    )


class Cost(NamedTuple):
    """Of one adjustment and its covariances: CPU time, peak memory of the process, and the cost that it reached."""

    points: int
    observations: int
    seconds: float
    megabytes: float
    of_covariances: float
    with_covariances: float
    reached: float


def measure(images: int, by_blocks: bool) -> Cost:
    """Adjust a walk. For a process of its own."""
    torch.set_num_threads(1)
    schur.SPARSE_FRAMES, schur.MOST_COVISIBLE = 2 if by_blocks else images + 1, 1.0
    problem = walk(images)
    options = BUNDLE_OPTIONS.replace(
        kernel="geman_mcclure", scale=5.0, iterations=ITERATIONS, tolerance=0.0, backward="detached"
    )
    begin = time.process_time()
    solution = solve_bundle(problem, options=options)
    adjusted, peak = time.process_time(), _peak_mb()
    if by_blocks or images <= MOST_INVERTED:
        solution.covariance()
    return Cost(
        len(problem.points_w),
        len(problem.pixels),
        adjusted - begin,
        peak,
        time.process_time() - adjusted,
        _peak_mb(),
        float(solution.cost),
    )


class Large(NamedTuple):
    """CPU seconds, steps, root mean square error in pixels and peak memory of a solver on a large walk."""

    seconds: float
    steps: int
    rmse: float
    megabytes: float


def measure_large(by_ceres: bool) -> tuple[int, int, Large]:
    """Points and observations of a large walk, and its adjustment by one of two solvers. For a process of its own."""
    torch.set_num_threads(1)
    problem = replace(walk(LARGE_IMAGES, LARGE_POINTS), fixed_frames=(0, 1))
    begin = time.process_time()
    if by_ceres:
        peer = colmap_solve(problem)
        steps, reached = peer.iterations, peer.rmse
    else:
        options = BUNDLE_OPTIONS.replace(kernel="none", tolerance=1e-6, backward="detached")
        solution = solve_bundle(problem, options=options)
        steps = int(solution.convergence.iterations)
        reached = rmse(replace(problem, T_cw=solution.T_cw, points_w=solution.points_w))
    seconds = time.process_time() - begin
    return len(problem.points_w), len(problem.pixels), Large(seconds, steps, reached, _peak_mb())


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> None:
    parser = parser_of(__doc__, HERE / "long_bundle.md")
    parser.add_argument("--dense", type=int, default=SIZES[-1], help="most images of the dense matrix")
    arguments = parser.parse_args()
    header = ["images", "points", "observations", "reduced system", f"{ITERATIONS} steps", "peak memory"]
    header += ["covariances", "peak memory with them", "difference of the cost"]
    rows = []
    with multiprocessing.get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        for images in SIZES:
            blocks = pool.apply(measure, (images, True))
            of_all = [("blocks", blocks)]
            if images <= arguments.dense:
                of_all.append(("dense", pool.apply(measure, (images, False))))
            for name, cost in of_all:
                sizes = [f"{images}", f"{cost.points}", f"{cost.observations}", name]
                of_steps = [f"{cost.seconds:.1f} s", f"{cost.megabytes:.0f} MB"]
                covariances = [f"{cost.of_covariances:.1f} s", f"{cost.with_covariances:.0f} MB"]
                if name == "dense" and images > MOST_INVERTED:
                    covariances = ["", ""]
                difference = f"{abs(cost.reached / blocks.reached - 1):.0e}"
                rows.append([*sizes, *of_steps, *covariances, difference])
                print(rows[-1], flush=True)
        large = [pool.apply(measure_large, (by_ceres,)) for by_ceres in (False, True)]
    of_large = [
        [name, f"{cost.seconds:.0f} s", f"{cost.steps}", f"{cost.rmse:.4f} px", f"{cost.megabytes:.0f} MB"]
        for name, (_, _, cost) in zip(("torchslam", "Ceres (pycolmap)"), large, strict=True)
    ]
    lines = [
        f"A simulated walk, three times round a block; {POINTS} points begin in each image. One thread, float64, CPU",
        "time with that of the check that all is determined, which is one more factorization; the memory is that of",
        "the process, some 250 MB of it before the adjustment.",
        "",
        "    python -m experiments.benchmarks.long_bundle",
        "",
        table(header, rows),
        "",
        f"{LARGE_IMAGES} images, {large[0][0]} points, {large[0][1]} observations, without a kernel, to convergence:",
        "",
        table(["", "CPU", "steps", "error", "peak memory"], of_large),
    ]
    publish_page("The adjustment of a long recording", "\n".join(lines), arguments)


if __name__ == "__main__":
    main()
