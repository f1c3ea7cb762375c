"""How accurate, fast and large are the gradients of a pose refinement, by mode?

    python -m experiments.gradients.run [--quick]

Writes results.md and gradients.png next to this file. Float64, one thread, robust kernel (cauchy) throughout.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import matplotlib
import torch
from torch import Tensor

from experiments.benchmarks.solvers import POSE_STEPS
from experiments.common import gradient_error, parser_of, table
from torchslam.geometry import Camera, se3_exp, se3_inverse, transform
from torchslam.optim import POSE_OPTIONS, Backward, RefinedPose, solve_pose

HERE = Path(__file__).parent
MODES: tuple[tuple[Backward, int], ...] = (("implicit", 20), ("unroll", 20), ("unroll", 5), ("truncated", 20))


@dataclass(frozen=True)
class Problem:
    """One view of known points: a start and the inputs that gradients flow to."""

    start: Tensor
    inputs: dict[str, Tensor]

    def refine(
        self, inputs: dict[str, Tensor], mode: Backward, iterations: int, tolerance: float
    ) -> RefinedPose:
        camera = Camera("pinhole", inputs["params"], (640, 480))
        options = POSE_OPTIONS.replace(
            scale=inputs["scale"], iterations=iterations, tolerance=tolerance, backward=mode
        )
        return solve_pose(
            inputs["points_w"],
            inputs["pixels"],
            T_cw=self.start,
            camera=camera,
            weights=inputs["weights"],
            options=options,
        )

    def loss(self, inputs: dict[str, Tensor], mode: Backward, iterations: int, tolerance: float) -> Tensor:
        T_cw = self.refine(inputs, mode, iterations, tolerance).T_cw
        return T_cw[0, :3].flatten() @ torch.linspace(-1, 1, 12, dtype=T_cw.dtype)


def simulate(points: int, noise: float, outliers: float, seed: int) -> Problem:
    """A random pose near points 2 to 8 m away, a start some 3 degrees and 5 cm off; noise in px."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    camera = Camera.pinhole(525.0, 525.0, 319.5, 239.5, size=(640, 480))
    T_cw = se3_exp(0.5 * normal(1, 6))
    uniform = torch.rand(1, points, 3, generator=generator, dtype=torch.float64)
    pixels = uniform[..., :2] * torch.tensor([640.0, 480.0], dtype=torch.float64)
    bearings = camera.unproject(pixels)
    points_c = bearings / bearings[..., 2:] * (2 + 6 * uniform[..., 2:])
    pixels = pixels + noise * normal(1, points, 2)
    bad = round(outliers * points)
    pixels[:, :bad] = torch.rand(1, bad, 2, generator=generator, dtype=torch.float64) * 480
    inputs = {
        "points_w": transform(se3_inverse(T_cw), points_c),
        "pixels": pixels,
        "weights": 0.5 + torch.rand(1, points, generator=generator, dtype=torch.float64),
        "params": camera.params,
        "scale": torch.tensor(2.0, dtype=torch.float64),
    }
    return Problem(se3_exp(0.05 * normal(1, 6)) @ T_cw, inputs)


def error(problem: Problem, mode: Backward, iterations: int) -> float:
    """Largest relative error over the inputs; converged solves are differenced."""

    def loss(mode: Backward, iterations: int, tolerance: float, **inputs: Tensor) -> Tensor:
        return problem.loss(inputs, mode, iterations, tolerance)

    solve, converged = partial(loss, mode, iterations, 1e-10), partial(loss, "detached", 100, 0.0)
    return gradient_error(solve, problem.inputs, POSE_STEPS, converged)


def median_error(points: int, noise: float, outliers: float, seeds: int) -> list[float]:
    """Per mode, the median over problems."""
    errors: list[list[float]] = [[] for _ in MODES]
    for seed in range(seeds):
        problem = simulate(points, noise, outliers, seed)
        for record, (mode, iterations) in zip(errors, MODES, strict=True):
            record.append(error(problem, mode, iterations))
    return [statistics.median(record) for record in errors]


