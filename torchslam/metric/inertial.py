"""Scale and gravity of a map from an inertial sensor: what it integrates to, against where the camera went.

Over a stretch of a few seconds, with the attitude that the gyroscope integrates to, the positions of the body are

    s p + R_wc l = p_0 + v_0 t + g t^2 / 2 + P + J b,

with the camera's positions p in the unit of the map and s meters per unit, the lever arm l, the increments P of the
accelerometer and J their derivative in the biases b. All unknowns are linear. Positions and velocities at the starts of
the stretches are eliminated, scale, gravity, biases and the lever arm are common to all. Positions are correlated by
the noise of the sensor and by the drift of the map, whose size follows from the residuals; stretches that contradict
the others do not count. Then the length of gravity is what it is on Earth.

Sources: Qin and Shen, "Robust initialization of monocular visual-inertial estimation on aerial robots", 2017; Campos et
al., "Inertial-only optimization for visual-inertial initialization", 2020; increments as in Forster et al., 2017.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchslam.data.inertial import InertialCalibration, InertialSamples
from torchslam.geometry import se3_inverse, skew, so3_exp, so3_log
from torchslam.geometry.preintegration import Increments, compose_increments, inertial_steps, preintegrate
from torchslam.metric.inertial_rotation import (
    InertialRotation,
    align_rotations,
    thinned,
)

GRAVITY, GRAVITY_STD = 9.807, 0.02
"""m/s^2: that of middle latitudes, and how it differs over the Earth (9.78 to 9.83)."""
STRETCH = 4.0
"""Seconds of a stretch. With 2, 4, 8 s the scale of parts of 8 s of a drone's recording is off by .61, .58, .56 %."""
NODE_INTERVAL = 0.05
"""Seconds between positions that are compared; more of them in a second say the same of the drift again."""
LONGEST_INTERVAL = 1.0
"""Seconds between two posed frames from which on a stretch ends: the map knows nothing of the way in between."""
EDGE = 0.05
"""Seconds from the first and the last sample within which frames are left out, for the clocks may be apart."""
LONGEST_GAP = 0.1
"""Seconds between two samples from which on some are missing: an order of magnitude above the period of any sensor."""
SHORTEST, FEWEST_FRAMES = 3.0, 12
"""Seconds and posed frames; in less time gravity and the sensor's bias cannot be told from acceleration."""
SHORTEST_STRETCH = 1.0
"""Seconds; below, an acceleration is lost in the velocity that is not known."""
FEWEST_NODES = 8
"""Positions of a stretch: six numbers of each coordinate go to the motion that is not known."""
ATTITUDE_STD = 1e-3
"""rad, by which the attitude of a stretch differs from that of the map. With 0, 1e-3 and 3e-3 gravity of a drone's
recording is off by 0.48, 0.23 and 0.23 degrees, and the scale by the same."""
DRIFT = 4.0
"""Drift of positions in a second, in standard errors of a position. On a drone's recording it is 3.8 mm at 0.5 mm; with
0, 2, 4, 8, scales of 4 s are off by 0.77, 0.71, 0.73, 0.89 %, or by 1.37, 1.25, 1.18, 1.18 stated errors."""
POSITION_STD, SMALLEST_POSITION_STD = 5e-3, 1e-4
"""Meters: the standard error of a position with which the search begins, and the least one."""
WEIGHINGS = 5
"""Rounds that find the standard error of positions from 5 mm; the fifth one of 0.4 mm changes it by a percent."""
BIAS_STD = 0.3
"""m/s^2, of the accelerometer's bias before it is measured: that of cheap sensors that are not calibrated."""
LEVER_STD, UNKNOWN_LEVER_STD = 2e-3, 0.05
"""Meters: error of a lever arm from a calibration, and of one of zero where none is known, as on phones."""
SENSOR_STD = 5e-3
"""Relative error of the accelerometer's scale factor, which nothing here can find. With the true poses of a drone, the
scale of its sensor's (ADIS16448) is off by 0.35 %."""
WORST = 0.1
"""Relative standard error from which on a scale counts as not determined."""
STILL_INTERVAL = 0.25
"""Seconds over which rates and forces are averaged: a drone's motors shake it by 0.8 m/s^2 while it stands."""
STILL_TURN, STILL_FORCE = 0.02, 0.1
"""rad/s and m/s^2: spread of the averages of a sensor that does not move. A drone on the ground with its motors on has
0.005 and 0.04, one that is carried 0.17 and 0.75 at least."""
GRAVITY_STEPS = 6
"""Steps of Newton to gravity of the right length; from 2 % off, the third one changes it by 1e-6."""
OUTLYING = 9.0
"""Mean squared residual of a stretch, in units of the median one, from which on it contradicts the others."""


