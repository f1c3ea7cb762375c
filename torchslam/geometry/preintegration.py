"""Preintegration of an inertial sensor: rotation, velocity and position increments between two times.

In the body frame at the start of an interval, without gravity, so that they need neither a pose nor a velocity. With
the body's attitude R_wb, velocity v and position p in a frame with gravity g, over a time T,

    R_wb' = R_wb R,    v' = v + g T + R_wb dv,    p' = p + v T + g T^2 / 2 + R_wb dp.

Rates and accelerations are constant within a step, for which the increments are exact. Increments compose, so that many
intervals of many steps take a few operations on all of them. Errors are [position, velocity, rotation], the rotation's
from the left; biases are [gyroscope, accelerometer].
Source: Forster et al., "On-manifold preintegration for real-time visual-inertial odometry", 2017.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.geometry.lie import skew, so3_double_integral, so3_exp, so3_left_jacobian
from torchslam.geometry.precision import full_precision
from torchslam.utils.indexing import between_rows


class Increments(NamedTuple):
    """What an inertial sensor measures over intervals.

    Attributes:
        duration: seconds.
        R_ij: from the body frame at the end to that at the start.
        velocity: change of the velocity without gravity, in the body frame at the start, m/s.
        position: the same of the position, without that of the velocity at the start, meters.
        jacobian: of errors in position, velocity and rotation with respect to the biases.
        covariance: of these errors, from white noise of the sensor.
    """

    duration: Float[Tensor, "*batch"]
    R_ij: Float[Tensor, "*batch 3 3"]
    velocity: Float[Tensor, "*batch 3"]
    position: Float[Tensor, "*batch 3"]
    jacobian: Float[Tensor, "*batch 9 6"]
    covariance: Float[Tensor, "*batch 9 9"]


class InertialSteps(NamedTuple):
    """Intervals cut into steps of constant rate and acceleration; shorter intervals end in steps of no duration.

    Attributes:
        durations: seconds.
        gyroscope: angular rates of the body, rad/s.
        accelerometer: specific forces in the body frame, m/s^2.
    """

    durations: Float[Tensor, "*batch N"]
    gyroscope: Float[Tensor, "*batch N 3"]
    accelerometer: Float[Tensor, "*batch N 3"]


@full_precision
def inertial_steps(
    timestamps: Float[Tensor, " M"],
    gyroscope: Float[Tensor, "M 3"],
    accelerometer: Float[Tensor, "M 3"],
    start: Float[Tensor, " B"],
    end: Float[Tensor, " B"],
) -> InertialSteps:
    """Cut samples into steps between two times each, by the mean of the ends of a step.

    Args:
        timestamps: seconds, strictly increasing; fewer than two raise ValueError.
        gyroscope: rad/s; `accelerometer`: m/s^2.
        start: seconds; before the first sample and behind the last one, the line through two samples is extended.
        end: seconds, not before the start.
    """
    if len(timestamps) < 2:
        raise ValueError(f"timestamps must be of two samples or more, not of {len(timestamps)}")
    timestamps = timestamps.contiguous()
    inner = torch.searchsorted(timestamps, start.detach(), right=True)
    count = (torch.searchsorted(timestamps, end.detach()) - inner).clamp_min(0)
    steps = (int(count.max()) if len(count) else 0) + 1
    number = torch.arange(steps + 1, device=timestamps.device)
    rows = (inner[:, None] + number - 1).clamp(0, len(timestamps) - 1)
    times = torch.where(number <= count[:, None], timestamps[rows], end[:, None])
    times = torch.where(number == 0, start[:, None], times)
    left, fraction = between_rows(timestamps, times)
    samples = torch.cat((gyroscope, accelerometer), dim=-1)
    values = samples[left].lerp(samples[left + 1], fraction[..., None])
    means = 0.5 * (values[:, 1:] + values[:, :-1])
    return InertialSteps(times.diff(dim=-1), means[..., :3], means[..., 3:])


@full_precision
def preintegrate(
    steps: InertialSteps,
    bias: Float[Tensor, "*#batch 6"],
    gyroscope_density: float | Float[Tensor, ""],
    accelerometer_density: float | Float[Tensor, ""],
) -> Increments:
    """The increments over intervals of steps.

    Args:
        bias: of the gyroscope in rad/s and of the accelerometer in m/s^2, which are subtracted.
        gyroscope_density: of its white noise, rad/s/sqrt(Hz); `accelerometer_density`: m/s^2/sqrt(Hz).
    """
    durations, gyroscope, accelerometer = steps
    size = durations.shape[-1]
    missing = (1 << max(size - 1, 0).bit_length()) - size
    parts = _single_steps(
        torch.nn.functional.pad(durations, (0, missing)),
        torch.nn.functional.pad(gyroscope - bias[..., None, :3], (0, 0, 0, missing)),
        torch.nn.functional.pad(accelerometer - bias[..., None, 3:], (0, 0, 0, missing)),
        gyroscope_density,
        accelerometer_density,
    )
    axis = durations.ndim - 1
    while parts.duration.shape[axis] > 1:
        halves = [x.unflatten(axis, (-1, 2)).unbind(axis + 1) for x in parts]
        parts = compose_increments(*(Increments(*(half[side] for half in halves)) for side in (0, 1)))
    return Increments(*(x.squeeze(axis) for x in parts))


def _single_steps(
    durations: Tensor,
    gyroscope: Tensor,
    accelerometer: Tensor,
    gyroscope_density: float | Tensor,
    accelerometer_density: float | Tensor,
) -> Increments:
    """The increments of each step; their Jacobians are right to second order in the angle of a step."""
    dt = durations[..., None]
    matrix_dt = dt[..., None]
    angle, velocity = gyroscope * dt, accelerometer * dt
    once, twice = so3_left_jacobian(angle), so3_double_integral(angle)
    W, A = skew(angle), skew(velocity)
    A_W = skew((W @ velocity[..., None]).squeeze(-1)) + W @ A  # of W W velocity, in the angle
    zero = torch.zeros_like(W)
    # The derivatives of `once` and `twice` times the velocity in the angle: I/1! + W/2! + WW/3!, I/2! + W/3! + WW/4!.
    blocks = (
        torch.cat((matrix_dt * (A / 6 + A_W / 24), -matrix_dt * twice), dim=-1),
        torch.cat((A / 2 + A_W / 6, -once), dim=-1),
        torch.cat((-once, zero), dim=-1),
    )
    per_dt = torch.cat(blocks, dim=-2)
    ones = dt.new_ones(3)
    variances = torch.cat((ones * gyroscope_density**2, ones * accelerometer_density**2))
    return Increments(
        durations,
        so3_exp(angle),
        (once @ velocity[..., None]).squeeze(-1),
        dt * (twice @ velocity[..., None]).squeeze(-1),
        matrix_dt * per_dt,
        matrix_dt * (per_dt * variances) @ per_dt.mT,
    )


@full_precision
def compose_increments(first: Increments, second: Increments) -> Increments:
    """The increments over two intervals, of which the second follows the first."""
    T, R = second.duration[..., None], first.R_ij
    velocity, position = ((R @ x[..., None]).squeeze(-1) for x in (second.velocity, second.position))
    eye, zero = (x.expand_as(R) for x in (torch.eye(3, dtype=R.dtype, device=R.device), torch.zeros_like(R)))
    blocks = (
        torch.cat((eye, T[..., None] * eye, -skew(position)), dim=-1),
        torch.cat((zero, eye, -skew(velocity)), dim=-1),
        torch.cat((zero, zero, eye), dim=-1),
    )
    from_first = torch.cat(blocks, dim=-2)

    def turned(matrix: Tensor) -> Tensor:
        return (R[..., None, :, :] @ matrix.unflatten(-2, (3, 3))).flatten(-3, -2)

    covariance = turned(turned(second.covariance).mT)
    return Increments(
        first.duration + second.duration,
        R @ second.R_ij,
        first.velocity + velocity,
        first.position + T * first.velocity + position,
        from_first @ first.jacobian + turned(second.jacobian),
        from_first @ first.covariance @ from_first.mT + 0.5 * (covariance + covariance.mT),
    )


@full_precision
def with_bias_change(increments: Increments, change: Float[Tensor, "*#batch 6"]) -> Increments:
    """The increments for biases that are larger by a change, to first order in it (equation 44 of the source)."""
    moved = (increments.jacobian @ change[..., None]).squeeze(-1)
    return increments._replace(
        R_ij=so3_exp(moved[..., 6:]) @ increments.R_ij,
        velocity=increments.velocity + moved[..., 3:6],
        position=increments.position + moved[..., :3],
    )
