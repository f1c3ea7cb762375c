"""Gyroscope and camera turn together: the bias, the offset of the clocks, and the rotation between the two.

Rotations of a camera do not depend on the scale, so that all this is known before a meter is.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchslam.data.inertial import InertialCalibration, InertialSamples
from torchslam.errors import MeasurementError
from torchslam.geometry import skew, so3_exp, so3_log, umeyama
from torchslam.geometry.lie import so3_left_jacobian_inverse
from torchslam.geometry.preintegration import Increments, inertial_steps, preintegrate
from torchslam.geometry.robust import median_scale, robustify
from torchslam.utils.indexing import between_rows

TURN_INTERVAL = 0.1
"""Seconds over which turns are compared. With 0.05, 0.1 and 0.25 s the offset of a drone's clocks is -0.2, -0.4 and 0.2
ms; with 0.5 s, a fifth of the biases from parts of 4 s is wrong."""
LARGEST_OFFSET = 0.5
"""Seconds by which the clocks may be apart. Clocks of different origins are farther apart."""
OFFSET_STEP = 0.01
"""Seconds between offsets that are tried; the search by derivatives finds offsets that are 0.1 s away."""
CONVINCING = 0.7
"""Correlation of angular speeds from which another offset than the given one is believed. On a drone, 0.96 to 0.98."""
OFFSET_STD = 0.01
"""Seconds, of the offset before it is measured: a camera that hardly turns leaves it where it was."""
BIAS_STD = 0.1  # rad/s, of the gyroscope's bias before it is measured: three times that of cheap sensors
ROBUST_SCALE = 2.0
"""Of Cauchy's kernel, in standard errors of a turn, which leaves Gaussian errors 95 % of their information."""
ROUNDS, WIDE_ROUNDS = 6, 3
"""Steps, and those of them by reweighted least squares, which come from afar; those of Newton after them converge."""
MOUNTING_STD, FOUND_MOUNTING_STD = 2e-3, 6e-3
"""rad about each axis: errors of a calibrated rotation between camera and body, where calibrations of one rig differ by
0.1 degrees, and what is added to those of one that is found. On a drone's recording that is off by 0.7 degrees, which
turns of 0.2 degrees of noise do not explain."""


class InertialRotation(NamedTuple):
    """What the turns of a camera say about a gyroscope.

    Attributes:
        R_bc, R_std: rotation from camera to body, and its standard errors, rad.
        bias, bias_std: of the gyroscope, rad/s.
        offset, offset_std: seconds to add to times of the camera for those of the sensor.
        turn_std: rad, of a turn over `TURN_INTERVAL`.
    """

    R_bc: Float[Tensor, "3 3"]
    bias: Float[Tensor, " 3"]
    offset: Float[Tensor, ""]
    R_std: Float[Tensor, " 3"]
    bias_std: Float[Tensor, " 3"]
    offset_std: Float[Tensor, ""]
    turn_std: Float[Tensor, ""]


def thinned(timestamps: Float[Tensor, " K"], interval: float) -> Int[Tensor, " N"]:
    """Rows of times that are nearly the interval apart or more, from the first one on."""
    kept: list[int] = []
    last = -float("inf")
    for row, time in enumerate(timestamps.tolist()):
        if time - last > 0.9 * interval:
            kept.append(row)
            last = time
    return torch.tensor(kept, dtype=torch.int64, device=timestamps.device)


def align_rotations(
    timestamps: Float[Tensor, " K"],
    R_cw: Float[Tensor, "K 3 3"],
    samples: InertialSamples,
    calibration: InertialCalibration,
    turn_std: float | None = None,
) -> InertialRotation:
    """The bias of the gyroscope, the offset of the clocks and, if it is unknown, the rotation from camera to body.

    The minimum is differentiable in rotations and samples. Raises MeasurementError if the rates are in another unit.

    Args:
        timestamps: seconds, ascending, at least four that are `TURN_INTERVAL` apart, within the times of the samples.
        turn_std: rad, of a turn over `TURN_INTERVAL`; None: that of the residuals, which has no gradient.
    """
    nodes = thinned(timestamps, TURN_INTERVAL)
    times, R_cw = timestamps[nodes], R_cw[nodes]
    turns_c = R_cw[:-1] @ R_cw[1:].mT  # from the camera at the end of an interval to that at its start
    with torch.no_grad():
        prior = times.new_tensor(start_offset(times, turns_c, samples, calibration.offset))
        R_bc, bias = _start_rotation(times + prior, turns_c, samples, calibration.T_bc)
    offset = prior
    for step in range(ROUNDS):
        exact = step >= WIDE_ROUNDS
        with torch.set_grad_enabled(torch.is_grad_enabled() and step == ROUNDS - 1):
            found = _refined(
                times, turns_c, samples, R_bc, bias, offset, prior, calibration.T_bc is None, exact, turn_std
            )
        R_bc, bias, offset = (x.detach() for x in found[:3])
    return found