class InertialReason(StrEnum):
    """Why an inertial sensor says what it says."""

    MEASURED = "measured"
    NO_OVERLAP = "no three seconds of posed frames lie within the times of the samples"
    STILL = "the camera does not move: the sensor neither turns nor accelerates"
    NOT_DETERMINED = "the motion has too little acceleration"


@dataclass(frozen=True)
class InertialAlignment:
    """Scale, gravity and the sensor's parameters. Without a gradient, and not to be used, unless it is `MEASURED`.

    Attributes:
        reason: whether it was measured.
        meters_per_unit: of the map.
        relative_std: its standard error.
        gravity_w: in the frame of the map, m/s^2, pointing down.
        gravity_std: standard error of its direction, rad.
        accelerometer_bias: m/s^2.
        rotation: bias of the gyroscope, offset of the clocks, rotation from camera to body.
        lever_c: the body's origin in the frame of the camera, meters.
        position_std: standard error of the map's positions, meters.
        stretches: how many count.
        rejected: the times at which those begin that contradict the others.
    """

    reason: InertialReason
    meters_per_unit: Float[Tensor, ""]
    relative_std: float
    gravity_w: Float[Tensor, " 3"]
    gravity_std: float
    accelerometer_bias: Float[Tensor, " 3"]
    rotation: InertialRotation | None
    lever_c: Float[Tensor, " 3"]
    position_std: float
    stretches: int
    rejected: tuple[float, ...] = ()


class _Stretches(NamedTuple):
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


class _Equations(NamedTuple):
    """Normal equations of each stretch in the common unknowns."""

    hessian: Float[Tensor, "S 13 13"]
    right: Float[Tensor, "S 13"]
    squared: Float[Tensor, " S"]
    redundancy: Float[Tensor, " S"]


def align_inertial(
    timestamps: Float[Tensor, " K"],
    T_cw: Float[Tensor, "K 4 4"],
    samples: InertialSamples,
    calibration: InertialCalibration,
    *,
    turn_std: float | None = None,
    position_std: float | None = None,
) -> InertialAlignment:
    """Scale and gravity of poses in an arbitrary unit. Differentiable in poses and samples.

    Args:
        timestamps: seconds, ascending.
        T_cw: poses of the camera.
        samples: of the sensor.
        calibration: what is known of it.
        turn_std: rad, of the camera's turns over `TURN_INTERVAL`.
        position_std: meters, of its positions. None: those of the residuals, which have no gradient.

    Returns:
        The alignment, or why there is none. The stated errors contain the noise of both sensors, the disagreement of
        stretches, and `SENSOR_STD`.

    Raises:
        MeasurementError: the rates are in another unit.
    """
    inside = (timestamps + calibration.offset > samples.timestamps[0] + EDGE) & (
        timestamps + calibration.offset < samples.timestamps[-1] - EDGE
    )
    timestamps, T_cw = timestamps[inside], T_cw[inside]
    if len(timestamps) < FEWEST_FRAMES or timestamps[-1] - timestamps[0] < SHORTEST:
        return _nothing(InertialReason.NO_OVERLAP, T_cw)
    if lies_still(samples, float(timestamps[0]), float(timestamps[-1])):
        return _nothing(InertialReason.STILL, T_cw)
    rotation = align_rotations(timestamps, T_cw[:, :3, :3], samples, calibration, turn_std)
    rows = _stretch_rows(timestamps, samples, float(rotation.offset.detach()))
    if not rows:
        return _nothing(InertialReason.NO_OVERLAP, T_cw)
    stretches = _stretches(timestamps, T_cw, samples, calibration, rotation, rows)
    prior = _prior(calibration, rotation)
    counted = torch.ones(len(rows), dtype=torch.bool, device=T_cw.device)
    std = POSITION_STD if position_std is None else position_std
    for _ in range(WEIGHINGS if position_std is None else 1):
        with torch.no_grad():
            equations = _equations(stretches, std)
            solution = _solved(equations, prior, counted)
            if solution is None:
                return _nothing(InertialReason.NOT_DETERMINED, T_cw, rotation)
            mean = _squared(equations, solution) / equations.redundancy
            counted = mean <= OUTLYING * mean.median()
            total = (mean * equations.redundancy)[counted].sum() / equations.redundancy[counted].sum()
            if position_std is None:
                std = max(std * math.sqrt(float(total)), SMALLEST_POSITION_STD)
    equations = _equations(stretches, std)
    found = _with_gravity(equations, prior, counted)
    with torch.no_grad():
        relative_std, gravity_std = _errors(equations, prior, counted, found.detach())
    gravity_std = math.hypot(gravity_std, float(rotation.R_std.norm()))
    scale = found[0]
    reason = InertialReason.MEASURED
    if not (bool(scale > 0) and relative_std < WORST):
        reason = InertialReason.NOT_DETERMINED
    starts = timestamps[torch.tensor([each[0] for each in rows], device=timestamps.device)]
    return InertialAlignment(
        reason,
        scale,
        math.hypot(relative_std, SENSOR_STD),
        found[1:4],
        gravity_std,
        found[4:7],
        rotation,
        _lever(calibration, rotation.R_bc) + found[10:],
        std,
        int(counted.sum()),
        tuple(starts[~counted].tolist()),
    )


