"""What does the gradient of a whole run cost, and is it right? See README.md."""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from experiments.common import parser_of, sequences, table, write_between
from torchslam.config import load_config
from torchslam.data.sequence import GROUNDTRUTH_TOLERANCE, Sequence
from torchslam.data.trajectories import interpolate_poses
from torchslam.evaluation import ate
from torchslam.geometry import se3_exp, se3_inverse
from torchslam.optim import GRAPH_OPTIONS
from torchslam.optim.run_graph import GraphSolution, ObservationGraph, solve_graph
from torchslam.system.slam import SLAM

HERE = Path(__file__).parent
RESULTS = HERE / "results"
MEASURES = ("adjust from a disturbed start", "adjust", "adjust and differentiate")


def graph_of(sequence: Sequence) -> ObservationGraph:
    """The graph of a run over the sequence, cached."""
    file = RESULTS / f"{sequence.name}.safetensors"
    if not file.exists():
        print(f"running {sequence.name}", flush=True)
        RESULTS.mkdir(exist_ok=True)
        SLAM(sequence.camera, load_config()).run(sequence).graph.save(file)
    return ObservationGraph.load(file)


def truth_of(graph: ObservationGraph, sequence: Sequence) -> tuple[Tensor, Tensor]:
    """(F, 4, 4) true T_cw at the times of the graph's frames, and (F,) where they are known."""
    assert sequence.groundtruth is not None
    T_wc, known = interpolate_poses(sequence.groundtruth, graph.timestamps, GROUNDTRUTH_TOLERANCE)
    return se3_inverse(T_wc), known


def disturbed(graph: ObservationGraph) -> ObservationGraph:
    """Perturb a graph by about half a degree, 1 % of the median depth, and 2 % of every point's position."""
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=graph.T_cw.dtype)

    twists = 0.01 * normal(len(graph.T_cw), 6)
    twists[0] = 0
    return replace(
        graph, T_cw=se3_exp(twists) @ graph.T_cw, points_w=graph.points_w * (1 + 0.02 * normal(len(graph.points_w), 1))
    )  # fmt: skip


def with_leaves(graph: ObservationGraph) -> tuple[ObservationGraph, Tensor, Tensor]:
    """The graph, its pixels and its camera parameters as leaves."""
    pixels, params = graph.pixels.clone().requires_grad_(), graph.camera.params.clone().requires_grad_()
    return replace(graph, pixels=pixels, camera=graph.camera.with_params(params)), pixels, params


def measure(name: str, sequence: Sequence) -> dict[str, float]:
    """Seconds of one thread, and the memory beyond that of the graph in MiB, of one of `MEASURES`.

    Call this once per process, since freed memory is reused without raising the peak.
    """
    graph = graph_of(sequence)
    T_cw, known = truth_of(graph, sequence)
    _forget_peak()
    before = _peak_mib()
    start = time.process_time()
    if name != "adjust and differentiate":
        solution = solve_graph(
            disturbed(graph) if "disturbed" in name else graph,
            options=GRAPH_OPTIONS.replace(backward="detached"),
        )
        seconds = {"adjust": time.process_time() - start}
    else:
        leaves, _, _ = with_leaves(graph)
        solution = solve_graph(leaves)
        loss = ate(T_cw=solution.T_cw[known], T_cw_groundtruth=T_cw[known])
        middle = time.process_time()
        loss.backward()
        seconds = {"adjust": middle - start, "backward": time.process_time() - middle}
    return seconds | {
        "mib": _peak_mib() - before,
        "iterations": int(solution.keyframes[0].convergence.iterations),
        "ate_m": ate(T_cw=solution.T_cw[known], T_cw_groundtruth=T_cw[known]).item(),
    }


def _forget_peak() -> None:
    """Reset the peak memory of this process (Linux)."""
    Path("/proc/self/clear_refs").write_text("5")


