"""The equations of stretches in their common unknowns, and the minimum: scale, gravity, biases and lever arm.

The positions of the map are noisy, and the scale multiplies them: plain least squares makes it too small by the share
of the noise in their squares (attenuation). The expected share is taken out, as in Fuller, "Measurement error models",
1987, section 2.2, which adds a convex term to the cost.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.data.inertial import InertialCalibration
from torchslam.metric.inertial_rotation import InertialRotation
from torchslam.metric.inertial_stretches import Stretches

GRAVITY, GRAVITY_STD = 9.807, 0.02
"""m/s^2: that of middle latitudes, and how it differs over the Earth (9.78 to 9.83)."""
DRIFT = 4.0
"""Drift of positions in a second, in standard errors of a position. On a drone's recording it is 3.8 mm at 0.5 mm; with
0, 2, 4, 8, scales of 4 s are off by 0.77, 0.71, 0.73, 0.89 %, or by 1.37, 1.25, 1.18, 1.18 stated errors."""
BIAS_STD = 0.3
"""m/s^2, of the accelerometer's bias before it is measured: that of cheap sensors that are not calibrated."""
LEVER_STD, UNKNOWN_LEVER_STD = 2e-3, 0.05
"""Meters: error of a lever arm from a calibration, and of one of zero where none is known, as on phones."""
ATTENUATION_STD = 0.5
"""Relative error of the share of noise in the scale. In a simulated motion of 3 cm with positions good to 2 mm and no
drift, the share is taken to be 65 %, which makes the scale 56 % too large: it then counts as not determined."""
NEWTON_STEPS = 10
"""Steps to the minimum; on a drone's recording the fourth one no longer changes the scale."""


class Equations(NamedTuple):
    """Normal equations of each stretch in the common unknowns.

    Attributes:
        hessian: of half the squared whitened residuals.
        right: minus their gradient where all unknowns are zero.
        squared: the squared residuals there.
        attenuation: the squares of the scaled noise of positions, whitened, which the residuals are expected to have.
        redundancy: residuals less what is free.
    """

    hessian: Float[Tensor, "S 13 13"]
    right: Float[Tensor, "S 13"]
    squared: Float[Tensor, " S"]
    attenuation: Float[Tensor, " S"]
    redundancy: Float[Tensor, " S"]

    def summed(self, counted: Tensor, prior: Tensor) -> Equations:
        """Of the stretches that count, with what is known before; without the S."""
        hessian, right, *rest = ((x * counted.view(-1, *(1,) * (x.ndim - 1))).sum(0) for x in self)
        return Equations(hessian + torch.diag(prior), right, *rest)


def prior_information(calibration: InertialCalibration, rotation: InertialRotation) -> Float[Tensor, " 13"]:
    """The information of the common unknowns before they are measured."""
    std = rotation.bias.new_full((13,), math.inf)
    std[4:7], std[7:10] = BIAS_STD, rotation.bias_std
    std[10:] = UNKNOWN_LEVER_STD if calibration.T_bc is None else LEVER_STD
    return std**-2


def equations_of(stretches: Stretches, position_std: float) -> Equations:
    """Normal equations of each stretch, its motion at the start eliminated.

    Args:
        stretches: the stretches.
        position_std: meters, standard error of the map's positions.
    """
    times, valid = stretches.times, stretches.valid
    eye = torch.eye(times.shape[1], dtype=times.dtype, device=times.device)
    axes = torch.eye(3, dtype=times.dtype, device=times.device)
    seen = position_std**2 * (eye + DRIFT**2 * torch.minimum(times[:, :, None], times[:, None]))
    seen = seen * (valid[:, :, None] & valid[:, None])
    seen = (seen[:, :, None, :, None] * axes[:, None]).flatten(3, 4).flatten(1, 2)
    both = valid[:, :, None, None, None] & valid[:, None, None, :, None]
    noise = torch.where(both, stretches.noise, eye[:, None, :, None] * axes[:, None] * ~both)
    root = torch.linalg.cholesky(noise.flatten(3, 4).flatten(1, 2) + seen)
    joined = torch.cat((stretches.motion, stretches.columns, stretches.right[..., None]), dim=-1)
    joined = torch.where(valid[..., None, None], joined, 0.0).flatten(1, 2)
    white = torch.linalg.solve_triangular(root, joined, upper=False)
    basis = torch.linalg.qr(white[..., :6])[0]
    white = white[..., 6:] - basis @ (basis.mT @ white[..., 6:])
    A, y = white[..., :-1], white[..., -1:]
    free = torch.linalg.solve_triangular(root.mT, basis, upper=True)
    attenuation = (torch.cholesky_inverse(root) * seen).sum((1, 2)) - ((seen @ free) * free).sum((1, 2))
    return Equations(
        A.mT @ A,
        (A.mT @ y).squeeze(-1),
        y.square().sum((1, 2)),
        attenuation,
        3.0 * valid.sum(-1).to(times) - 6,
    )