def lies_still(samples: InertialSamples, start: float, end: float) -> bool:
    """Whether the sensor neither turns nor is shaken between two times."""
    rows = (samples.timestamps >= start) & (samples.timestamps <= end)
    bins = ((samples.timestamps[rows] - start) / STILL_INTERVAL).long()
    if len(bins.unique()) < 2:
        return False
    values = torch.cat((samples.gyroscope, samples.accelerometer), dim=-1).detach()[rows]
    size = int(bins.max()) + 1
    counts = torch.bincount(bins, minlength=size)
    means = values.new_zeros(size, 6).index_add(0, bins, values)[counts > 0] / counts[counts > 0][:, None]
    turn, force = (x.norm() for x in means.std(dim=0).split(3))
    return bool(turn < STILL_TURN) and bool(force < STILL_FORCE)


def _nothing(
    reason: InertialReason, like: Tensor, rotation: InertialRotation | None = None
) -> InertialAlignment:
    zero = like.new_zeros(3)
    return InertialAlignment(
        reason, like.new_ones(()), math.inf, zero, math.inf, zero, rotation, zero, math.inf, 0
    )


def _lever(calibration: InertialCalibration, R_bc: Tensor) -> Float[Tensor, " 3"]:
    """The body's origin in the frame of the camera."""
    if calibration.T_bc is None:
        return R_bc.new_zeros(3)
    return -(calibration.T_bc[:3, :3].mT @ calibration.T_bc[:3, 3]).to(R_bc)


def _prior(calibration: InertialCalibration, rotation: InertialRotation) -> Float[Tensor, " 13"]:
    """The information of the common unknowns before they are measured."""
    std = rotation.bias.new_full((13,), math.inf)
    std[4:7], std[7:10] = BIAS_STD, rotation.bias_std
    std[10:] = UNKNOWN_LEVER_STD if calibration.T_bc is None else LEVER_STD
    return std**-2


def _stretch_rows(timestamps: Tensor, samples: InertialSamples, offset: float) -> list[list[int]]:
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
        limits = times[begin + 1] + duration / count * torch.arange(
            1, count, dtype=times.dtype, device="cpu"
        ).to(times)
        cuts = (torch.searchsorted(times[begin + 1 : end + 1], limits) + begin + 1).tolist()
        for first, last in zip([begin + 1, *cuts], [*cuts, end], strict=True):
            if float(times[last] - times[first]) >= SHORTEST_STRETCH and last + 1 - first >= FEWEST_NODES:
                stretches.append(rows[first : last + 1])
    return stretches


