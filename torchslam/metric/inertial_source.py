"""An inertial sensor as a source of meters: its scale and gravity, or why there are none."""

from __future__ import annotations

import math

import torch

from torchslam.data.formats.imu_files import read_imu, read_inertial_calibration
from torchslam.data.inertial import InertialCalibration, InertialSamples
from torchslam.errors import MeasurementError
from torchslam.metric.inertial import InertialAlignment, InertialReason, align_inertial
from torchslam.metric.options import Given
from torchslam.metric.source import ScaleMeasurement, ScaleSource, SubmapView, Unmeasured


class InertialSource:
    """Samples of an inertial sensor that moves with the camera.

    Attributes:
        samples: of the sensor.
        calibration: how it is mounted, as far as that is known.
    """

    def __init__(self, samples: InertialSamples, calibration: InertialCalibration | None = None) -> None:
        self.samples = samples
        self.calibration = InertialCalibration() if calibration is None else calibration

    def measure(self, view: SubmapView) -> ScaleMeasurement | Unmeasured:
        """Measure the unit of a submap and its vertical.

        Raises:
            MeasurementError: images and samples have no time in common, or the rates another unit.
        """
        timestamps, T_cw = view.timestamps.cpu().double(), view.T_cw.cpu().double()
        self._check_times(timestamps)
        found = align_inertial(timestamps, T_cw, self.samples, self.calibration)
        if found.reason is not InertialReason.MEASURED:
            return Unmeasured(ScaleSource.INERTIAL, reason_of(found))
        down = found.gravity_w / found.gravity_w.norm()
        return ScaleMeasurement(
            ScaleSource.INERTIAL,
            float(found.meters_per_unit),
            found.relative_std,
            found.stretches,
            "stretches",
            tuple(f"the stretch from {time:.2f} s on contradicts the others" for time in found.rejected),
            up_w=-down,
            up_std=found.gravity_std,
            notes=_notes(found),
        )

    def _check_times(self, timestamps: torch.Tensor) -> None:
        samples, offset = self.samples.timestamps, self.calibration.offset
        if not len(timestamps):
            return
        first, last = float(timestamps[0]) + offset, float(timestamps[-1]) + offset
        if first > float(samples[-1]) or last < float(samples[0]):
            raise MeasurementError(
                f"{self.samples.source}: samples from {float(samples[0]):.3f} to {float(samples[-1]):.3f} s, but "
                f"images from {first:.3f} to {last:.3f} s: both need the same clock"
            )


def _notes(found: InertialAlignment) -> tuple[str, ...]:
    """The estimates of the sensor."""
    if found.rotation is None:
        return ()
    turn = math.degrees(float(found.rotation.bias.norm()))
    return (
        f"inertial sensor: bias of the gyroscope {turn:.3f} degrees/s, of the accelerometer "
        f"{float(found.accelerometer_bias.norm()):.3f} m/s^2; its clock differs by "
        f"{1e3 * float(found.rotation.offset):+.1f} ms; it is {float(found.lever_c.norm()):.3f} m from the camera",
    )


def reason_of(found: InertialAlignment) -> str:
    """Why there is no scale, for the user."""
    if found.reason is InertialReason.NOT_DETERMINED and found.relative_std < 1:
        return f"{found.reason}: its scale is uncertain by {found.relative_std:.0%}"
    return str(found.reason)


def from_options(given: Given) -> list[InertialSource]:
    """The source of `--imu FILE --imu-camera FILE`.

    Raises:
        MeasurementError: a file is wrong, or there are two sensors.
    """
    if len(given["imu"]) > 1:
        raise MeasurementError("--imu is given twice; one sensor can be used")
    imu = given["imu"][0][0]
    camera = given["imu_camera"][-1][0] if "imu_camera" in given else None
    return [InertialSource(read_imu(imu), read_inertial_calibration(camera, imu))]
