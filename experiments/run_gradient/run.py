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
from typing import NamedTuple

import torch
from torch import Tensor

from experiments.common import parser_of, sequences, table, write_between
from torchslam.config import load_config
from torchslam.data.sequence import GROUNDTRUTH_TOLERANCE, Sequence
from torchslam.data.trajectories import interpolate_poses
from torchslam.evaluation import ate
from torchslam.geometry import se3_exp, se3_inverse
from torchslam.optim import GRAPH_OPTIONS
from torchslam.optim.observation_graph import ObservationGraph
from torchslam.optim.run_graph import GraphSolution, solve_graph
from torchslam.system.slam import SLAM

HERE = Path(__file__).parent
RESULTS = HERE / "results"
EXACT = GRAPH_OPTIONS.replace(tolerance=0.0, iterations=12)
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


class Inputs(NamedTuple):
    """What the gradient of a run reaches: a value of each, a derivative by each, or a direction of change.

    Attributes:
        pixels: (O, 2).
        weights: (O,) or (O, 2, 2).
        params: of the given camera.
        readout: of the rolling shutter, seconds; not used without one.
    """

    pixels: Tensor
    weights: Tensor
    params: Tensor
    readout: Tensor

    @classmethod
    def of(cls, graph: ObservationGraph) -> Inputs:
        given = graph.camera if graph.calibration is None else graph.calibration.camera
        readout = graph.pixels.new_zeros(()) if graph.readout is None else graph.readout.seconds
        return cls(graph.pixels, graph.weights, given.params, readout)

    def zeros(self) -> Inputs:
        return Inputs(*map(torch.zeros_like, self))

    def leaves(self) -> Inputs:
        return Inputs(*(each.clone().requires_grad_() for each in self))

    def moved(self, along: Inputs, step: float) -> Inputs:
        return Inputs(*(each + step * change for each, change in zip(self, along, strict=True)))

    def put_into(self, graph: ObservationGraph) -> ObservationGraph:
        """The graph with these inputs."""
        camera, calibration, readout = graph.camera, graph.calibration, graph.readout
        if calibration is None or not calibration.directions.numel():  # else the camera is found
            camera = camera.with_params(self.params)
        if calibration is not None:
            calibration = replace(calibration, camera=calibration.camera.with_params(self.params))
        if readout is not None:
            readout = replace(readout, seconds=self.readout)
        return replace(
            graph,
            pixels=self.pixels, weights=self.weights, camera=camera, calibration=calibration, readout=readout,
        )  # fmt: skip


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
        solution = solve_graph(Inputs.of(graph).leaves().put_into(graph))
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


class Direction(NamedTuple):
    """A change of the inputs, and the step of the differences along it."""

    name: str
    along: Inputs
    step: float


def differentiate(
    graph: ObservationGraph, T_cw: Tensor, known: Tensor
) -> tuple[GraphSolution, Tensor, Inputs]:
    """Solve the graph; return the solution, its ATE in meters, and the gradient of that to each input."""
    leaves = Inputs.of(graph).leaves()
    solution = solve_graph(leaves.put_into(graph), options=EXACT)
    loss = ate(T_cw=solution.T_cw[known], T_cw_groundtruth=T_cw[known])
    return solution, loss, Inputs(*torch.autograd.grad(loss, leaves, materialize_grads=True))


def check(
    graph: ObservationGraph, T_cw: Tensor, known: Tensor, gradient: Inputs, directions: list[Direction]
) -> str:
    """A table of derivatives along directions: by the gradient, by central differences."""
    inputs = Inputs.of(graph)

    @torch.no_grad()
    def error_m(moved: Inputs) -> float:
        solution = solve_graph(moved.put_into(graph), options=EXACT)
        return float(ate(T_cw=solution.T_cw[known], T_cw_groundtruth=T_cw[known]))

    rows = []
    for name, along, step in directions:
        analytic = sum(float((g * d).sum()) for g, d in zip(gradient, along, strict=True))
        ahead, behind = (error_m(inputs.moved(along, sign * step)) for sign in (1, -1))
        numeric = (ahead - behind) / (2 * step)
        off = abs(analytic - numeric) / abs(numeric) if numeric else abs(analytic)  # a held camera has none
        rows.append([name, f"{1e3 * analytic:.6g}", f"{1e3 * numeric:.6g}", f"{off:.1e}"])
        print(*rows[-1], sep="\t", flush=True)
    return table("direction | gradient (mm) | central differences (mm) | relative error", rows)


def directions(graph: ObservationGraph) -> list[Direction]:
    """Changes of the camera, of the keypoints, of the weights, and of the readout where there is one."""
    generator = torch.Generator().manual_seed(1)
    still = Inputs.of(graph).zeros()
    noise = torch.randn(graph.pixels.shape, generator=generator, dtype=graph.pixels.dtype)
    one_frame = noise * (graph.frame_index == len(graph.T_cw) // 2)[:, None]
    focal, center = still.params.clone(), still.params.clone()
    focal[:2], center[2] = 1.0, 1.0
    factors = 0.1 * noise[:, 0].reshape(-1, *[1] * (graph.weights.ndim - 1))
    found = [
        Direction("given fx and fy, by 1 px", still._replace(params=focal), 1e-2),
        Direction("given cx, by 1 px", still._replace(params=center), 1e-2),
        Direction("all keypoints, at random by 1 px", still._replace(pixels=noise), 1e-4),
        Direction("the keypoints of one frame, at random by 1 px", still._replace(pixels=one_frame), 1e-2),
        Direction("all weights, at random by 10 %", still._replace(weights=factors * graph.weights), 1e-3),
    ]
    if graph.readout is not None:
        shutter = torch.full_like(still.readout, 1e-3)
        found.append(Direction("readout, by 1 ms", still._replace(readout=shutter), 1e-1))
    return found


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
    parser = parser_of(__doc__, readme=True)
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
        solution, loss, gradient = differentiate(graph, T_cw, known)
        counts = (
            f"{len(graph.T_cw)} frames, {int(graph.is_keyframe.sum())} of them keyframes, "
            f"{len(graph.points_w)} points, {len(graph.pixels)} observations; ATE {loss.item():.4f} m.\n\n"
        )
        rows = cost_rows(arguments.name, arguments.repetitions)
        cost = table(" | iterations | seconds | relative | memory (MiB) | relative", rows)
        print(counts + cost, flush=True)
        checks = check(graph, T_cw, known, gradient, directions(graph))
        if not arguments.no_readme:
            draw(graph, solution, gradient.pixels, HERE / "pictures" / f"{arguments.name}.png")
            write_between(HERE / "README.md", counts + cost + "\n" + checks)


if __name__ == "__main__":
    main()
