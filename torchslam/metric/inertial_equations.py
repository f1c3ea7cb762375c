"""The equations of `metric.inertial` along stretches of a few seconds, and their minimum in the common unknowns.

They are written in the frame of the body at the start of each stretch. The positions of the map are noisy, and the
scale multiplies them: plain least squares makes it too small by the share of the noise in their squares (attenuation).
The expected share is taken out, as in Fuller, "Measurement error models", 1987, section 2.2, which adds a convex term
to the cost.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchslam.data.inertial import InertialCalibration, InertialSamples
from torchslam.geometry import Increments, compose_increments, se3_inverse, skew, so3_exp, so3_log
from torchslam.metric.inertial_rotation import InertialRotation, increments, thinned

STRETCH = 4.0
"""Seconds of a stretch. With 2, 4, 8 s the scale of parts of 8 s of a drone's recording is off by .61, .58, .56 %."""
NODE_INTERVAL = 0.05
"""Seconds between positions that are compared; more of them in a second say the same of the drift again."""
LONGEST_INTERVAL = 1.0
"""Seconds between two posed frames from which on a stretch ends: the map knows nothing of the way in between."""
LONGEST_GAP = 0.1
"""Seconds between two samples from which on some are missing: an order of magnitude above the period of any sensor."""
SHORTEST_STRETCH = 1.0  # seconds; below, an acceleration is lost in the velocity that is not known
FEWEST_NODES = 8  # positions of a stretch: six numbers of each coordinate go to the motion that is not known
ATTITUDE_STD = 1e-3
"""rad, by which the attitude of a stretch differs from that of the map. With 0, 1e-3 and 3e-3 gravity of a drone's
recording is off by 0.48, 0.23 and 0.23 degrees, and the scale by the same."""
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


class Stretches(NamedTuple):
    """Positions of the body along stretches, (S, N), in the frame of the body at the start of each.

    Attributes:
        columns: derivatives of the equation's left side in scale, gravity, accelerometer's and gyroscope's bias, lever.
        right: its right side.
        motion: derivatives in the position and the velocity at the start.
        noise: covariances of the positions from the noise of the sensor and of the attitude.
        times: seconds since the start.
        valid: which nodes there are.
    """

    columns: Float[Tensor, "S N 3 13"]
    right: Float[Tensor, "S N 3"]
    motion: Float[Tensor, "S N 3 6"]
    noise: Float[Tensor, "S N 3 N 3"]
    times: Float[Tensor, "S N"]
    valid: Bool[Tensor, "S N"]


def lever_arm(calibration: InertialCalibration, R_bc: Tensor) -> Float[Tensor, " 3"]:
    """The body's origin in the frame of the camera."""
    if calibration.T_bc is None:
        return R_bc.new_zeros(3)
    return -(calibration.T_bc[:3, :3].mT @ calibration.T_bc[:3, 3]).to(R_bc)


def stretch_rows(timestamps: Tensor, samples: InertialSamples, offset: float) -> list[list[int]]:
    """The rows of the nodes of each stretch; the last node of a stretch is the first one of the next."""
    nodes = thinned(timestamps, NODE_INTERVAL)
    times = timestamps[nodes]
    at, rows = samples.timestamps, nodes.tolist()
    gaps = torch.nonzero(at.diff() > LONGEST_GAP)[:, 0]
    before = torch.searchsorted(at[gaps], times + offset)  # gaps that begin before each node
    broken = (times.diff() > LONGEST_INTERVAL) | (before.diff() > 0)
    if len(gaps):
        within = (times + offset < at[gaps[(before - 1).clamp_min(0)] + 1]) & (before > 0)
        broken = broken | within[1:] | within[:-1]
    outside = (times + offset < at[0]) | (times + offset > at[-1])
    broken = broken | outside[1:] | outside[:-1]
    ends = [-1, *torch.nonzero(broken)[:, 0].tolist(), len(rows) - 1]
    stretches: list[list[int]] = []
    for begin, end in itertools.pairwise(ends):
        duration = float(times[end] - times[begin + 1])
        count = max(1, round(duration / STRETCH))
        steps = torch.arange(1, count, dtype=times.dtype, device=times.device)
        limits = times[begin + 1] + duration / count * steps
        cuts = (torch.searchsorted(times[begin + 1 : end + 1], limits) + begin + 1).tolist()
        for first, last in zip([begin + 1, *cuts], [*cuts, end], strict=True):
            if float(times[last] - times[first]) >= SHORTEST_STRETCH and last + 1 - first >= FEWEST_NODES:
                stretches.append(rows[first : last + 1])
    return stretches


