"""Numbers that make no sense are refused by name, in every function that takes them."""

from __future__ import annotations

import inspect
import math
from typing import Any

import pytest
import torch

from tests.sweep.calls import CAMERA, Call, calls
from torchslam.geometry import umeyama
from torchslam.optim import POSE_OPTIONS

CALLS = calls()
WRONG: dict[str, tuple[float, ...]] = {
    "threshold": (0.0, -1.0, math.nan),
    "confidence": (0.0, 1.0, 1.5, -0.1, math.nan),
    "max_samples": (0, -5),
    "min_samples": (0,),
    "depth_sigma": (-0.1,),
    "scale": (0.0, -2.0, math.nan),
    "ratio": (0.0, -0.8, math.nan),
    "temperature": (0.0, -1.0),
    "tolerance": (-1.0, math.nan),
    "delta": (0, -1),
}
CASES = [
    pytest.param(call, option, value, id=f"{name}-{option}-{value}")
    for name, call in CALLS.items()
    for option in inspect.signature(call.function).parameters
    for value in WRONG.get(option, ())
]
SOLVERS = [name for name, call in CALLS.items() if "options" in inspect.signature(call.function).parameters]


@pytest.mark.usefixtures("without_shape_checks")
@pytest.mark.parametrize(("call", "option", "value"), CASES)
def test_a_senseless_number_is_refused(call: Call, option: str, value: float) -> None:
    with pytest.raises(ValueError, match=rf"{option} must be .*{value}"):
        call.function(**{**call.arguments, option: value})


@pytest.mark.parametrize("value", WRONG["scale"])
@pytest.mark.parametrize("name", SOLVERS)
def test_a_senseless_scale_of_a_solver_is_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=rf"scale must be .*{value}"):
        CALLS[name].function(**CALLS[name].arguments, options=POSE_OPTIONS.replace(scale=value))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kernel": "l2"}, "unknown kernel 'l2'; known are none, huber"),
        ({"iterations": -1}, "iterations must not be below zero, got -1"),
        ({"tolerance": -1.0}, "tolerance must not be below zero"),
        ({"tolerance": math.nan}, "tolerance must not be below zero, got nan"),
        ({"backward": "exact"}, "unknown backward mode 'exact'"),
    ],
)
@pytest.mark.usefixtures("without_shape_checks")
def test_senseless_options_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        POSE_OPTIONS.replace(**change)


def test_a_scale_of_another_dtype_is_a_number() -> None:
    call = CALLS["solve_pose"]
    expected = call.function(**call.arguments, options=POSE_OPTIONS.replace(scale=2.0))
    found = call.function(**call.arguments, options=POSE_OPTIONS.replace(scale=torch.tensor(2.0)))
    assert torch.equal(found.T_cw, expected.T_cw)
    with pytest.raises(ValueError, match=r"scale must be above zero, not -2.0"):
        call.function(**call.arguments, options=POSE_OPTIONS.replace(scale=torch.tensor(-2.0)))


def test_weights_that_are_not_positive_do_not_count() -> None:
    points = torch.rand(9, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    target = 2 * points.roll(1, dims=1) + torch.tensor([1.0, 2.0, 3.0])
    target[:3] += 5.0
    weights = torch.ones(9, dtype=torch.float64)
    weights[:3] = torch.tensor([-1.0, torch.inf, torch.nan])
    scale, _, _ = umeyama(points, target, weights)
    assert float(scale) == pytest.approx(2.0, abs=1e-12)
    assert CAMERA.params.dtype == torch.float64
