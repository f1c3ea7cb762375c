"""The benchmarks that take seconds: the processor time (`ms`) of each and, if there is one, its error.

`make benchmarks` compares with peers; these are the same problems without peers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch

from experiments.benchmarks.bundle import WINDOWS, batch_of, loss_of, ring, rmse, window
from experiments.benchmarks.pose_graph import drift, loop
from experiments.common import milliseconds
from torchslam.data import open_sequence
from torchslam.features import ORB, match
from torchslam.optim import BUNDLE_OPTIONS, POSE_GRAPH_OPTIONS, solve_bundle, solve_pose_graph

ROUNDS = 5


def spent(task: Callable[[], Any], rounds: int = ROUNDS) -> float:
    """Median processor time, ms."""
    return round(milliseconds(task, repeats=rounds)[0], 2)


def bundle() -> dict[str, float]:
    """100 cameras, 3500 points, 43,000 observations."""
    problem = ring()
    solution = solve_bundle(problem, options=BUNDLE_OPTIONS.replace(kernel="none", backward="detached"))
    reached = rmse(replace(problem, T_cw=solution.T_cw, points_w=solution.points_w))
    return {
        "error": round(reached, 6),
        "ms": spent(
            lambda: solve_bundle(problem, options=BUNDLE_OPTIONS.replace(kernel="none", backward="detached")),
            3,
        ),
    }


def bundle_gradient() -> dict[str, float]:
    """The gradient of that problem to all pixels."""
    problem = ring()
    pixels = problem.pixels.clone().requires_grad_()
    loss = loss_of(
        solve_bundle(replace(problem, pixels=pixels), options=BUNDLE_OPTIONS.replace(kernel="none"))
    )
    return {"ms": spent(lambda: loss.backward(retain_graph=True), 3)}


def windows() -> dict[str, float]:
    """64 windows of 8 frames and 200 points in one call."""
    batch = batch_of([window(seed) for seed in range(WINDOWS)])
    return {
        "ms": spent(
            lambda: solve_bundle(batch, options=BUNDLE_OPTIONS.replace(scale=2.45, backward="detached")), 3
        )
    }


def pose_graph() -> dict[str, float]:
    """A loop of 1000 nodes, each joined with the next three, that loses half of its scale."""
    problem = loop(1000, 3)
    solved = solve_pose_graph(problem.graph, options=POSE_GRAPH_OPTIONS.replace(kernel="none"))
    ms = spent(
        lambda: solve_pose_graph(
            problem.graph, options=POSE_GRAPH_OPTIONS.replace(kernel="none", backward="detached")
        ),
        3,
    )
    return {"error": round(drift(problem, solved.S_cw), 6), "ms": ms}


def features() -> dict[str, float]:
    """1000 ORB keypoints of a rendered image of 640x480."""
    image, extract = open_sequence("synthetic:room").image(0), ORB(1000)
    with torch.inference_mode():
        return {"ms": spent(lambda: extract(image))}


def matching() -> dict[str, float]:
    """Match the keypoints of two such images."""
    sequence, extract = open_sequence("synthetic:room"), ORB(1000)
    with torch.inference_mode():
        one, other = extract(sequence.image(0)), extract(sequence.image(1))
        return {"ms": spent(lambda: match(one, other))}


BENCHMARKS: dict[str, Callable[[], dict[str, float]]] = {
    benchmark.__name__: benchmark
    for benchmark in (bundle, bundle_gradient, windows, pose_graph, features, matching)
}
