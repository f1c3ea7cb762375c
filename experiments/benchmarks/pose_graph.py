"""Speed and accuracy of pose graph optimization compared with GTSAM, in one run on one thread.

    python -m experiments.benchmarks.pose_graph [--output FILE]

A loop of poses whose odometry is noisy and loses scale, with edges to the next few nodes and where the loop closes.
Prints a table and writes it to FILE.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from experiments.common import gradient_error, milliseconds, parser_of, publish_page, table
from torchslam.geometry import rigid, sim3_exp, sim3_inverse, sim3_log, sim3_scale, so3_exp
from torchslam.optim import POSE_GRAPH_OPTIONS, PoseGraph, solve_pose_graph

HERE = Path(__file__).parent
RADIUS = 20.0
# Translation, rotation (radians), log scale of one edge; and what the odometry loses of the scale over the loop.
SIGMAS = torch.tensor([0.01] * 3 + [0.003] * 3 + [0.003], dtype=torch.float64)
SCALE_DRIFT = math.log(2.0)
CLOSURES = 10


class Problem(NamedTuple):
    """A graph, and the truth (K, 4, 4)."""

    graph: PoseGraph
    S_cw: Tensor


def loop(nodes: int, neighbors: int, seed: int = 0) -> Problem:
    """A circular walk, every node joined with the next `neighbors`, the last ones with the first."""
    generator = torch.Generator().manual_seed(seed)
    angle = torch.arange(nodes, dtype=torch.float64) * (2 * math.pi / nodes)
    zero = torch.zeros_like(angle)
    center = RADIUS * torch.stack((angle.sin(), 0.02 * (5 * angle).sin(), angle.cos()), dim=-1)
    S_cw = sim3_inverse(rigid(so3_exp(torch.stack((zero, angle, zero), dim=-1)), center))
    pairs = [(k, k + d) for d in range(1, neighbors + 1) for k in range(nodes - d)]
    closures = [(nodes - 1 - k, k) for k in range(CLOSURES)]
    edges = torch.tensor(pairs + closures)
    noise = SIGMAS * torch.randn(len(edges), 7, generator=generator, dtype=torch.float64)
    noise[: len(pairs), 6] -= SCALE_DRIFT / nodes * (edges[: len(pairs), 1] - edges[: len(pairs), 0])
    S_ji = sim3_exp(noise) @ S_cw[edges[:, 1]] @ sim3_inverse(S_cw[edges[:, 0]])
    start = [S_cw[0]]
    for odometry in S_ji[: nodes - 1]:
        start.append(odometry @ start[-1])
    information = torch.diag(SIGMAS**-2).expand(len(edges), 7, 7)
    return Problem(PoseGraph(torch.stack(start), edges, S_ji, information), S_cw)


def cost(graph: PoseGraph, S_cw: Tensor) -> float:
    """Half the sum of squared whitened errors."""
    i, j = graph.edges.unbind(-1)
    errors = sim3_log(S_cw[j] @ sim3_inverse(S_cw[i]) @ sim3_inverse(graph.S_ji)) / SIGMAS
    return float(0.5 * errors.square().sum())


def drift(problem: Problem, S_cw: Tensor) -> float:
    """Root mean square distance of the camera centers from the truth, in units of the truth."""
    found, truth = (sim3_inverse(S)[:, :3, 3] for S in (S_cw, problem.S_cw))
    return float((found - truth).square().sum(-1).mean().sqrt())


class Peer(NamedTuple):
    """GTSAM's answer (K, 4, 4), its time in the optimizer and its iterations."""

    S_cw: Tensor
    solve_ms: float
    iterations: int


def gtsam_solve(graph: PoseGraph) -> Peer:
    """The same graph by GTSAM's Levenberg-Marquardt, with the tolerance of ours, one thread."""
    import gtsam

    def element(S_wc: Tensor) -> Any:
        s = float(sim3_scale(S_wc))
        return gtsam.Similarity3(gtsam.Rot3((S_wc[:3, :3] / s).numpy()), (S_wc[:3, 3] / s).numpy(), s)

    noise = gtsam.noiseModel.Diagonal.Sigmas(SIGMAS[[3, 4, 5, 0, 1, 2, 6]].numpy())
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for (i, j), S_ij in zip(graph.edges.tolist(), sim3_inverse(graph.S_ji), strict=True):
        factors.add(gtsam.BetweenFactorSimilarity3(i, j, element(S_ij), noise))
    for node, S_wc in enumerate(sim3_inverse(graph.S_cw)):
        values.insert(node, element(S_wc))
    anchor = gtsam.noiseModel.Isotropic.Sigma(7, 1e-6)
    factors.add(gtsam.PriorFactorSimilarity3(0, values.atSimilarity3(0), anchor))
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-8)
    begin = time.process_time()
    optimizer = gtsam.LevenbergMarquardtOptimizer(factors, values, params)
    found = optimizer.optimize()
    elapsed = 1e3 * (time.process_time() - begin)
    S_wc = torch.stack(
        [torch.from_numpy(found.atSimilarity3(node).matrix()) for node in range(len(graph.S_cw))]
    )
    return Peer(sim3_inverse(S_wc / S_wc[:, 3:, 3:]), elapsed, optimizer.iterations())


