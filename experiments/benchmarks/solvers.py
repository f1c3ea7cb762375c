"""Speed and accuracy of the solvers compared with pycolmap (Ceres), in one run on one thread.

    python -m experiments.benchmarks.solvers [--peers FOLDER] [--output FILE]

FOLDER holds `problems.py`, which makes the fixed problems. Prints a table and writes it to FILE.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import torch
from torch import Tensor

from experiments.benchmarks.ceres import solve_by_ceres
from experiments.benchmarks.problems import PEERS, load_problems
from experiments.common import gradient_error, milliseconds, parser_of, publish_page, table
from torchslam.geometry import Camera, rigid, se3_exp, se3_inverse, so3_exp, transform
from torchslam.geometry.robust import Kernel
from torchslam.optim import BUNDLE_OPTIONS, POSE_OPTIONS, BundleProblem, solve_bundle, solve_pose

HERE = Path(__file__).parent
POSE_STEPS = {"points_w": 1e-6, "pixels": 1e-4, "weights": 1e-5, "params": 1e-4, "scale": 1e-5}
"""Of central differences, by input."""
FOCAL, CENTER, SIZE = 525.0, (319.5, 239.5), (640, 480)


class Row(NamedTuple):
    what: str
    reached: str
    reference: str


class Peer(NamedTuple):
    """Time, iterations and solution of pycolmap, and its RMSE in px."""

    solve_ms: float
    iterations: int
    rmse: float
    T_cw: Tensor
    points_w: Tensor


def camera() -> Camera:
    return Camera.pinhole(FOCAL, FOCAL, *CENTER, size=SIZE)


# --- poses -----------------------------------------------------------------------------------------------------


def pose_inputs(problems: ModuleType, batch: int) -> tuple[Tensor, dict[str, Tensor]]:
    """Starts (B, 4, 4) and the inputs of B problems of 300 points, 20 % of them outliers."""
    generator = torch.Generator().manual_seed(0)
    starts, points, pixels = [], [], []
    for seed in range(batch):
        X, x, R, t, _ = problems.pnp(seed, n=300, outliers=0.2)
        offset = rigid(
            so3_exp(0.02 * torch.randn(3, generator=generator, dtype=torch.float64)),
            0.05 * torch.randn(3, generator=generator, dtype=torch.float64),
        )
        starts.append(offset @ rigid(torch.tensor(R), torch.tensor(t)))
        points.append(torch.tensor(X))
        pixels.append(torch.tensor(x))
    weights = 0.5 + torch.rand(batch, 300, generator=generator, dtype=torch.float64)
    return torch.stack(starts), {
        "points_w": torch.stack(points),
        "pixels": torch.stack(pixels),
        "weights": weights,
        "params": camera().params,
        "scale": torch.tensor(1.0, dtype=torch.float64),
    }


def pose_loss(start: Tensor, points_w, pixels, weights, params, scale, **options) -> Tensor:  # type: ignore[no-untyped-def]
    refined = solve_pose(
        points_w,
        pixels,
        T_cw=start,
        camera=camera().with_params(params),
        weights=weights,
        options=POSE_OPTIONS.replace(scale=scale, **options),
    )
    return (refined.T_cw[:, :3].flatten(1) @ torch.linspace(-1, 1, 12, dtype=torch.float64)).sum()


def compare_with_dlt() -> Row:
    """64 poses of 60 points with the gradient to all pixels, beside the direct linear transform of kornia."""
    from kornia.geometry.calibration.pnp import solve_pnp_dlt

    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    T_cw = se3_exp(0.3 * normal(64, 6))
    points_c = torch.cat((normal(64, 60, 2), (4 + normal(64, 60, 1)).clamp_min(2)), dim=-1)
    points_w = transform(se3_inverse(T_cw), points_c)
    pixels = (camera().project(points_c)[0] + 0.5 * normal(64, 60, 2)).requires_grad_()
    start = se3_exp(0.02 * normal(64, 6)) @ T_cw
    K = camera().K.expand(64, 3, 3)
    options = POSE_OPTIONS.replace(kernel="none")

    def ours() -> Tensor:
        return solve_pose(points_w, pixels, T_cw=start, camera=camera(), options=options).T_cw[:, :3]

    def theirs() -> Tensor:
        return solve_pnp_dlt(points_w, pixels, K)

    def backward(solve: Callable[[], Tensor]) -> None:
        pixels.grad = None
        solve().sum().backward()

    ours_ms, theirs_ms = milliseconds(partial(backward, ours), partial(backward, theirs), repeats=15)
    off = [float((solve() - T_cw[:, :3]).detach().abs().mean()) for solve in (ours, theirs)]
    what = f"64 poses of 60 points with backward, least squares: time / kornia's `solve_pnp_dlt` ({theirs_ms:.1f} ms)"
    return Row(f"{what}; its error / kornia's {off[0] / off[1]:.2f}", f"{ours_ms / theirs_ms:.2f}", "1.2")


def benchmark_pose(problems: ModuleType) -> list[Row]:
    start, inputs = pose_inputs(problems, 1)
    leaves = {name: tensor.clone().requires_grad_() for name, tensor in inputs.items()}

    def forward() -> None:
        with torch.no_grad():
            pose_loss(start, **inputs)

    def backward() -> float:
        loss = pose_loss(start, **leaves)
        begin = time.process_time()
        loss.backward()
        return 1e3 * (time.process_time() - begin)

    starts, many = pose_inputs(problems, 64)

    def together() -> None:
        with torch.no_grad():
            pose_loss(starts, **many)

    def loop() -> None:
        with torch.no_grad():
            for row in range(64):
                one = {name: many[name][row : row + 1] for name in ("points_w", "pixels", "weights")}
                pose_loss(starts[row : row + 1], **(many | one))

    forward_ms, backward_ms = milliseconds(forward, backward, repeats=101)
    together_ms, loop_ms = milliseconds(together, loop, repeats=5)
    error = gradient_error(partial(pose_loss, start, iterations=100, tolerance=0.0), inputs, POSE_STEPS)
    iterations = solve_pose(
        inputs["points_w"], inputs["pixels"], T_cw=start, camera=camera(), weights=inputs["weights"]
    ).convergence.iterations.item()
    return [
        Row(
            f"`solve_pose`, 300 points, 20 % outliers, cauchy: forward ({iterations} iterations)",
            f"{forward_ms:.1f} ms",
            "4 ms",
        ),
        Row("its backward / forward", f"{backward_ms / forward_ms:.2f}", "2"),
        Row("its gradient to all inputs against central differences", f"{error:.0e}", "1e-05"),
        Row(
            "64 problems in one call: throughput against a loop", f"{loop_ms / together_ms:.1f}", "at least 5"
        ),
        compare_with_dlt(),
    ]


# --- bundles ---------------------------------------------------------------------------------------------------


def bundle_problem(problems: ModuleType) -> BundleProblem:
    data = problems.ba()
    poses = torch.tensor(data["poses0"])
    return BundleProblem(
        rigid(so3_exp(poses[:, :3]), poses[:, 3:]),
        torch.tensor(data["pts0"]),
        torch.tensor(data["cam"]),
        torch.tensor(data["pt"]),
        torch.tensor(data["uv"]),
        camera(),
        fixed_frames=(0, 1),
    )


def colmap_solve(problem: BundleProblem) -> Peer:
    """The same problem by pycolmap. Fixed intrinsics, no robust loss, one thread."""
    import pycolmap

    model = pycolmap.Camera(model="PINHOLE", width=SIZE[0], height=SIZE[1], params=[FOCAL, FOCAL, *CENTER])
    solved = solve_by_ceres(problem, [model], (0, 1), pycolmap.BundleAdjustmentOptions())
    reached = rmse(replace(problem, T_cw=solved.T_cw, points_w=solved.points_w))
    return Peer(1e3 * solved.seconds, solved.iterations, reached, solved.T_cw, solved.points_w)


def rmse(problem: BundleProblem) -> float:
    """Root mean square of the reprojection errors, px."""
    T_cw, points_w = problem.T_cw[problem.frame_index], problem.points_w[problem.point_index]
    pixels, _ = problem.camera.project(transform(T_cw, points_w[:, None])[:, 0])
    return float((pixels - problem.pixels).square().sum(-1).mean().sqrt())


def bundle_loss(
    problem: BundleProblem, pixels: Tensor, weights: Tensor, params: Tensor, **options: Any
) -> Tensor:
    problem = replace(problem, pixels=pixels, weights=weights, camera=problem.camera.with_params(params))
    solution = solve_bundle(problem, options=BUNDLE_OPTIONS.replace(**options))
    poses, points = solution.T_cw[:, :3].flatten(), solution.points_w.flatten()
    return sum(x @ torch.linspace(-1, 1, len(x), dtype=torch.float64) for x in (poses, points))  # type: ignore[return-value]


def benchmark_bundle(problems: ModuleType) -> list[Row]:
    problem = bundle_problem(problems)
    generator = torch.Generator().manual_seed(0)
    inputs = {
        "pixels": problem.pixels,
        "weights": 0.5 + torch.rand(len(problem.pixels), generator=generator, dtype=torch.float64),
        "params": problem.camera.params,
    }
    leaves = {name: tensor.clone().requires_grad_() for name, tensor in inputs.items()}

    def solve() -> None:
        with torch.no_grad():
            solve_bundle(problem, options=BUNDLE_OPTIONS.replace(kernel="none"))

    def backward(kernel: Kernel) -> float:
        loss = bundle_loss(problem, **leaves, kernel=kernel, scale=2.0)
        begin = time.process_time()
        loss.backward()
        return 1e3 * (time.process_time() - begin)

    ours, colmap, back = milliseconds(
        solve,
        lambda: colmap_solve(problem).solve_ms,
        lambda: backward("none"),
    )
    with torch.no_grad():
        solution = solve_bundle(problem, options=BUNDLE_OPTIONS.replace(kernel="none"))
    reached = rmse(replace(problem, T_cw=solution.T_cw, points_w=solution.points_w))
    exactly = partial(bundle_loss, problem, scale=2.0, iterations=60, tolerance=1e-28)
    steps = {name: POSE_STEPS[name] for name in inputs}
    errors = {
        kernel: gradient_error(partial(exactly, kernel=kernel), inputs, steps)
        for kernel in ("none", "cauchy")
    }
    return [
        Row(
            "`solve_bundle`, 10 cameras, 1940 points, 11120 observations: RMSE at the optimum",
            f"{reached:.4f} px",
            f"{colmap_solve(problem).rmse:.4f} px (pycolmap)",
        ),
        Row(
            f"its time ({solution.convergence.iterations.item()} iterations)",
            f"{ours:.0f} ms",
            f"{colmap:.0f} ms (pycolmap)",
        ),
        Row("its time / pycolmap's", f"{ours / colmap:.2f}", "1.3"),
        Row("its backward / its time", f"{back / ours:.2f}", "1"),
        Row(
            "its gradient to pixels, weights, camera against central differences, least squares",
            f"{errors['none']:.0e}",
            "1e-05",
        ),
        Row("the same, cauchy", f"{errors['cauchy']:.0e}", "1e-05"),
    ]


def main() -> None:
    parser = parser_of(__doc__, HERE / "solvers.md")
    parser.add_argument("--peers", type=Path, default=PEERS)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    problems = load_problems(arguments.peers)
    rows = benchmark_pose(problems) + benchmark_bundle(problems)
    text = table("what | reached | required, or the peer", rows)
    how = "One thread, float64, median CPU time of the process, interleaved with the peers: "
    publish_page("Solvers", f"{how}`python -m experiments.benchmarks.solvers`.\n\n{text}", arguments)


if __name__ == "__main__":
    main()
