"""Increments of an inertial sensor."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.autograd import gradcheck

from torchslam.geometry import (
    Increments,
    InertialSteps,
    compose_increments,
    inertial_steps,
    preintegrate,
    so3_exp,
    so3_log,
    with_bias_change,
)
from torchslam.geometry.lie import so3_double_integral

DENSITIES = (1e-3, 2e-2)


def steps(batch: int, count: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> InertialSteps:
    generator = torch.Generator().manual_seed(seed)
    durations = 0.004 + 0.002 * torch.rand(batch, count, generator=generator, dtype=dtype)
    gyroscope, accelerometer = torch.randn(2, batch, count, 3, generator=generator, dtype=dtype)
    return InertialSteps(durations, gyroscope, 5 * accelerometer + torch.tensor([0.0, 0.0, 9.8], dtype=dtype))


def integrate(steps: InertialSteps, bias: Tensor) -> Increments:
    return preintegrate(steps, bias, *DENSITIES)


def test_constant_acceleration() -> None:
    constant = InertialSteps(
        torch.full((1, 20), 0.05, dtype=torch.float64),
        torch.zeros(1, 20, 3).double(),
        torch.tensor([1.0, -2.0, 3.0]).double().expand(1, 20, 3),
    )
    found = integrate(constant, torch.zeros(6).double())
    torch.testing.assert_close(found.duration, torch.ones(1).double())
    torch.testing.assert_close(found.R_ij[0], torch.eye(3).double())
    torch.testing.assert_close(found.velocity[0], torch.tensor([1.0, -2.0, 3.0]).double())
    torch.testing.assert_close(found.position[0], torch.tensor([0.5, -1.0, 1.5]).double())


def test_a_circle() -> None:
    """A body that turns about z and is pulled to the center of a circle comes back to where it was."""
    radius, speed = 2.0, 0.5
    rate = speed / radius
    count = 64
    circle = InertialSteps(
        torch.full((1, count), 2 * math.pi / rate / count, dtype=torch.float64),
        torch.tensor([0.0, 0.0, rate], dtype=torch.float64).expand(1, count, 3),
        torch.tensor([0.0, speed * rate, 0.0], dtype=torch.float64).expand(1, count, 3),
    )
    found = integrate(circle, torch.zeros(6).double())
    start = torch.tensor([speed, 0.0, 0.0], dtype=torch.float64)
    torch.testing.assert_close(found.R_ij[0], torch.eye(3).double(), atol=1e-12, rtol=0)
    torch.testing.assert_close(found.velocity[0], torch.zeros(3).double(), atol=1e-12, rtol=0)
    torch.testing.assert_close(
        found.position[0] + start * found.duration, torch.zeros(3).double(), atol=1e-11, rtol=0
    )


@pytest.mark.parametrize("angle", [0.0, 1e-5, 0.4, 0.6, 3.0])
def test_double_integral_of_a_rotation(angle: float) -> None:
    omega = angle * torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    nodes = (torch.arange(4000, dtype=torch.float64) + 0.5) / 4000
    expected = ((1 - nodes)[:, None, None] * so3_exp(nodes[:, None] * omega)).mean(0)
    torch.testing.assert_close(so3_double_integral(omega), expected, atol=1e-7, rtol=0)


@given(st.integers(1, 9), st.integers(1, 9), st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_intervals_compose(first: int, second: int, seed: int) -> None:
    data, bias = steps(2, first + second, seed), torch.zeros(6).double()
    whole = integrate(data, bias)
    parts = [InertialSteps(*(x[:, part] for x in data)) for part in (slice(first), slice(first, None))]
    for part, expected in zip(
        compose_increments(*(integrate(each, bias) for each in parts)), whole, strict=True
    ):
        torch.testing.assert_close(part, expected, atol=1e-13, rtol=1e-12)


def errors(changed: Increments, base: Increments) -> Tensor:
    turn = so3_log(changed.R_ij @ base.R_ij.mT)
    return torch.cat((changed.position - base.position, changed.velocity - base.velocity, turn), dim=-1)


def test_jacobian_in_the_biases() -> None:
    data, bias = steps(1, 20), torch.zeros(6).double()
    base = integrate(data, bias)
    expected = torch.func.jacfwd(lambda bias: errors(integrate(data, bias), base)[0])(bias)
    torch.testing.assert_close(base.jacobian[0], expected, atol=1e-8, rtol=1e-6)
    change = 1e-3 * torch.ones(6, dtype=torch.float64)
    moved, again = with_bias_change(base, change), integrate(data, bias + change)
    assert float(errors(moved, again).norm()) < 1e-2 * float(errors(base, again).norm())


def test_covariance_is_that_of_noisy_samples() -> None:
    generator = torch.Generator().manual_seed(3)
    data, bias, trials = steps(1, 12), torch.zeros(6).double(), 4000
    noisy = [
        x
        + density
        * torch.randn(trials, 12, 3, generator=generator).double()
        / data.durations[..., None].sqrt()
        for x, density in zip(data[1:], DENSITIES, strict=True)
    ]
    base = integrate(data, bias)
    found = errors(integrate(InertialSteps(data.durations.expand(trials, 12), *noisy), bias), base)
    expected = base.covariance[0]
    scale = expected.diagonal().sqrt()
    torch.testing.assert_close(
        found.T.cov() / scale / scale[:, None], expected / scale / scale[:, None], atol=0.06, rtol=0
    )


def test_gradients() -> None:
    data = steps(2, 3)
    bias = torch.tensor([0.02, -0.01, 0.03, 0.1, -0.2, 0.05]).double()

    def function(
        durations: Tensor, gyroscope: Tensor, accelerometer: Tensor, bias: Tensor
    ) -> tuple[Tensor, ...]:
        found = integrate(InertialSteps(durations, gyroscope, accelerometer), bias)
        return tuple(with_bias_change(found, 0.1 * bias))

    inputs = tuple(x.clone().requires_grad_() for x in (*data, bias))
    assert gradcheck(function, inputs, atol=1e-6)


def samples() -> tuple[Tensor, Tensor, Tensor]:
    times = torch.arange(0, 1, 0.01, dtype=torch.float64)
    return times, torch.stack((times, 2 * times, -times), -1), torch.stack((times, 0 * times, 1 + times), -1)


def test_steps_between_two_times() -> None:
    times, gyroscope, accelerometer = samples()
    start, end = torch.tensor([0.1, 0.205, 0.5]).double(), torch.tensor([0.2, 0.3071, 0.5]).double()
    found = inertial_steps(times, gyroscope, accelerometer, start, end)
    torch.testing.assert_close(found.durations.sum(-1), end - start)
    # the integral of a rate that grows linearly
    torch.testing.assert_close((found.durations * found.gyroscope[..., 1]).sum(-1), end**2 - start**2)
    assert (found.durations >= 0).all()


def test_gradients_of_steps() -> None:
    times, gyroscope, accelerometer = samples()
    start, end = torch.tensor([0.103, 0.205]).double(), torch.tensor([0.151, 0.222]).double()
    inputs = tuple(x.clone().requires_grad_() for x in (gyroscope, accelerometer, start, end))
    assert gradcheck(lambda g, a, s, e: tuple(inertial_steps(times, g, a, s, e)), inputs)


def test_agrees_with_gtsam() -> None:
    """Increments, their covariances, and what a change of the biases makes of them; GTSAM gets small steps."""
    gtsam = pytest.importorskip("gtsam")
    data, parts = steps(1, 40), 50
    bias, change = torch.tensor([0.02, -0.01, 0.03, 0.1, -0.2, 0.05], dtype=torch.float64), 1e-3

    def constant(bias: Tensor) -> object:
        return gtsam.imuBias.ConstantBias(bias[3:].numpy(), bias[:3].numpy())

    params = gtsam.PreintegrationParams.MakeSharedU(0.0)
    params.setGyroscopeCovariance(DENSITIES[0] ** 2 * torch.eye(3).double().numpy())
    params.setAccelerometerCovariance(DENSITIES[1] ** 2 * torch.eye(3).double().numpy())
    params.setIntegrationCovariance(torch.zeros(3, 3).double().numpy())
    theirs = gtsam.PreintegratedImuMeasurements(params, constant(bias))
    for dt, rate, force in zip(*(x[0].numpy() for x in data), strict=True):
        for _ in range(parts):
            theirs.integrateMeasurement(force, rate, float(dt) / parts)

    ours = integrate(data, bias)
    for moved, found in ((0.0, ours), (change, with_bias_change(ours, torch.full((6,), change).double()))):
        state = theirs.predict(gtsam.NavState(), constant(bias + moved))
        expected = (state.attitude().matrix(), state.velocity(), state.position())
        for part, other in zip(found[1:4], expected, strict=True):
            torch.testing.assert_close(part[0], torch.from_numpy(other.copy()), atol=5e-5, rtol=0)
    order = torch.tensor([3, 4, 5, 6, 7, 8, 0, 1, 2])  # theirs are rotation, position, velocity
    covariance = torch.from_numpy(theirs.preintMeasCov())[order][:, order]
    scale = covariance.diagonal().sqrt()
    scaled = [x / scale / scale[:, None] for x in (ours.covariance[0], covariance)]
    torch.testing.assert_close(*scaled, atol=0.02, rtol=0)
