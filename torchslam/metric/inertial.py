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

import math
from dataclasses import dataclass, field
from enum import StrEnum

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchslam.data.inertial import InertialCalibration, InertialSamples, read_imu, read_inertial_calibration
from torchslam.errors import MeasurementError
from torchslam.metric.inertial_equations import (
    equations_of,
    lever_arm,
    minimum,
    prior_information,
    squared_residuals,
    standard_errors,
    stretch_rows,
    stretches_of,
)
from torchslam.metric.inertial_mounting import other_readings
from torchslam.metric.inertial_rotation import InertialRotation, align_rotations
from torchslam.metric.options import Given
from torchslam.metric.source import ScaleMeasurement, ScaleSource, SubmapView, Unmeasured

EDGE = 0.05
"""Seconds from the first and the last sample within which frames are left out, for the clocks may be apart."""
SHORTEST, FEWEST_FRAMES = 3.0, 12
"""Seconds and posed frames; in less time gravity and the sensor's bias cannot be told from acceleration."""
POSITION_STD, SMALLEST_POSITION_STD = 5e-3, 1e-4
"""Meters: the standard error of a position with which the search begins, and the least one."""
WEIGHINGS = 5
"""Rounds that find the standard error of positions from 5 mm; the fifth one changes 0.4 mm by 0.2 %."""
SENSOR_STD = 1e-2
"""Relative error of the accelerometer's scale factor, which nothing here can find. Data sheets allow up to 3 % (initial
calibration tolerance of the MPU-6050). With the true poses of a drone, the scale of its sensor is off by 0.5 %."""
WORST = 0.1  # relative standard error from which on a scale counts as not determined
STILL_INTERVAL = 0.25
"""Seconds over which rates and forces are averaged: a drone's motors shake it by 0.8 m/s^2 while it stands."""
STILL_TURN, STILL_FORCE = 0.02, 0.1
"""rad/s and m/s^2: spread of the averages of a sensor that does not move. A drone on the ground with its motors on has
0.005 and 0.04, one that is carried 0.17 and 0.75 at least."""
OUTLYING = 9.0
"""Mean squared residual of a stretch, in units of the median one, from which on it contradicts the others."""


class InertialReason(StrEnum):
    """Outcome of the inertial alignment."""

    MEASURED = "measured"
    NO_OVERLAP = "no three seconds of posed frames lie within the times of the samples"
    STILL = "the camera does not move: the sensor neither turns nor accelerates"
    NOT_DETERMINED = "the motion has too little acceleration"