def increments(
    samples: InertialSamples,
    start: Float[Tensor, " B"],
    end: Float[Tensor, " B"],
    bias: Float[Tensor, " 3"],
    densities: tuple[float, float] = (1.0, 1.0),
) -> Increments:
    """Increments between times, with a bias of the gyroscope, and the densities of both sensors' noise."""
    steps = inertial_steps(samples.timestamps, samples.gyroscope, samples.accelerometer, start, end)
    return preintegrate(steps, torch.cat((bias, torch.zeros_like(bias))), *densities)


def start_offset(times: Tensor, turns_c: Tensor, samples: InertialSamples, given: float) -> float:
    """The offset at which the angular speeds correlate best, or the given one."""
    angles = so3_log(turns_c).norm(dim=-1)
    speed = samples.gyroscope.norm(dim=-1)
    steps = 0.5 * (speed[1:] + speed[:-1]) * samples.timestamps.diff()
    total = torch.cat((speed.new_zeros(1), torch.cumsum(steps, 0)))
    count = round(LARGEST_OFFSET / OFFSET_STEP)
    offsets = given + OFFSET_STEP * torch.arange(-count, count + 1, dtype=times.dtype, device=times.device)
    at = times + offsets[:, None]
    inside = (at >= samples.timestamps[0]) & (at <= samples.timestamps[-1])
    valid = inside[:, 1:] & inside[:, :-1]
    left, part = between_rows(samples.timestamps, at)
    measured = total[left].lerp(total[left + 1], part.clamp(0, 1)).diff(dim=-1)
    correlation, slope = _correlation(angles.expand_as(measured), measured, valid)
    enough = valid.sum(-1) >= 0.5 * len(angles)
    correlation = torch.where(enough, correlation, -1.0)
    best = int(correlation.argmax())
    if float(correlation[best]) < CONVINCING:
        return given
    if not 0.1 < float(slope[best]) < 10:  # radians and degrees differ by 57, a bias by less than 2
        raise MeasurementError(
            f"{samples.source}: the sensor turns {float(slope[best]):.2g} times as fast as the camera; state the unit "
            "of its rates, as in gyro_x [deg/s]"
        )
    return float(offsets[best])


