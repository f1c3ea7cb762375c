"""Samples of an inertial sensor, and how it is mounted on the camera."""

from __future__ import annotations

import math
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from torchslam.errors import MeasurementError


@dataclass(frozen=True)
class InertialSamples:
    """What an inertial sensor measures, in its own frame, which is called the body's.

    Attributes:
        timestamps: seconds, strictly increasing.
        gyroscope: angular rates, rad/s.
        accelerometer: specific forces, m/s^2; at rest they point up.
        source: the file, for messages.
    """

    timestamps: Float[Tensor, " M"]
    gyroscope: Float[Tensor, "M 3"]
    accelerometer: Float[Tensor, "M 3"]
    source: str = "inertial samples"

    def __post_init__(self) -> None:
        if len(self.timestamps) < 2:
            raise MeasurementError(f"{self.source}: {len(self.timestamps)} samples; at least two are needed")
        if not bool((self.timestamps.detach().diff() > 0).all()):
            raise MeasurementError(f"{self.source}: the times of the samples do not increase")


@dataclass(frozen=True)
class InertialCalibration:
    """How an inertial sensor is mounted, and its noise.

    Attributes:
        T_bc: camera to body, meters; None: neither the rotation nor the lever arm is known.
        gyroscope_density: white noise of the gyroscope, rad/s/sqrt(Hz).
        accelerometer_density: white noise of the accelerometer, m/s^2/sqrt(Hz).
        offset: seconds to add to times of the camera for those of the sensor, as far as they are known.
    """

    T_bc: Float[Tensor, "4 4"] | None = None
    gyroscope_density: float = 5e-4
    accelerometer_density: float = 5e-3
    offset: float = 0.0

    def __post_init__(self) -> None:
        for name in ("gyroscope_density", "accelerometer_density"):
            if not 0 < getattr(self, name) < math.inf:
                raise MeasurementError(f"{name} must be above zero, not {getattr(self, name)}")