@dataclass(frozen=True)
class InertialAlignment:
    """Scale, gravity and the sensor's parameters. Without a gradient, and not to be used, unless it is `MEASURED`.

    Attributes:
        meters_per_unit, relative_std: of the map, and its standard error.
        gravity_w, gravity_std: in the frame of the map, m/s^2, pointing down; standard error of its direction, rad.
        accelerometer_bias: m/s^2.
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


def align_inertial(
    timestamps: Float[Tensor, " K"],
    T_cw: Float[Tensor, "K 4 4"],
    samples: InertialSamples,
    calibration: InertialCalibration,
    *,
    turn_std: float | None = None,
    position_std: float | None = None,
) -> InertialAlignment:
    """Scale and gravity of poses in an arbitrary unit, at ascending times in seconds.

    Differentiable in poses and samples. The stated errors contain the noise of both sensors, the disagreement of
    stretches, and `SENSOR_STD`. Raises MeasurementError if the rates are in another unit.

    Args:
        turn_std: rad, of the camera's turns over `TURN_INTERVAL`.
        position_std: meters, of its positions. None: those of the residuals, which have no gradient.
    """
    inside = within(timestamps, samples, calibration)
    timestamps, T_cw = timestamps[inside], T_cw[inside]
    if len(timestamps) < FEWEST_FRAMES or timestamps[-1] - timestamps[0] < SHORTEST:
        return _nothing(InertialReason.NO_OVERLAP, T_cw)
    if lies_still(samples, float(timestamps[0]), float(timestamps[-1])):
        return _nothing(InertialReason.STILL, T_cw)
    rotation = align_rotations(timestamps, T_cw[:, :3, :3], samples, calibration, turn_std)
    rows = stretch_rows(timestamps, samples, float(rotation.offset.detach()))
    if not rows:
        return _nothing(InertialReason.NO_OVERLAP, T_cw)
    stretches = stretches_of(timestamps, T_cw, samples, calibration, rotation, rows)
    prior = prior_information(calibration, rotation)
    counted = torch.ones(len(rows), dtype=torch.bool, device=T_cw.device)
    std = POSITION_STD if position_std is None else position_std
    for _ in range(WEIGHINGS if position_std is None else 1):
        with torch.no_grad():
            equations = equations_of(stretches, std)
            solution = minimum(equations.summed(counted, prior))
            if solution is None:
                return _nothing(InertialReason.NOT_DETERMINED, T_cw, rotation)
            mean = squared_residuals(equations, solution) / equations.redundancy
            counted = mean <= OUTLYING * mean.median()
            total = (mean * equations.redundancy)[counted].sum() / equations.redundancy[counted].sum()
            if position_std is None:
                std = max(std * math.sqrt(float(total)), SMALLEST_POSITION_STD)
    equations = equations_of(stretches, std)
    found = minimum(equations.summed(counted, prior))
    if found is None:
        return _nothing(InertialReason.NOT_DETERMINED, T_cw, rotation)
    with torch.no_grad():
        relative_std, gravity_std = standard_errors(equations, prior, counted, found)
    gravity_std = math.hypot(gravity_std, float(rotation.R_std.norm()))
    scale = found[0]
    is_determined = bool(scale > 0) and relative_std < WORST
    starts = timestamps[torch.tensor([each[0] for each in rows], device=timestamps.device)]
    return InertialAlignment(
        InertialReason.MEASURED if is_determined else InertialReason.NOT_DETERMINED,
        scale,
        math.hypot(relative_std, SENSOR_STD),
        found[1:4],
        gravity_std,
        found[4:7],
        rotation,
        lever_arm(calibration, rotation.R_bc) + found[10:],
        std,
        int(counted.sum()),
        tuple(starts[~counted].tolist()),
    )


def within(
    timestamps: Float[Tensor, " K"], samples: InertialSamples, calibration: InertialCalibration
) -> Bool[Tensor, " K"]:
    """Which times lie within those of the samples."""
    times = timestamps + calibration.offset
    return (times > samples.timestamps[0] + EDGE) & (times < samples.timestamps[-1] - EDGE)


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


@dataclass(frozen=True)
class InertialSource:
    """Samples of an inertial sensor that moves with the camera."""

    samples: InertialSamples
    calibration: InertialCalibration = field(default_factory=InertialCalibration)

    def measure(self, view: SubmapView) -> ScaleMeasurement | Unmeasured:
        """Measure the unit of a submap and its vertical.

        Raises MeasurementError if images and samples have no time in common, or the rates another unit.
        """
        timestamps, T_cw = view.timestamps.cpu().double(), view.T_cw.cpu().double()
        if len(timestamps):
            start, end = (float(self.samples.timestamps[row]) for row in (0, -1))
            first, last = (float(timestamps[row]) + self.calibration.offset for row in (0, -1))
            if first > end or last < start:
                raise MeasurementError(
                    f"{self.samples.source}: samples from {start:.3f} to {end:.3f} s, but images from {first:.3f} to "
                    f"{last:.3f} s: both need the same clock"
                )
        found = align_inertial(timestamps, T_cw, self.samples, self.calibration)
        if found.reason is not InertialReason.MEASURED or found.rotation is None:
            undetermined = found.reason is InertialReason.NOT_DETERMINED
            if undetermined and (other := self._fitting(timestamps, T_cw)):
                return Unmeasured(
                    ScaleSource.INERTIAL,
                    f"the samples do not fit the motion of the camera, but do with {other}: change the file of the "
                    "samples or of the mounting",
                )
            uncertain = undetermined and found.relative_std < 1
            more = f": its scale is uncertain by {found.relative_std:.0%}" if uncertain else ""
            return Unmeasured(ScaleSource.INERTIAL, "; ".join([f"{found.reason}{more}", *self.samples.notes]))
        turn = math.degrees(float(found.rotation.bias.norm()))
        note = (
            f"inertial sensor: bias of the gyroscope {turn:.3f} degrees/s, of the accelerometer "
            f"{float(found.accelerometer_bias.norm()):.3f} m/s^2; its clock differs by "
            f"{1e3 * float(found.rotation.offset):+.1f} ms; it is {float(found.lever_c.norm()):.3f} m from the camera"
        )
        return ScaleMeasurement(
            ScaleSource.INERTIAL,
            float(found.meters_per_unit),
            found.relative_std,
            found.stretches,
            "stretches",
            tuple(f"the stretch from {time:.2f} s on contradicts the others" for time in found.rejected),
            up_w=-found.gravity_w / found.gravity_w.norm(),
            up_std=found.gravity_std,
            notes=(*self.samples.notes, note),
        )

    def _fitting(self, timestamps: Float[Tensor, " K"], T_cw: Float[Tensor, "K 4 4"]) -> str:
        """Another reading of the samples and the mounting with which the scale is determined; empty without one."""
        inside = within(timestamps, self.samples, self.calibration)
        for words, samples, calibration in other_readings(
            timestamps[inside], T_cw[inside], self.samples, self.calibration
        ):
            if align_inertial(timestamps, T_cw, samples, calibration).reason is InertialReason.MEASURED:
                return words
        return ""


def from_options(given: Given) -> list[InertialSource]:
    """The source of `--imu FILE --imu-camera FILE`. Raises MeasurementError if there are two sensors."""
    if len(given["imu"]) > 1:
        raise MeasurementError("--imu is given twice; one sensor can be used")
    imu = given["imu"][0][0]
    camera = given["imu_camera"][-1][0] if "imu_camera" in given else None
    return [InertialSource(read_imu(imu), read_inertial_calibration(camera, imu))]