def squared_residuals(equations: Equations, x: Float[Tensor, " 13"]) -> Float[Tensor, " S"]:
    """Squared whitened residuals of each stretch."""
    along = (equations.hessian @ x - 2 * equations.right) @ x
    return (equations.squared + along).clamp_min(0)


def minimum(total: Equations) -> Float[Tensor, " 13"] | None:
    """The minimum with gravity of nearly the length that it has on Earth; None where the scale is not determined.

    Differentiable: the last step of Newton at the minimum has its gradient.
    """
    hessian, right, _, attenuation, _ = total
    root, info = torch.linalg.cholesky_ex(hessian)
    if int(info) > 0:
        return None
    with torch.no_grad():
        x = torch.cholesky_solve(right[:, None], root).squeeze(-1)
    if not bool(x[0] > 0):
        return None
    eye = torch.eye(3, dtype=x.dtype, device=x.device)
    for step in range(NEWTON_STEPS):
        is_last = step == NEWTON_STEPS - 1
        length = x[1:4].norm()
        down = x[1:4] / length
        gradient = hessian @ x - right - _in_scale(attenuation / x[0])
        gradient = gradient + _in_gravity((length - GRAVITY) / GRAVITY_STD**2 * down)
        curved = down[:, None] * down
        if is_last:
            curved = curved + (1 - GRAVITY / length) * (eye - curved)
        curved = _in_gravity(_in_gravity(curved / GRAVITY_STD**2).mT)
        curved = curved + torch.diag(_in_scale(attenuation / x[0].square()))
        moved = x - torch.linalg.solve(hessian + curved, gradient)
        if is_last:
            return moved
        moved = moved.detach()
        x = torch.cat((torch.maximum(moved[:1], 0.5 * x[:1]), moved[1:]))
    raise AssertionError  # the last step returns


def _in_scale(x: Float[Tensor, ""]) -> Float[Tensor, " 13"]:
    """Of the common unknowns, whose first one is the scale."""
    return torch.nn.functional.pad(x[None], (0, 12))


def _in_gravity(x: Float[Tensor, "*rows 3"]) -> Float[Tensor, "*rows 13"]:
    """Of the common unknowns, whose second to fourth ones are gravity."""
    return torch.nn.functional.pad(x, (1, 9))


def standard_errors(
    equations: Equations, prior: Tensor, counted: Tensor, x: Float[Tensor, " 13"]
) -> tuple[float, float]:
    """Standard errors of the scale, relative, and of gravity's direction, rad; infinite where it is not determined.

    Both grow where the scales of single stretches, with all else fixed at the solution, differ by more
    than their errors. That of the scale contains the error of the share of noise that was taken out.
    """
    total = equations.summed(counted, prior)
    down = x[1:4] / x[1:4].norm()
    spread = total.hessian + _in_gravity(_in_gravity(down[:, None] * down / GRAVITY_STD**2).mT)
    information = spread - torch.diag(_in_scale(total.attenuation / x[0].square()))
    root, info = torch.linalg.cholesky_ex(information)
    if int(info) > 0:
        return math.inf, math.inf
    inverse = torch.cholesky_inverse(root)
    covariance = inverse @ spread @ inverse
    growth = 1.0
    if int(counted.sum()) > 1:
        weight = equations.hessian[counted, 0, 0]
        score = (equations.right - equations.hessian @ x)[:, 0] + equations.attenuation / x[0]
        growth = max(1.0, float((score[counted].square() / weight).sum()) / (int(counted.sum()) - 1)) ** 0.5
    across = torch.eye(3, dtype=x.dtype, device=x.device) - down[:, None] * down
    share = total.attenuation / x[0].square() * torch.linalg.inv(spread)[0, 0]
    own = growth * float(covariance[0, 0].sqrt() / x[0].abs())
    tilt = (across @ covariance[1:4, 1:4] @ across).diagonal().sum().clamp_min(0).sqrt() / x[1:4].norm()
    return math.hypot(own, ATTENUATION_STD * float(share)), growth * float(tilt)
