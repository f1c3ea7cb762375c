"""All solvers: under `torch.autograd.set_detect_anomaly(True)`, which tests every backward function for NaN, and by
dtype and device."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.sweep.calls import bundle, calls
from tests.sweep.test_sweep import SOLVERS, changed, leaves, mapped
from torchslam import optim
from torchslam.geometry import se3_inverse
from torchslam.optim._core.implicit import Backward

OPTIONS = {
    "solve_pose": optim.POSE_OPTIONS.replace(kernel="cauchy"),
    "solve_bundle": optim.BUNDLE_OPTIONS.replace(iterations=50),
    "solve_rotations": optim.ROTATION_OPTIONS,
    "solve_pose_graph": optim.POSE_GRAPH_OPTIONS,
    "solve_least_squares": optim.LEAST_SQUARES_OPTIONS,
}
DATA: dict[str, tuple[Any, ...]] = {
    "solve_pose": ("pixels",),
    "solve_bundle": ("problem", "pixels"),
    "solve_rotations": ("R_ji",),
    "solve_pose_graph": ("graph", "S_ji"),
    "solve_least_squares": ("inputs", 0),
}
"""Where the arguments have what the gradient is taken to."""


def arguments_of(name: str) -> dict[str, Any]:
    """Of the bundle adjustment with a free camera, factors and a prior."""
    if name != "solve_bundle":
        return calls()[name].arguments
    problem, pairs, eye = bundle(), torch.tensor([(0, 1), (1, 2)]), torch.eye(6, dtype=torch.float64)
    motions = problem.T_cw[pairs[:, 1]] @ se3_inverse(problem.T_cw[pairs[:, 0]])
    factors = [optim.Factors.relative_poses(pairs, motions, 100 * eye.repeat(2, 1, 1))]
    prior = optim.PosePrior(problem.T_cw, 0.1 * eye.repeat(3, 1, 1))
    return {"problem": replace(problem, factors=factors, pose_prior=prior), "free_camera": True}


def solved(name: str, arguments: dict[str, Any], mode: Backward = "implicit") -> Any:
    options = OPTIONS[name].replace(backward=mode)
    if (name, mode) == ("solve_bundle", "unroll"):
        options = options.replace(iterations=4)
    return calls()[name].function(**{**arguments, "options": options})


@pytest.mark.parametrize("mode", ["implicit", "unroll", "truncated"])
@pytest.mark.parametrize("name", SOLVERS)
def test_anomaly_detection_does_not_change_gradients_and_covariances(name: str, mode: Backward) -> None:
    arguments = arguments_of(name)
    data = dict(leaves(arguments))[DATA[name]]
    results: list[list[Tensor]] = []
    for is_detected in (False, True):
        leaf = data.clone().requires_grad_()
        with torch.autograd.set_detect_anomaly(is_detected):
            solution = solved(name, changed(arguments, DATA[name], leaf), mode)
            found = next(x for _, x in leaves(solution) if x.requires_grad)
            weights = torch.linspace(1, 2, found.numel(), dtype=torch.float64).view_as(found)
            (gradient,) = torch.autograd.grad((weights * found).sum(), leaf, create_graph=mode == "implicit")
            second = gradient
            if mode == "implicit":
                (second,) = torch.autograd.grad(gradient.square().sum(), leaf)
        covariance = getattr(solution, "covariance", found)
        covariance = covariance().frames if callable(covariance) else covariance
        results.append([found, covariance, gradient, second])
    for plain, detected in zip(*results, strict=True):
        torch.testing.assert_close(plain, detected, rtol=1e-9, atol=1e-12)
    assert results[1][2].abs().sum() > 0


@pytest.mark.filterwarnings("ignore:Error detected")
def test_an_anomaly_in_the_loss_is_still_found() -> None:
    leaf = calls()["solve_pose"].arguments["pixels"].clone().requires_grad_()
    with torch.autograd.set_detect_anomaly(True):
        found = solved("solve_pose", changed(arguments_of("solve_pose"), ("pixels",), leaf)).T_cw
        zero = (found - found.detach()).sum()
        with pytest.raises(RuntimeError, match="returned nan"):
            (zero * zero).sqrt().backward()
    assert not torch.is_anomaly_enabled()


@pytest.mark.parametrize("name", SOLVERS)
def test_dtype_and_device_come_from_the_inputs(name: str, dtype: torch.dtype, device: torch.device) -> None:
    if name == "solve_least_squares" and device.type not in ("cpu", "cuda"):
        pytest.skip("torch.func's wrappers do not reach a device written in Python")
    if device.type == "sim" and dtype == torch.float64:
        pytest.skip("single precision is the one that gets lost elsewhere")
    arguments = calls()[name].arguments
    moved = mapped(arguments, lambda x: x.to(device, dtype) if x.is_floating_point() else x.to(device))
    found, expected = solved(name, moved), solved(name, arguments)
    assert found.success.all()
    for _, tensor in leaves(found):
        assert tensor.device.type == device.type
        if tensor.is_floating_point():
            assert tensor.dtype == dtype
    first, exact = (next(x for _, x in leaves(each)) for each in (found, expected))
    torch.testing.assert_close(first.cpu().double(), exact, rtol=0, atol=1e-2)


@pytest.mark.parametrize("name", ["solve_pose", "solve_bundle", "solve_pose_graph", "solve_rotations"])
def test_backward_modes_agree_where_they_should(name: str) -> None:
    arguments = arguments_of(name)
    data, gradients = dict(leaves(arguments))[DATA[name]], {}
    modes: list[Backward] = ["implicit", "unroll", "truncated"]
    for mode in modes:
        leaf = data.clone().requires_grad_()
        options = OPTIONS[name].replace(kernel="cauchy", iterations=15, tolerance=0.0, backward=mode)
        solution = calls()[name].function(**{**changed(arguments, DATA[name], leaf), "options": options})
        found = next(x for _, x in leaves(solution) if x.requires_grad)
        weights = torch.cos(torch.arange(found.numel(), dtype=torch.float64)).view_as(found)
        (gradients[mode],) = torch.autograd.grad((weights * found).sum(), leaf)
    unroll, truncated = (
        float((gradients[mode] - gradients["implicit"]).norm() / gradients["implicit"].norm())
        for mode in ("unroll", "truncated")
    )
    assert unroll < 1e-5
    assert 1e-4 < truncated < 1
    leaf = data.clone().requires_grad_()
    detached = solved(name, changed(arguments, DATA[name], leaf), "detached")
    assert not any(x.requires_grad for _, x in leaves(detached))
