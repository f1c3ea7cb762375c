"""Stretches of a few seconds of a camera's way with what an inertial sensor integrates to along them.

The equation of `metric.inertial`, in the frame of the body at the start of each stretch.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchslam.data.inertial import InertialCalibration, InertialSamples
from torchslam.geometry import (
    Increments,
    compose_increments,
    inertial_steps,
    preintegrate,
    se3_inverse,
    skew,
    so3_exp,
    so3_log,
)
from torchslam.metric.inertial_rotation import InertialRotation, thinned

STRETCH = 4.0
"""Seconds of a stretch. With 2, 4, 8 s the scale of parts of 8 s of a drone's recording is off by .61, .58, .56 %."""
NODE_INTERVAL = 0.05
"""Seconds between positions that are compared; more of them in a second say the same of the drift again."""
LONGEST_INTERVAL = 1.0
"""Seconds between two posed frames from which on a stretch ends: the map knows nothing of the way in between."""
LONGEST_GAP = 0.1
"""Seconds between two samples from which on some are missing: an order of magnitude above the period of any sensor."""
SHORTEST_STRETCH = 1.0
"""Seconds; below, an acceleration is lost in the velocity that is not known."""
FEWEST_NODES = 8
"""Positions of a stretch: six numbers of each coordinate go to the motion that is not known."""
ATTITUDE_STD = 1e-3
"""rad, by which the attitude of a stretch differs from that of the map. With 0, 1e-3 and 3e-3 gravity of a drone's
recording is off by 0.48, 0.23 and 0.23 degrees, and the scale by the same."""


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
        limits = times[begin + 1] + duration / count * torch.arange(
            1, count, dtype=times.dtype, device="cpu"
        ).to(times)
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
    right = P - (arms @ lever_arm(calibration, rotation.R_bc)[:, None]).squeeze(-1)
    return Stretches(columns, right, torch.cat((eye, seconds * eye), dim=-1), _noise(chained), times, valid)


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
    """Attitude of the body at the start of each stretch: the mean over its nodes, by the map."""
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