def _stretches(
    timestamps: Tensor,
    T_cw: Tensor,
    samples: InertialSamples,
    calibration: InertialCalibration,
    rotation: InertialRotation,
    rows: list[list[int]],
) -> _Stretches:
    """The equations of all stretches, padded by their last node."""
    size = max(map(len, rows))
    device = T_cw.device
    padded = torch.tensor([each + each[-1:] * (size - len(each)) for each in rows], device=device)
    lengths = torch.tensor([len(each) for each in rows], device=device)
    valid = torch.arange(size, device=device) < lengths[:, None]
    chained = _chained(timestamps[padded] + rotation.offset, samples, calibration, rotation.bias)
    T_wc = se3_inverse(T_cw)[padded]
    R_bw = _attitudes(T_wc[..., :3, :3] @ rotation.R_bc.mT, chained.R_ij, valid).mT[:, None]
    times, P = chained.duration, chained.position
    positions, arms = R_bw @ T_wc[..., :3, 3:], R_bw @ T_wc[..., :3, :3]
    eye = torch.eye(3, dtype=T_cw.dtype, device=device).expand(*valid.shape, 3, 3)
    seconds = times[..., None, None]
    half_squares = 0.5 * seconds.square()
    columns = torch.cat(
        (
            positions,
            -half_squares * R_bw,
            -chained.jacobian[..., :3, 3:],
            -chained.jacobian[..., :3, :3],
            arms,
        ),
        dim=-1,
    )
    right = P - (arms @ _lever(calibration, rotation.R_bc)[:, None]).squeeze(-1)
    return _Stretches(columns, right, torch.cat((eye, seconds * eye), dim=-1), _noise(chained), times, valid)


def _chained(
    times: Tensor, samples: InertialSamples, calibration: InertialCalibration, bias: Tensor
) -> Increments:
    """Increments from the start of each stretch to each of its nodes, (S, N)."""
    steps = inertial_steps(
        samples.timestamps,
        samples.gyroscope,
        samples.accelerometer,
        times[:, :-1].flatten(),
        times[:, 1:].flatten(),
    )
    parts = preintegrate(
        steps,
        torch.cat((bias, torch.zeros_like(bias))),
        calibration.gyroscope_density,
        calibration.accelerometer_density,
    )
    each = [x.unflatten(0, (len(times), -1)) for x in parts]
    total = Increments(*(torch.zeros_like(x[:, 0]) for x in each))
    total = total._replace(R_ij=total.R_ij + torch.eye(3, dtype=times.dtype, device=times.device))
    chain = [total]
    for node in range(times.shape[1] - 1):
        total = compose_increments(total, Increments(*(x[:, node] for x in each)))
        chain.append(total)
    return Increments(*(torch.stack(x, dim=1) for x in zip(*chain, strict=True)))


def _attitudes(R_wb: Tensor, chained: Tensor, valid: Tensor) -> Float[Tensor, "S 3 3"]:
    """Attitude of the body at the start of each stretch: the mean over its nodes of what the map says of it."""
    apart = R_wb @ chained.mT
    middle = apart[:, 0]
    weights = valid[..., None] / valid.sum(-1)[:, None, None]
    for _ in range(3):  # the mean on the manifold; the rotations are within a degree
        middle = so3_exp((weights * so3_log(apart @ middle.mT[:, None])).sum(1)) @ middle
    return middle


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


