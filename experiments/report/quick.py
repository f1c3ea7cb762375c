"""The benchmarks that take seconds: of each what it costs (`ms`, of the processor) and, where there is one, its error.

`make benchmarks` compares with peers; these are the same problems without peers.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from statistics import median
from typing import Any

import torch

from experiments.benchmarks.bundle import WINDOWS, batch_of, loss_of, ring, rmse, window
from experiments.benchmarks.pose_graph import drift, loop
from torchslam.data import open_sequence
from torchslam.features import ORB, match
from torchslam.optim import bundle_adjust, pose_graph_optimize

ROUNDS = 5


def milliseconds(task: Callable[[], Any], rounds: int = ROUNDS) -> float:
    """Median CPU time of the process, after one round that does not count."""
    taken = []
    for _ in range(rounds + 1):
        begin = time.process_time()
        task()
        taken.append(1e3 * (time.process_time() - begin))
    return round(median(taken[1:]), 2)


def bundle() -> dict[str, float]:
    """100 cameras, 3500 points, 43,000 observations."""
    problem = ring()
    solution = bundle_adjust(problem, "none", backward="detached")
    reached = rmse(replace(problem, T_cw=solution.T_cw, points_w=solution.points_w))
    spent = milliseconds(lambda: bundle_adjust(problem, "none", backward="detached"), 3)
    return {"error": round(reached, 6), "ms": spent}


def bundle_gradient() -> dict[str, float]:
    """The gradient of the same to all pixels."""
    problem = ring()
    pixels = problem.pixels.clone().requires_grad_()
    loss = loss_of(bundle_adjust(replace(problem, pixels=pixels), "none"))
    return {"ms": milliseconds(lambda: loss.backward(retain_graph=True), 3)}


def windows() -> dict[str, float]:
    """64 windows of 8 frames and 200 points in one call."""
    batch = batch_of([window(seed) for seed in range(WINDOWS)])
    return {"ms": milliseconds(lambda: bundle_adjust(batch, scale=2.45, backward="detached"), 3)}


def pose_graph() -> dict[str, float]:
    """A loop of 1000 nodes, each joined with the next three, that loses half of its scale."""
    problem = loop(1000, 3)
    solved = pose_graph_optimize(problem.graph, kernel="none")
    spent = milliseconds(lambda: pose_graph_optimize(problem.graph, kernel="none", backward="detached"), 3)
    return {"error": round(drift(problem, solved.S_cw), 6), "ms": spent}


def features() -> dict[str, float]:
    """1000 ORB keypoints of a rendered image of 640x480."""
    image, extract = open_sequence("synthetic:room").image(0), ORB(1000)
    with torch.inference_mode():
        return {"ms": milliseconds(lambda: extract(image))}


def matching() -> dict[str, float]:
    """Those of two such images with each other."""
    sequence, extract = open_sequence("synthetic:room"), ORB(1000)
    with torch.inference_mode():
        one, other = extract(sequence.image(0)), extract(sequence.image(1))
        return {"ms": milliseconds(lambda: match(one, other))}


BENCHMARKS: dict[str, Callable[[], dict[str, float]]] = {
    benchmark.__name__: benchmark
    for benchmark in (bundle, bundle_gradient, windows, pose_graph, features, matching)
}