def cost(points: int, mode: Backward, iterations: int, repeats: int) -> tuple[float, float, float]:
    """Median milliseconds forward and backward, and KiB that the graph keeps in between."""
    problem = simulate(points, 1.0, 0.2, seed=0)
    leaves = {name: tensor.clone().requires_grad_() for name, tensor in problem.inputs.items()}
    forward, backward = [], []
    for _ in range(repeats + 1):
        begin = time.process_time()
        loss = problem.loss(leaves, mode, iterations, 0.0)
        middle = time.process_time()
        loss.backward()
        forward.append(1e3 * (middle - begin))
        backward.append(1e3 * (time.process_time() - middle))
    kept: dict[int, int] = {}

    def pack(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        kept[storage.data_ptr()] = storage.nbytes()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
        loss = problem.loss(leaves, mode, iterations, 0.0)
    return statistics.median(forward[1:]), statistics.median(backward[1:]), sum(kept.values()) / 1024


def label(mode: Backward, iterations: int) -> str:
    return f"{mode}, {iterations} iterations" if mode == "unroll" else mode


def draw(
    shares: Sequence[float],
    bias: Sequence[Sequence[float]],
    counts: Sequence[int],
    memory: dict[str, list[float]],
) -> None:
    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    for (mode, iterations), errors in zip(MODES, zip(*bias, strict=True), strict=True):
        left.semilogy([100 * share for share in shares], errors, marker="o", label=label(mode, iterations))
    left.axhline(1e-5, color="gray", linestyle=":", linewidth=1)
    left.set(
        xlabel="outliers [%]",
        ylabel="relative error of the gradient",
        title="Error against central differences",
    )
    left.legend()
    for name, kibibytes in memory.items():
        right.semilogy(counts, kibibytes, marker="o", label=name)
    right.set(xlabel="iterations", ylabel="kept for the backward pass [KiB]", title="Memory, 300 points")
    right.legend()
    figure.savefig(HERE / "gradients.png", dpi=150)


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer problems and repeats")
    quick = parser.parse_args().quick
    torch.set_num_threads(1)
    seeds, repeats = (2, 3) if quick else (7, 21)

    shares = (0.0, 0.1, 0.2, 0.3, 0.4)
    bias = [median_error(300, 1.0, share, seeds) for share in shares]
    by_noise = [median_error(300, noise, 0.2, seeds) for noise in (0.1, 0.5, 1.0, 2.0)]
    names = [label(*mode) for mode in MODES]
    accuracy = [
        [f"1.0 px, {100 * share:.0f} %", *(f"{e:.0e}" for e in errors)]
        for share, errors in zip(shares, bias, strict=True)
    ] + [
        [f"{noise} px, 20 %", *(f"{e:.0e}" for e in errors)]
        for noise, errors in zip((0.1, 0.5, 1.0, 2.0), by_noise, strict=True)
        if noise != 1.0
    ]

    counts, memory, costs = (5, 10, 20), {}, []  # type: tuple[int, ...], dict[str, list[float]], list[list[str]]
    for mode in ("implicit", "unroll", "truncated"):
        for points in (100, 300, 1000):
            for iterations in counts:
                ahead, back, kept = cost(points, mode, iterations, repeats)
                if points == 300:
                    memory.setdefault(mode, []).append(kept)
                costs.append(
                    [mode, str(points), str(iterations), f"{ahead:.1f}", f"{back:.1f}", f"{kept:.0f}"]
                )
    draw(shares, bias, counts, memory)
    text = (
        "Largest relative error over points, pixels, weights, camera and scale; median over problems of 300 points:\n\n"
        + table(["noise, outliers", *names], accuracy)
        + "\nCost of one problem, medians, CPU time of the process:\n\n"
        + table("mode | points | iterations | forward [ms] | backward [ms] | kept [KiB]", costs)
    )
    print(text)
    (HERE / "results.md").write_text(text)


if __name__ == "__main__":
    main()