def row(nodes: int, neighbors: int, repeats: int) -> list[str]:
    """One line of the table."""
    problem = loop(nodes, neighbors)
    graph = problem.graph
    S_ji = graph.S_ji.clone().requires_grad_()

    def backward() -> float:
        loss = solve_pose_graph(
            replace(graph, S_ji=S_ji), options=POSE_GRAPH_OPTIONS.replace(kernel="none")
        ).S_cw.sum()
        begin = time.process_time()
        loss.backward()
        return 1e3 * (time.process_time() - begin)

    tasks: list[Callable[[], Any]] = [
        lambda: solve_pose_graph(
            graph, options=POSE_GRAPH_OPTIONS.replace(kernel="none", backward="detached")
        ),
        lambda: gtsam_solve(graph).solve_ms,
        backward,
    ]
    ours_ms, peer_ms, backward_ms = milliseconds(*tasks, repeats=repeats)
    ours, peer = (
        solve_pose_graph(graph, options=POSE_GRAPH_OPTIONS.replace(kernel="none")),
        gtsam_solve(graph),
    )
    return [
        f"{nodes}, {len(graph.edges)}",
        f"{drift(problem, graph.S_cw):.2f}",
        f"{drift(problem, ours.S_cw):.3f} / {drift(problem, peer.S_cw):.3f}",
        f"{cost(graph, ours.S_cw):.4f} / {cost(graph, peer.S_cw):.4f}",
        f"{int(ours.convergence.iterations)} / {peer.iterations}",
        f"{ours_ms:.0f} / {peer_ms:.0f}",
        f"{ours_ms / peer_ms:.2f}",
        f"{backward_ms:.0f}",
    ]


def gradient() -> float:
    """Largest relative error of the gradient to measurements and weights, with a robust kernel."""
    graph = loop(200, 3).graph
    weights = torch.rand(len(graph.edges), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    inputs = {
        "twist": torch.zeros(len(graph.edges), 7, dtype=torch.float64),
        "weights": 1e4 * (0.5 + weights),
    }

    def loss(twist: Tensor, weights: Tensor, **options: Any) -> Tensor:
        moved = replace(graph, S_ji=sim3_exp(twist) @ graph.S_ji, information=weights)
        robust = POSE_GRAPH_OPTIONS.replace(kernel="cauchy", scale=3.0, **options)
        S_cw = solve_pose_graph(moved, options=robust).S_cw[:, :3].flatten()
        return S_cw @ torch.linspace(-1, 1, len(S_cw), dtype=torch.float64)

    exactly = partial(loss, iterations=200, tolerance=1e-26)
    return gradient_error(exactly, inputs, {"twist": 1e-7, "weights": 1e-1})


def main() -> None:
    parser = parser_of(__doc__, HERE / "pose_graph.md")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    header = (
        "nodes, edges | start, error | error, ours / GTSAM | cost, ours / GTSAM | iterations"
        " | time, ms | ratio | our backward, ms"
    )
    rows = [row(1000, 1, 7), row(1000, 4, 5), row(3000, 4, 3)]
    text = (
        "A circular walk of radius 20 whose odometry is noisy and halves the scale; the last ten "
        "nodes meet the first. Similarities, least squares, float64, one thread, median CPU time of the process, "
        "interleaved with GTSAM, both to a relative decrease of 1e-8; error: of the camera centers, root "
        "mean square.\n\n"
        "    python -m experiments.benchmarks.pose_graph\n\n"
        f"{table(header, rows)}\n"
        f"Gradient to measurements and weights (200 nodes, cauchy) against central differences: {gradient():.0e}.\n"
    )
    publish_page("Pose graphs", text, arguments)


if __name__ == "__main__":
    main()