def _peak_mib() -> float:
    status = Path("/proc/self/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0]) / 1024


def measured(name: str, sequence: str, repetitions: int) -> dict[str, float]:
    """Medians of `measure` over some fresh processes."""
    command = [sys.executable, "-m", "experiments.run_gradient.run", sequence, "--measure", name]
    outputs = [
        subprocess.run(command, check=True, capture_output=True, text=True) for _ in range(repetitions)
    ]
    results = [json.loads(output.stdout.splitlines()[-1]) for output in outputs]
    return {key: statistics.median(result[key] for result in results) for key in results[0]}


Direction = tuple[str, Tensor, Tensor, float]
"""A name, the directions of pixels (O, 2) and camera parameters, and the step of the differences in px."""


def differentiate(
    graph: ObservationGraph, T_cw: Tensor, known: Tensor
) -> tuple[GraphSolution, Tensor, Tensor, Tensor]:
    """Solve the graph; return the solution, its ATE, and the gradients of that to pixels and camera parameters."""
    leaves, pixels, params = with_leaves(graph)
    solution = solve_graph(leaves)
    loss = ate(T_cw=solution.T_cw[known], T_cw_groundtruth=T_cw[known])
    loss.backward()
    assert pixels.grad is not None
    assert params.grad is not None
    return solution, loss, pixels.grad, params.grad


def check(
    graph: ObservationGraph,
    T_cw: Tensor,
    known: Tensor,
    pixels: Tensor,
    params: Tensor,
    along: list[Direction],
) -> str:
    """A table of derivatives along directions: by the gradients of pixels and parameters, by central differences."""

    def error_m(step_pixels: Tensor, step_params: Tensor) -> float:
        moved = replace(
            graph,
            pixels=graph.pixels + step_pixels,
            camera=graph.camera.with_params(graph.camera.params + step_params),
        )
        solution = solve_graph(
            moved, options=GRAPH_OPTIONS.replace(iterations=12, tolerance=0.0, backward="detached")
        )
        return float(ate(T_cw=solution.T_cw[known], T_cw_groundtruth=T_cw[known]))

    rows = []
    for name, along_pixels, along_params, step in along:
        analytic = float((pixels * along_pixels).sum() + (params * along_params).sum())
        ahead, behind = (error_m(sign * step * along_pixels, sign * step * along_params) for sign in (1, -1))
        numeric = (ahead - behind) / (2 * step)
        rows.append(
            [name, f"{1e3 * analytic:.6f}", f"{1e3 * numeric:.6f}", f"{abs(analytic / numeric - 1):.1e}"]
        )
        print(*rows[-1], sep="\t", flush=True)
    return table("direction | gradient (mm/px) | central differences (mm/px) | relative error", rows)


def directions(graph: ObservationGraph) -> list[Direction]:
    generator = torch.Generator().manual_seed(1)
    noise = torch.randn(graph.pixels.shape, generator=generator, dtype=graph.pixels.dtype)
    one_frame = noise * (graph.frame_index == len(graph.T_cw) // 2)[:, None]
    fixed = torch.zeros_like(graph.camera.params)
    focal, center = fixed.clone(), fixed.clone()
    focal[:2], center[2] = 1.0, 1.0
    still = torch.zeros_like(noise)
    return [
        ("fx and fy, by 1 px", still, focal, 1e-2),
        ("cx, by 1 px", still, center, 1e-2),
        ("all keypoints, at random by 1 px", noise, fixed, 1e-4),
        ("the keypoints of one frame, at random by 1 px", one_frame, fixed, 1e-2),
    ]


def draw(graph: ObservationGraph, solution: GraphSolution, pixels: Tensor, file: Path) -> None:
    """Plot the map from above, colored by the gradient, and the distribution of the gradient over keypoints."""
    import matplotlib.pyplot as plt

    plt.switch_backend("Agg")
    strength = pixels.norm(dim=-1)
    by_point = torch.zeros(len(graph.points_w), dtype=strength.dtype).index_add(
        0, graph.point_index, strength
    )
    figure, (above, shares) = plt.subplots(1, 2, figsize=(11, 4.6), gridspec_kw={"width_ratios": (1.5, 1)})
    points, path = solution.points_w.detach(), solution.trajectory.positions_w.detach()
    order = torch.argsort(by_point)
    low, high = by_point[by_point > 0].quantile(torch.tensor([0.05, 0.995], dtype=by_point.dtype)).tolist()
    scatter = above.scatter(
        points[order, 0], points[order, 2], c=1e3 * by_point[order].clamp(low, high), s=6, cmap="viridis", norm="log"
    )  # fmt: skip
    above.plot(path[:, 0], path[:, 2], color="crimson", linewidth=1, label="camera")
    middle, reach = points.median(0).values, 2.5 * (points - points.median(0).values).abs().median(0).values
    above.set_xlim(*sorted((float(middle[0] - 2 * reach[0]), float(middle[0] + 2 * reach[0]))))
    above.set_ylim(float(min(path[:, 2].min(), middle[2] - reach[2])) - 0.2, float(middle[2] + 2 * reach[2]))
    above.set_xlabel("x (units of the map)")
    above.set_ylabel("z (units of the map)")
    above.set_title("Points of the map from above")
    above.legend(loc="upper right")
    figure.colorbar(scatter, ax=above, label="change of the ATE (mm) per pixel")
    sorted_strength = strength.sort(descending=True).values
    share = sorted_strength.cumsum(0) / sorted_strength.sum()
    percent = 100 * torch.arange(1, len(share) + 1) / len(share)
    half = int((share < 0.5).sum())
    shares.plot(percent, 100 * share)
    shares.plot(percent[half], 50, "o", color="crimson")
    shares.annotate(
        f"{percent[half]:.1f} % carry half",
        (float(percent[half]), 50),
        xytext=(12, -4),
        textcoords="offset points",
    )
    shares.set_xlabel("keypoints, those that matter most first (%)")
    shares.set_ylabel("share of the gradient (%)")
    shares.set_title(f"{len(share)} keypoints")
    shares.grid(alpha=0.3)
    figure.tight_layout()
    file.parent.mkdir(exist_ok=True)
    figure.savefig(file, dpi=110)
    plt.close(figure)


def cost_rows(name: str, repetitions: int) -> list[list[str]]:
    """Rows of time and memory, both also relative to one global bundle adjustment from a disturbed start."""
    far, near, both = (measured(measure, name, repetitions) for measure in MEASURES)

    def row(label: str, iterations: str, seconds: float, mib: float) -> list[str]:
        shares = f"{seconds / far['adjust']:.2f}", f"{mib / far['mib']:.2f}"
        return [label, iterations, f"{seconds:.2f}", shares[0], f"{mib:.0f}", shares[1]]

    return [
        row("global bundle adjustment from a disturbed start", f"{far['iterations']:.0f}", far["adjust"], far["mib"]),
        row("the same from the run's own solution", f"{near['iterations']:.0f}", near["adjust"], near["mib"]),
        row("backward of the ATE alone", "", both["backward"], both["mib"]),
        row("the last two together", f"{both['iterations']:.0f}", both["adjust"] + both["backward"], both["mib"]),
    ]  # fmt: skip


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("name", nargs="?", default="redkitchen")
    parser.add_argument("--repetitions", type=int, default=3)
    parser.add_argument("--measure", choices=MEASURES, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    for sequence in sequences([arguments.name]):
        if arguments.measure:
            print(json.dumps(measure(arguments.measure, sequence)))
            return
        graph = graph_of(sequence)
        T_cw, known = truth_of(graph, sequence)
        solution, loss, pixels, params = differentiate(graph, T_cw, known)
        draw(graph, solution, pixels, HERE / "pictures" / f"{arguments.name}.png")
        counts = (
            f"{len(graph.T_cw)} frames, {int(graph.is_keyframe.sum())} of them keyframes, "
            f"{len(graph.points_w)} points, {len(graph.pixels)} observations; ATE {loss.item():.4f} m.\n\n"
        )
        rows = cost_rows(arguments.name, arguments.repetitions)
        cost = table(" | iterations | seconds | relative | memory (MiB) | relative", rows)
        print(counts + cost, flush=True)
        checks = check(graph, T_cw, known, pixels, params, directions(graph))
        write_between(HERE / "README.md", counts + cost + "\n" + checks)


if __name__ == "__main__":
    main()
