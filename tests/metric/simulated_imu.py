"""An inertial sensor on a smooth way whose truth is known."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.data.inertial import InertialCalibration, InertialSamples
from torchslam.geometry import rigid, se3_inverse, so3_exp, so3_log

GRAVITY_E = torch.tensor([0.0, 0.0, -9.807], dtype=torch.float64)
R_WE = so3_exp(torch.tensor([0.4, -0.9, 0.3], dtype=torch.float64))
"""From the frame in which gravity is -z to that of the map."""
T_BC = rigid(
    so3_exp(torch.tensor([1.1, -0.3, 0.8], dtype=torch.float64)),
    torch.tensor([0.06, -0.03, 0.02], dtype=torch.float64),
)


@dataclass(frozen=True)
class Simulation:
    """What align_inertial takes, and the truth.

    Attributes:
        timestamps: of the camera, seconds.
        T_cw: poses in a unit of `meters_per_unit`.
        meters_per_unit: the true scale.
        gravity_w: in the frame of the map.
        bias: of gyroscope and accelerometer.
        offset: seconds to add to times of the camera.
    """

    timestamps: Float[Tensor, " K"]
    T_cw: Float[Tensor, "K 4 4"]
    samples: InertialSamples
    calibration: InertialCalibration
    meters_per_unit: float
    gravity_w: Float[Tensor, " 3"]
    bias: Float[Tensor, " 6"]
    offset: float


def waves(times: Tensor, rows: list[tuple[float, float, float]]) -> Tensor:
    """Sums of sines: amplitude, angular frequency and phase of each axis, with its third harmonic."""
    return torch.stack(
        [a * torch.sin(w * times + f) + 0.1 * a * torch.sin(2.7 * w * times + 2 * f) for a, w, f in rows], -1
    )


def body_poses(times: Tensor, size: float) -> tuple[Tensor, Tensor]:
    """R_eb and the position, meters."""
    turn = size * waves(times, [(0.5, 1.3, 0.2), (0.4, 0.9, 1.0), (0.6, 0.7, -0.4)])
    position = size * waves(times, [(0.6, 1.9, 0.0), (0.4, 2.3, 0.7), (0.3, 1.6, 2.0)])
    return so3_exp(turn), position


def simulate(
    seconds: float = 12.0,
    size: float = 1.0,
    meters_per_unit: float = 3.7,
    offset: float = 0.0,
    bias: tuple[float, ...] = (0.01, -0.02, 0.015, 0.08, -0.05, 0.1),
    position_noise: float = 0.0,
    turn_noise: float = 0.0,
    sensor_noise: bool = False,
    seed: int = 0,
) -> Simulation:
    """A camera of 20 Hz and a sensor of 200 Hz; `size` scales the motion, noise is in meters and rad."""
    generator = torch.Generator().manual_seed(seed)

    def noise(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    period, h = 0.005, 1e-4
    times = torch.arange(-0.5, seconds + 0.5, period, dtype=torch.float64)
    before, now, after = (body_poses(times + shift, size) for shift in (-h, 0.0, h))
    rates = so3_log(before[0].mT @ after[0]) / (2 * h)
    acceleration = (after[1] - 2 * now[1] + before[1]) / (h * h)
    forces = (now[0].mT @ (acceleration - GRAVITY_E)[..., None]).squeeze(-1)
    true_bias = torch.tensor(bias, dtype=torch.float64)
    rates, forces = rates + true_bias[:3], forces + true_bias[3:]
    calibration = InertialCalibration(T_BC, 1.7e-4, 2e-3)
    if sensor_noise:
        rates = rates + calibration.gyroscope_density / period**0.5 * noise(len(times), 3)
        forces = forces + calibration.accelerometer_density / period**0.5 * noise(len(times), 3)
    camera_times = torch.arange(0.0, seconds, 0.05, dtype=torch.float64)
    R_eb, position = body_poses(camera_times, size)
    T_ec = rigid(R_eb, position) @ T_BC
    R_wc = R_WE @ T_ec[:, :3, :3] @ so3_exp(turn_noise * noise(len(camera_times), 3))
    centers = T_ec[:, :3, 3] + position_noise * noise(len(camera_times), 3)
    T_wc = rigid(R_wc, (centers @ R_WE.mT) / meters_per_unit + 0.3)
    return Simulation(
        1000.0 + camera_times,
        se3_inverse(T_wc),
        InertialSamples(1000.0 + times + offset, rates, forces),
        calibration,
        meters_per_unit,
        R_WE @ GRAVITY_E,
        true_bias,
        offset,
    )