def _correlation(a: Tensor, b: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
    """Of the valid columns of each row: their correlation, and the slope of b in a."""
    count = valid.sum(-1, keepdim=True).clamp_min(1)
    a, b = (torch.where(valid, x, 0.0) for x in (a, b))
    a, b = (torch.where(valid, x - x.sum(-1, keepdim=True) / count, 0.0) for x in (a, b))
    tiny = torch.finfo(a.dtype).tiny
    aa, ab, bb = (a * a).sum(-1).clamp_min(tiny), (a * b).sum(-1), (b * b).sum(-1).clamp_min(tiny)
    return ab / (aa.sqrt() * bb.sqrt()), ab / aa


def mean_rates(times: Tensor, turns_c: Tensor, samples: InertialSamples) -> tuple[Tensor, Tensor, Tensor]:
    """Rates of the camera and of the sensor, rad/s, and forces, m/s^2, in the intervals of times."""
    found = increments(samples, times[:-1], times[1:], torch.zeros_like(samples.gyroscope[0]))
    duration = found.duration[:, None]
    return so3_log(turns_c) / duration, so3_log(found.R_ij) / duration, found.velocity / duration


def _start_rotation(
    times: Tensor, turns_c: Tensor, samples: InertialSamples, T_bc: Tensor | None
) -> tuple[Tensor, Tensor]:
    """R_bc and the bias, from rotation vectors of both sensors."""
    rates_c, rates_b, _ = mean_rates(times, turns_c, samples)
    if T_bc is None:
        _, R_bc, bias = umeyama(rates_c, rates_b, with_scale=False)
        return R_bc, bias
    return T_bc[:3, :3], (rates_b - rates_c @ T_bc[:3, :3].mT).median(dim=0).values


def _refined(
    times: Tensor,
    turns_c: Tensor,
    samples: InertialSamples,
    R_bc: Tensor,
    bias: Tensor,
    offset: Tensor,
    prior: Tensor,
    rotation_free: bool,
    exact: bool,
    turn_std: float | None,
) -> InertialRotation:
    """One step over rotation, bias and offset: of reweighted least squares, or with the kernel's curvature as well.

    At the minimum the gradient of the latter is that of the minimum, up to the curvature of rotations times the errors.
    """
    at = times + offset
    found = increments(samples, at[:-1], at[1:], bias)
    left, part = between_rows(samples.timestamps, at)
    rates = samples.gyroscope[left].lerp(samples.gyroscope[left + 1], part[:, None]) - bias
    R_ij, turns_b = found.R_ij, R_bc @ turns_c @ R_bc.mT
    error = so3_log(turns_b @ R_ij.mT)
    inverse, from_right = so3_left_jacobian_inverse(error), so3_left_jacobian_inverse(-error)
    shift = (R_ij @ rates[1:, :, None]) - rates[:-1, :, None]
    turned = torch.eye(3, dtype=R_ij.dtype, device=R_ij.device) - turns_b
    J = torch.cat((inverse @ turned, -from_right @ found.jacobian[:, 6:, :3], -from_right @ shift), dim=-1)
    std = median_scale(error.detach().abs().flatten()).clamp_min(1e-7)  # of exact data
    std = std if turn_std is None else torch.full_like(std, turn_std)
    kernel = robustify((error / std).square().sum(-1), "cauchy", std.new_tensor(ROBUST_SCALE))
    weighted = (kernel.weight[:, None] * error / std**2)[..., None]
    if not rotation_free:
        J = torch.cat((torch.zeros_like(J[..., :3]), J[..., 3:]), dim=-1)
    # Without axes of turning, the rotation between the sensors stays where it was.
    known = bias.new_tensor((*(1e3,) * 3, *(BIAS_STD,) * 3, OFFSET_STD)) ** -2
    off = torch.cat((torch.zeros_like(bias), bias, (offset - prior)[None]))
    gradient = (J.mT @ weighted).sum(0).squeeze(-1) + known * off
    hessian = normal = (J.mT @ (kernel.weight[:, None, None] * J)).sum(0) / std**2 + torch.diag(known)
    if exact:
        along = J.mT @ (error / std**2)[..., None]
        hessian = normal + 2 * (kernel.curvature[:, None, None] * along @ along.mT).sum(0)
        # The rates change with the offset: noisy sensors bend the errors more than the turns themselves do.
        periods = samples.timestamps[left + 1] - samples.timestamps[left]
        slopes = ((samples.gyroscope[left + 1] - samples.gyroscope[left]) / periods[:, None])[..., None]
        bend = R_ij @ slopes[1:] - slopes[:-1] + skew(shift.squeeze(-1)) @ R_ij @ rates[1:, :, None]
        bend = -(weighted * (from_right @ bend)).sum()
        hessian = hessian + torch.nn.functional.pad(bend.view(1, 1), (6, 0, 6, 0))
    change = -torch.linalg.solve(hessian, gradient)
    stds = torch.linalg.inv(normal.detach()).diagonal().sqrt()
    R_std = torch.full_like(stds[:3], MOUNTING_STD)
    if rotation_free:
        R_bc = so3_exp(change[:3]) @ R_bc
        R_std = torch.hypot(stds[:3], torch.full_like(R_std, FOUND_MOUNTING_STD))
    return InertialRotation(R_bc, bias + change[3:6], offset + change[6], R_std, stds[3:6], stds[6], std)
