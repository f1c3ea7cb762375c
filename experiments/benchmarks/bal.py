"""Bundle adjustment on a problem in the format of "Bundle Adjustment in the Large": cost against time.

    python -m experiments.benchmarks.bal [FILE] [--frames 200] [--output FILE]

FILE is a problem of https://grail.cs.washington.edu/projects/bal, unpacked. Without one, a problem is written from the
observations of a run on a rendered walk, whose poses and points are then disturbed. First the poses and points alone
are free, then all 9 numbers of every camera: pose, focal length, two radial distortion coefficients. Times are those
of the processor, of one thread.
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from experiments.benchmarks.ceres import solve_by_ceres
from experiments.common import parser_of, publish_page, table
from torchslam import SLAM
from torchslam.config import load_config
from torchslam.data import open_sequence
from torchslam.geometry import Camera, rigid, se3_exp, so3_exp, so3_log, transform
from torchslam.optim import BUNDLE_OPTIONS, BundleProblem, solve_bundle
from torchslam.optim.observation_graph import ObservationGraph

HERE = Path(__file__).parent
AXES = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
"""A camera of the format looks along -z, with y up."""
FREE = torch.zeros(9, 3, dtype=torch.float64).index_put(
    (torch.tensor([0, 1, 4, 5]), torch.tensor([0, 0, 1, 2])), torch.ones(4, dtype=torch.float64)
)
"""What is free of a camera: the focal length, k1, k2."""
STEPS = (1, 2, 3, 5, 8, 12, 20)


def read_bal(path: Path) -> BundleProblem:
    """Read a problem; every frame has a camera of its own."""
    with path.open() as file:
        cameras, points, observations = map(int, file.readline().split())
        numbers = torch.from_numpy(np.fromstring(file.read(), sep=" "))
    seen = numbers[: 4 * observations].view(-1, 4)
    camera = numbers[4 * observations :][: 9 * cameras].view(-1, 9)
    T_cw = rigid(AXES[:, None] * so3_exp(camera[:, :3]), AXES * camera[:, 3:6])
    zero = torch.zeros(cameras, 1, dtype=torch.float64)
    f, k = camera[:, 6:7], camera[:, 7:]
    params = torch.cat((f, f, zero, zero, k, zero, zero, zero), dim=-1)
    pixels = seen[:, 2:] * AXES[:2]
    size = 2 * int(pixels.abs().max()) + 2
    return BundleProblem(
        T_cw,
        numbers[-3 * points :].view(-1, 3).clone(),
        seen[:, 0].long(),
        seen[:, 1].long(),
        pixels,
        Camera("radial_tangential", params, (size, size)),
        camera_index=torch.arange(cameras),
    )


def write_bal(path: Path, problem: BundleProblem) -> None:
    """Write a problem with a radial_tangential camera for each frame, whose principal point is zero."""
    R = AXES[:, None] * problem.T_cw[:, :3, :3]
    params = problem.camera.params
    cameras = torch.cat((so3_log(R), AXES * problem.T_cw[:, :3, 3], params[:, :1], params[:, 4:6]), dim=-1)
    pixels = (problem.pixels * AXES[:2]).tolist()
    rows = zip(problem.frame_index.tolist(), problem.point_index.tolist(), pixels, strict=True)
    lines = [f"{len(cameras)} {len(problem.points_w)} {len(problem.pixels)}"]
    lines += [f"{frame} {point} {x!r} {y!r}" for frame, point, (x, y) in rows]
    lines += [repr(value) for value in [*cameras.flatten().tolist(), *problem.points_w.flatten().tolist()]]
    path.write_text("\n".join(lines) + "\n")


def problem_of_run(frames: int) -> BundleProblem:
    """The keyframes and points of a run on a rendered walk, disturbed."""
    sequence = open_sequence(f"synthetic:room?frames={frames}")
    config = load_config(None, ["features.kind=opencv-orb", "camera.std=0"])
    graph = SLAM(sequence.camera, config).run(sequence).graph
    return disturbed(problem_of_graph(graph))


def problem_of_graph(graph: ObservationGraph) -> BundleProblem:
    """All frames of a graph and the points that three or more of them see, without distortion."""
    counts = torch.bincount(graph.point_index, minlength=len(graph.points_w))
    kept = counts[graph.point_index] >= 3
    points, point_index = torch.unique(graph.point_index[kept], return_inverse=True)
    fx, fy, cx, cy = graph.camera.params[:4]
    pixels = (graph.pixels[kept] - torch.stack((cx, cy))) * torch.stack((fx / fx, fx / fy))
    params = torch.zeros(len(graph.T_cw), 9, dtype=torch.float64)
    params[:, :2] = fx
    camera = Camera("radial_tangential", params, graph.camera.size)
    index = torch.arange(len(graph.T_cw))
    return BundleProblem(
        graph.T_cw,
        graph.points_w[points],
        graph.frame_index[kept],
        point_index,
        pixels,
        camera,
        camera_index=index,
    )


def disturbed(problem: BundleProblem) -> BundleProblem:
    """Poses off by 0.01, points by 0.02, focal lengths by 2 %."""
    noise: dict[str, Any] = {"generator": torch.Generator().manual_seed(0), "dtype": torch.float64}
    twist = 0.01 * torch.randn(len(problem.T_cw), 6, **noise)
    twist[0] = 0
    params = problem.camera.params.clone()
    params[:, :2] *= 1 + 0.02 * torch.randn(len(params), 1, **noise)
    points_w = problem.points_w + 0.02 * torch.randn(problem.points_w.shape, **noise)
    return replace(
        problem,
        T_cw=se3_exp(twist) @ problem.T_cw,
        points_w=points_w,
        camera=problem.camera.with_params(params),
    )


def cost(problem: BundleProblem, T_cw: Tensor, points_w: Tensor, params: Tensor) -> float:
    """Half the sum of the squared reprojection errors, px^2, as Ceres counts."""
    points_c = transform(T_cw[problem.frame_index], points_w[problem.point_index][:, None])
    camera = problem.camera.with_params(params[problem.frame_index])
    pixels = camera.project(points_c)[0][:, 0]
    return float((pixels - problem.pixels).square().sum()) / 2


def ours(problem: BundleProblem, iterations: int, gradient: bool, free: bool) -> list[str]:
    """A row of the table: cost and seconds after so many iterations, with the gradient to all pixels or without."""
    pixels = problem.pixels.clone().requires_grad_(gradient)
    began = time.process_time()
    solution = solve_bundle(
        replace(problem, pixels=pixels),
        free_camera=FREE if free else False,
        options=BUNDLE_OPTIONS.replace(
            kernel="none", iterations=iterations, backward="implicit" if gradient else "detached"
        ),
    )
    solved = time.process_time()
    if gradient:
        points = solution.points_w.flatten()
        (points @ torch.linspace(-1, 1, len(points), dtype=points.dtype)).backward()
    with torch.no_grad():
        reached = cost(problem, solution.T_cw, solution.points_w, solution.camera.params)
    backward = f"{time.process_time() - solved:.2f}" if gradient else "none"
    done = int(solution.convergence.iterations)
    return ["torchslam", str(done), f"{reached:.1f}", f"{solved - began:.2f}", backward]


def ceres(problem: BundleProblem, iterations: int, free: bool) -> list[str]:
    """The same by COLMAP's Ceres: a camera RADIAL for each image."""
    import pycolmap

    width, height = problem.camera.size
    cameras = []
    for f, k1, k2 in problem.camera.params[:, [0, 4, 5]].tolist():
        numbers = [f, 0.0, 0.0, k1, k2]
        cameras.append(pycolmap.Camera(model="RADIAL", width=width, height=height, params=numbers))
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point = False
    options.refine_focal_length = options.refine_extra_params = free
    options.ceres.solver_options.max_num_iterations = iterations
    solved = solve_by_ceres(problem, cameras, (0,), options)
    params = torch.zeros(len(cameras), 9, dtype=torch.float64)
    for row, camera in zip(params, solved.cameras, strict=True):
        f, _, _, k1, k2 = camera.params
        row[[0, 1, 4, 5]] = torch.tensor([f, f, k1, k2], dtype=torch.float64)
    reached = cost(problem, solved.T_cw, solved.points_w, params)
    return ["Ceres (pycolmap)", str(solved.iterations), f"{reached:.1f}", f"{solved.seconds:.2f}", "none"]


