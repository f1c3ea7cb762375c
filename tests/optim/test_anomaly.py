"""Solvers under `torch.autograd.set_detect_anomaly(True)`, which tests every backward function for NaN."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.sweep.calls import bundle, calls
from torchslam.geometry import se3_inverse
from torchslam.optim import (
    BUNDLE_OPTIONS,
    LEAST_SQUARES_OPTIONS,
    POSE_GRAPH_OPTIONS,
    POSE_OPTIONS,
    ROTATION_OPTIONS,
    FrameFactors,
    PosePrior,
    solve_bundle,
    solve_least_squares,
    solve_pose,
    solve_pose_graph,
    solve_rotations,
)
from torchslam.optim._core.implicit import Backward

MODES = ("implicit", "unroll", "truncated")


def refined(mode: Backward, leaf: Tensor) -> tuple[Tensor, Tensor]:
    found = solve_pose(
        **{**calls()["solve_pose"].arguments, "pixels": leaf},
        options=POSE_OPTIONS.replace(kernel="cauchy", backward=mode),
    )
    return found.T_cw, found.covariance


def adjusted(mode: Backward, leaf: Tensor) -> tuple[Tensor, Tensor]:
    problem = bundle()
    T_cw = problem.T_cw
    pairs = torch.tensor([(0, 1), (1, 2)])
    motions = T_cw[pairs[:, 1]] @ se3_inverse(T_cw[pairs[:, 0]])
    eye = torch.eye(6, dtype=torch.float64)
    problem = replace(
        problem,
        pixels=leaf,
        frame_factors=[FrameFactors.relative_poses(pairs, motions, 100 * eye.repeat(2, 1, 1))],
        pose_prior=PosePrior(T_cw, 0.1 * eye.repeat(3, 1, 1)),
    )
    steps = 4 if mode == "unroll" else 50
    found = solve_bundle(
        problem, free_camera=True, options=BUNDLE_OPTIONS.replace(iterations=steps, backward=mode)
    )
    return found.T_cw, found.covariance().frames


def averaged(mode: Backward, leaf: Tensor) -> tuple[Tensor, Tensor]:
    found = solve_rotations(
        **{**calls()["solve_rotations"].arguments, "R_ji": leaf},
        options=ROTATION_OPTIONS.replace(backward=mode),
    )
    return found.R_cw, found.angles


def optimized(mode: Backward, leaf: Tensor) -> tuple[Tensor, Tensor]:
    found = solve_pose_graph(
        replace(calls()["solve_pose_graph"].arguments["graph"], S_ji=leaf),
        options=POSE_GRAPH_OPTIONS.replace(backward=mode),
    )
    return found.S_cw, found.cost


def fitted(mode: Backward, leaf: Tensor) -> tuple[Tensor, Tensor]:
    arguments = calls()["solve_least_squares"].arguments
    found = solve_least_squares(
        **{**arguments, "inputs": (leaf, arguments["inputs"][1])},
        options=LEAST_SQUARES_OPTIONS.replace(backward=mode),
    )
    return found.unknowns[0], found.cost


SOLVERS = {
    "solve_pose": (refined, calls()["solve_pose"].arguments["pixels"]),
    "solve_bundle": (adjusted, bundle().pixels),
    "solve_rotations": (averaged, calls()["solve_rotations"].arguments["R_ji"]),
    "solve_pose_graph": (optimized, calls()["solve_pose_graph"].arguments["graph"].S_ji),
    "solve_least_squares": (fitted, calls()["solve_least_squares"].arguments["inputs"][0]),
}


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("name", SOLVERS)
def test_gradients_and_covariances_are_the_same(name: str, mode: Backward) -> None:
    solve, data = SOLVERS[name]
    results: list[tuple[Tensor, ...]] = []
    for is_detected in (False, True):
        leaf = data.clone().requires_grad_()
        with torch.autograd.set_detect_anomaly(is_detected):
            found, other = solve(mode, leaf)
            weights = torch.linspace(1, 2, found.numel(), dtype=torch.float64).view_as(found)
            (gradient,) = torch.autograd.grad((weights * found).sum(), leaf, create_graph=mode == "implicit")
            second = gradient
            if mode == "implicit":
                (second,) = torch.autograd.grad(gradient.square().sum(), leaf)
        results.append((found, other, gradient, second))
    for plain, detected in zip(*results, strict=True):
        torch.testing.assert_close(plain, detected, rtol=1e-9, atol=1e-12)
    assert results[1][2].abs().sum() > 0


@pytest.mark.filterwarnings("ignore:Error detected")
def test_an_anomaly_in_the_loss_is_still_found() -> None:
    leaf = SOLVERS["solve_pose"][1].clone().requires_grad_()
    with torch.autograd.set_detect_anomaly(True):
        found, _ = refined("implicit", leaf)
        zero = (found - found.detach()).sum()
        with pytest.raises(RuntimeError, match="returned nan"):
            (zero * zero).sqrt().backward()
    assert not torch.is_anomaly_enabled()