def stretches_of(
    timestamps: Tensor,
    T_cw: Tensor,
    samples: InertialSamples,
    calibration: InertialCalibration,
    rotation: InertialRotation,
    rows: list[list[int]],
) -> Stretches:
    """The equations of all stretches, padded by their last node."""
    size = max(map(len, rows))
    device = T_cw.device
    padded = torch.tensor([each + each[-1:] * (size - len(each)) for each in rows], device=device)
    lengths = torch.tensor([len(each) for each in rows], device=device)
    valid = torch.arange(size, device=device) < lengths[:, None]
    chained = _chained(timestamps[padded] + rotation.offset, samples, calibration, rotation.bias)
    T_wc = se3_inverse(T_cw)[padded]
    # The attitude of the body at the start: the mean over the nodes, by the map.
    apart = T_wc[..., :3, :3] @ rotation.R_bc.mT @ chained.R_ij.mT
    R_wb, weights = apart[:, 0], valid[..., None] / valid.sum(-1)[:, None, None]
    for _ in range(3):  # the mean on the manifold; the rotations are within a degree
        R_wb = so3_exp((weights * so3_log(apart @ R_wb.mT[:, None])).sum(1)) @ R_wb
    R_bw = R_wb.mT[:, None]
    times, P = chained.duration, chained.position
    positions, arms = R_bw @ T_wc[..., :3, 3:], R_bw @ T_wc[..., :3, :3]
    eye = torch.eye(3, dtype=T_cw.dtype, device=device).expand(*valid.shape, 3, 3)
    seconds = times[..., None, None]
    half_squares = 0.5 * seconds.square()
    by_gyroscope, by_accelerometer = chained.jacobian[..., :3, :].split(3, dim=-1)
    columns = torch.cat((positions, -half_squares * R_bw, -by_accelerometer, -by_gyroscope, arms), dim=-1)
    right = P - (arms @ lever_arm(calibration, rotation.R_bc)[:, None]).squeeze(-1)
    return Stretches(columns, right, torch.cat((eye, seconds * eye), dim=-1), _noise(chained), times, valid)


def _chained(
    times: Tensor, samples: InertialSamples, calibration: InertialCalibration, bias: Tensor
) -> Increments:
    """Increments from the start of each stretch to each of its nodes, (S, N)."""
    densities = calibration.gyroscope_density, calibration.accelerometer_density
    parts = increments(samples, times[:, :-1].flatten(), times[:, 1:].flatten(), bias, densities)
    each = [x.unflatten(0, (len(times), -1)) for x in parts]
    total = Increments(*(torch.zeros_like(x[:, 0]) for x in each))
    total = total._replace(R_ij=total.R_ij + torch.eye(3, dtype=times.dtype, device=times.device))
    chain = [total]
    for node in range(times.shape[1] - 1):
        total = compose_increments(total, Increments(*(x[:, node] for x in each)))
        chain.append(total)
    return Increments(*(torch.stack(x, dim=1) for x in zip(*chain, strict=True)))


def _noise(chained: Increments) -> Float[Tensor, "S N 3 N 3"]:
    """Covariances of the positions of all pairs of nodes. What disturbs node j moves a later node k along with it."""
    T, P, V = chained.duration, chained.position, chained.velocity
    later = (T[:, :, None] - T[:, None]).clamp_min(0)[..., None]  # (S, k, j, 1)
    traveled = P[:, :, None] - P[:, None] - later * V[:, None]
    C = chained.covariance[:, None, :, :, :3]  # of node j with its position
    moved = C[..., :3, :] + later[..., None] * C[..., 3:6, :] - skew(traveled) @ C[..., 6:, :]
    size = T.shape[1]
    order = torch.arange(size, device=T.device)
    lower = (order[:, None] >= order)[..., None, None]
    strictly = (order[:, None] > order)[..., None, None]
    moved = torch.where(lower, moved, 0.0)
    full = moved + torch.where(strictly, moved, 0.0).transpose(1, 2).mT
    tilt = ATTITUDE_STD * skew(P)
    full = full + tilt[:, :, None] @ tilt[:, None].mT
    return full.transpose(2, 3)


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
    """Normal equations of each stretch, its motion at the start eliminated; the map's error is in meters."""
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
    for step in range(10):  # on a drone's recording the fourth one no longer changes the scale
        is_last = step == 9
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
