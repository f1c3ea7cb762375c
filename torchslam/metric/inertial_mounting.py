"""How an inertial sensor would fit a camera's motion, where it does not as given: axes, signs, the inverse mounting.

The gyroscope turns as the camera does, in the axes of the mounting. The accelerometer feels gravity, which is constant
in the world. Both are compared for all exchanges and reversals of axes; the best reading must determine the scale.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.data.inertial import InertialCalibration, InertialSamples
from torchslam.geometry import se3_inverse, umeyama
from torchslam.geometry.transforms import signed_axes
from torchslam.metric.inertial_rotation import TURN_INTERVAL, mean_rates, start_offset, thinned

BETTER = 0.7
"""Ratio of the errors of another reading to those of the given one, up to which it is tried: right axes have less than
0.3 where the camera turns about two axes. Tried at this value only."""


def other_readings(
    timestamps: Float[Tensor, " K"],
    T_cw: Float[Tensor, "K 4 4"],
    samples: InertialSamples,
    calibration: InertialCalibration,
) -> list[tuple[str, InertialSamples, InertialCalibration]]:
    """Readings of the samples and the mounting that fit better than the given one, in words, the likeliest first.

    Args:
        timestamps: seconds, ascending, at least four that are `TURN_INTERVAL` apart, within the times of the samples.
    """
    nodes = thinned(timestamps, TURN_INTERVAL)
    times, R_cw = timestamps[nodes], T_cw[nodes, :3, :3]
    turns_c = R_cw[:-1] @ R_cw[1:].mT
    times = times + start_offset(times, turns_c, samples, calibration.offset)
    rates_c, rates_b, forces = mean_rates(times, turns_c, samples)
    signed = signed_axes(T_cw)

    mountings = [("", calibration)]
    if calibration.T_bc is not None:
        inverse = replace(calibration, T_bc=se3_inverse(calibration.T_bc))
        mountings.append(("the inverse of the transformation between camera and sensor", inverse))
    best_gyroscope = []
    for row, ((_, mounting), A) in enumerate(product(mountings, signed)):
        turned = rates_b @ A.mT
        if mounting.T_bc is None:
            _, R_bc, _ = umeyama(rates_c, turned, with_scale=False)
        else:
            R_bc = mounting.T_bc[:3, :3]
        off = turned - rates_c @ R_bc.mT
        best_gyroscope.append((float((off - off.median(0).values).norm(dim=-1).median()), row, R_bc))
    _, row, R_bc = _simplest(best_gyroscope)
    (words, mounting), A = list(product(mountings, signed))[row]

    best_forces = []
    for row, B in enumerate(signed):
        up_w = R_cw[:-1].mT @ (R_bc.mT @ B @ forces[..., None])
        best_forces.append((float((up_w - up_w.median(0).values).norm(dim=1).median()), row, B))
    # Gravity has no sign of its own: with the same axes as the gyroscope where these fit.
    at_gyroscope = next(row for row, each in enumerate(signed) if torch.equal(each, A))
    same = best_forces[at_gyroscope]
    _, _, B = same if same[0] * BETTER <= min(best_forces)[0] else _simplest(best_forces)
    readings = []
    for sign in (1.0, -1.0):
        parts = [words] if words else []
        if torch.equal(B, A) and not torch.equal(A, signed[0]):
            parts.append(f"the axes of the sensor read as {_names(A)}")
        elif not torch.equal(A, signed[0]):
            parts.append(f"the axes of the gyroscope read as {_names(A)}")
        if torch.equal(B, A) and sign < 0:
            parts.append("accelerations of the opposite sign")
        elif not torch.equal(B, A) and not torch.equal(sign * B, signed[0]):
            parts.append(f"the axes of the accelerometer read as {_names(sign * B)}")
        if parts:
            changed = replace(
                samples, gyroscope=samples.gyroscope @ A.mT, accelerometer=sign * samples.accelerometer @ B.mT
            )
            readings.append((" and ".join(parts), changed, mounting))
    return readings


def _simplest(errors: list[tuple[float, int, Tensor]]) -> tuple[float, int, Tensor]:
    """The first, which is as given, unless the least error is clearly less; the first of equals."""
    least = min(error for error, _, _ in errors)
    return next(each for each in errors if each[0] <= least / BETTER)


def _names(A: Float[Tensor, "3 3"]) -> str:
    """`(y, -x, z)`: which axis of the file is x, y and z."""
    axes = ["xyz"[int(row.abs().argmax())] for row in A]
    return f"({', '.join('-' * (float(row.sum()) < 0) + axis for row, axis in zip(A, axes, strict=True))})"