def _equations(stretches: _Stretches, position_std: float) -> _Equations:
    """Normal equations of each stretch, its motion at the start eliminated."""
    times, valid = stretches.times, stretches.valid
    eye = torch.eye(times.shape[1], dtype=times.dtype, device=times.device)
    drift = torch.minimum(times[:, :, None], times[:, None])
    seen = position_std**2 * (eye + DRIFT**2 * drift)
    axes = torch.eye(3, dtype=times.dtype, device=times.device)
    covariance = stretches.noise + seen[:, :, None, :, None] * axes[:, None]
    both = valid[:, :, None, None, None] & valid[:, None, None, :, None]
    covariance = torch.where(both, covariance, eye[:, None, :, None] * axes[:, None])
    root = torch.linalg.cholesky(covariance.flatten(3, 4).flatten(1, 2))
    joined = torch.cat((stretches.motion, stretches.columns, stretches.right[..., None]), dim=-1)
    joined = torch.where(valid[..., None, None], joined, 0.0).flatten(1, 2)
    white = torch.linalg.solve_triangular(root, joined, upper=False)
    basis = torch.linalg.qr(white[..., :6])[0]
    white = white[..., 6:] - basis @ (basis.mT @ white[..., 6:])
    A, y = white[..., :-1], white[..., -1:]
    return _Equations(
        A.mT @ A, (A.mT @ y).squeeze(-1), y.square().sum((1, 2)), 3.0 * valid.sum(-1).to(times) - 6
    )


def _squared(equations: _Equations, x: Tensor) -> Float[Tensor, " S"]:
    """Squared whitened residuals of each stretch."""
    along = (equations.hessian @ x - 2 * equations.right) @ x
    return (equations.squared + along).clamp_min(0)


def _solved(equations: _Equations, prior: Tensor, counted: Tensor) -> Tensor | None:
    """The minimum with gravity of any length; None where it is not determined."""
    hessian = (equations.hessian * counted[:, None, None]).sum(0) + torch.diag(prior)
    root, info = torch.linalg.cholesky_ex(hessian)
    if int(info) > 0:
        return None
    right = (equations.right * counted[:, None]).sum(0)
    return torch.cholesky_solve(right[:, None], root).squeeze(-1)


def _with_gravity(equations: _Equations, prior: Tensor, counted: Tensor) -> Float[Tensor, " 13"]:
    """The minimum with gravity of nearly the length that it has on Earth, differentiable."""
    hessian = (equations.hessian * counted[:, None, None]).sum(0) + torch.diag(prior)
    right = (equations.right * counted[:, None]).sum(0)
    x = torch.linalg.solve(hessian, right).detach()
    for step in range(GRAVITY_STEPS):
        exact = step == GRAVITY_STEPS - 1  # whose gradient is that of the minimum
        length = x[1:4].norm()
        down = x[1:4] / length
        gradient = hessian @ x - right
        gradient = gradient + _in_gravity((length - GRAVITY) / GRAVITY_STD**2 * down)
        curved = down[:, None] * down
        if exact:
            eye = torch.eye(3, dtype=x.dtype, device=x.device)
            curved = curved + (1 - GRAVITY / length) * (eye - curved)
        curved = _in_gravity(_in_gravity(curved / GRAVITY_STD**2).mT)
        x = x - torch.linalg.solve(hessian + curved, gradient)
        x = x if exact else x.detach()
    return x


def _in_gravity(x: Float[Tensor, "*rows 3"]) -> Float[Tensor, "*rows 13"]:
    """Of the common unknowns, whose second to fourth ones are gravity."""
    return torch.nn.functional.pad(x, (1, 9))


def _errors(equations: _Equations, prior: Tensor, counted: Tensor, x: Tensor) -> tuple[float, float]:
    """Standard errors of the scale, relative, and of gravity's direction, rad.

    Both grow where the scales of single stretches, with all else as found, differ by more than they should.
    """
    hessian = (equations.hessian * counted[:, None, None]).sum(0) + torch.diag(prior)
    down = x[1:4] / x[1:4].norm()
    hessian = hessian + _in_gravity(_in_gravity(down[:, None] * down / GRAVITY_STD**2).mT)
    covariance = torch.linalg.inv(hessian)
    growth = 1.0
    if int(counted.sum()) > 1:
        information = equations.hessian[counted, 0, 0]
        apart = (equations.right - equations.hessian @ x)[counted, 0] / information
        growth = max(1.0, float((information * apart.square()).sum()) / (int(counted.sum()) - 1)) ** 0.5
    across = torch.eye(3, dtype=x.dtype, device=x.device) - down[:, None] * down
    tilt = (across @ covariance[1:4, 1:4] @ across).diagonal().sum().clamp_min(0).sqrt() / x[1:4].norm()
    return growth * float(covariance[0, 0].sqrt() / x[0].abs()), growth * float(tilt)