def distinct(rows: list[list[str]]) -> list[list[str]]:
    """The rows without those that differ from one before in the seconds alone: of a solver that ended early."""
    first: dict[tuple[str, ...], list[str]] = {}
    for row in rows:
        solver, iterations, reached, _, gradient = row
        first.setdefault((solver, iterations, reached, "" if gradient == "none" else "with"), row)
    return list(first.values())


def main() -> None:
    parser = parser_of(__doc__, HERE / "bal.md")
    parser.add_argument("file", type=Path, nargs="?")
    parser.add_argument("--frames", type=int, default=40)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.file is None:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "problem.txt"
            write_bal(path, problem_of_run(arguments.frames))
            problem, source = (
                read_bal(path),
                f"written from a run on {arguments.frames} rendered frames, disturbed",
            )
    else:
        problem, source = read_bal(arguments.file), arguments.file.name
    start = cost(problem, problem.T_cw, problem.points_w, problem.camera.params)
    beside = "beside Ceres as COLMAP uses it" if find_spec("pycolmap") else "without pycolmap"
    ours(problem, 2, gradient=True, free=False)  # what a first call does once
    tables = []
    for free in (False, True):
        rows = [ours(problem, most, gradient=False, free=free) for most in STEPS]
        rows.append(ours(problem, STEPS[-1], gradient=True, free=free))
        rows += [ceres(problem, most, free) for most in STEPS] if find_spec("pycolmap") else []
        header = "solver | iterations | cost, px^2 | solve, s | gradient to all pixels, s more"
        tables.append(table(header, distinct(rows)))
    counts = (
        f"{len(problem.T_cw)} cameras, {len(problem.points_w)} points, {len(problem.pixels)} observations"
    )
    lines = [
        f"{counts}; {source}. The cost at the start is {start:.1f} px^2; {beside}.",
        "",
        "## Poses and points are free",
        "",
        tables[0],
        "",
        "## All 9 numbers of every camera are free",
        "",
        tables[1],
        "",
        "Each row is a solve of its own, from the start, with at most so many iterations; where a solver ends "
        "earlier, once. Written by `python -m experiments.benchmarks.bal`, or with the path of a problem from the "
        "collection.",
    ]
    publish_page("Bundle adjustment on a problem in BAL's format", "\n".join(lines) + "\n", arguments)


if __name__ == "__main__":
    main()
