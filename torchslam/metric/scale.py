"""What measurements from outside say about the unit of a map: meters per unit, each with its error.

One camera determines a map up to a similarity. A marker, a known length, positions, speeds or an inertial sensor each
measure how many meters its unit has. Their logarithms are Gaussian, so that they are combined by their information.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum

import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.errors import MeasurementError

MAX_DISAGREEMENT = 3.0
"""Standard errors by which two measurements may differ before they count as a contradiction: .3 % of right pairs do."""


class ScaleSource(StrEnum):
    """Where a measurement of the scale comes from."""

    MARKER = "marker"
    DISTANCE = "distance"
    CAMERA_HEIGHT = "camera height"
    POSITION = "position"
    INERTIAL = "inertial"
    SPEED = "speed"
    ODOMETRY = "odometry"
    DEPTH = "depth"
    MAP = "map"
    """A map in meters that the session goes on with."""


@dataclass(frozen=True)
class ScaleMeasurement:
    """The measurement of the unit of one submap by one source.

    Attributes:
        source: where it comes from.
        meters_per_unit: meters that one unit of the map has.
        relative_std: its relative standard error, the disagreement of the single measurements included.
        count: single measurements that count, such as markers or fixes.
        unit: what is counted, in the plural, such as "markers".
        apart: relative standard deviation of the single measurements; None where it is not known.
        rejected: one line for each single measurement, or group of them, that contradicts the others.
        up_w: unit vector against gravity in the frame of the map; None where the source does not say.
        up_std: its standard error, radians.
        S_ew: similarity from the map to a metric frame of the source (east, north, up), scale in the rotation block;
            None where the source has no such frame.
        origin: latitude and longitude in degrees and altitude in meters (WGS84) of the origin of that frame; None where
            it is nowhere on earth.
        notes: remarks for the user, one line each.
    """

    source: ScaleSource
    meters_per_unit: float
    relative_std: float
    count: int
    unit: str
    rejected: tuple[str, ...] = ()
    up_w: Float[Tensor, " 3"] | None = None
    up_std: float = math.inf
    S_ew: Float[Tensor, "4 4"] | None = None
    origin: tuple[float, float, float] | None = None
    apart: float | None = None
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not (0 < self.meters_per_unit < math.inf and 0 < self.relative_std < math.inf):
            raise MeasurementError(
                f"a scale of {self.meters_per_unit} with an error of {self.relative_std} is no measurement"
            )


@dataclass(frozen=True)
class CombinedScale:
    """The unit of a submap from all its measurements.

    Attributes:
        meters_per_unit: meters that one unit of the map has.
        relative_std: its relative standard error.
        measurements: those it is made of.
        contradictions: one line for each two measurements that differ by more than their errors allow.
    """

    meters_per_unit: float
    relative_std: float
    measurements: tuple[ScaleMeasurement, ...]
    contradictions: tuple[str, ...] = field(default=())


def combine_scales(measurements: Sequence[ScaleMeasurement]) -> CombinedScale:
    """Average the logarithms of the scales, weighted by their information.

    Where measurements contradict each other, the error grows by their disagreement (the Birge ratio, 1932), and each
    contradiction is listed.

    Raises:
        MeasurementError: there is no measurement.
    """
    if not measurements:
        raise MeasurementError("there is no measurement of the scale")
    logs = torch.tensor(
        [math.log(m.meters_per_unit) for m in measurements], dtype=torch.float64, device="cpu"
    )
    information = torch.tensor([m.relative_std**-2 for m in measurements], dtype=torch.float64, device="cpu")
    mean = (information * logs).sum() / information.sum()
    birge = 1.0
    if len(measurements) > 1:
        chi_square = float((information * (logs - mean).square()).sum())
        birge = max(1.0, math.sqrt(chi_square / (len(measurements) - 1)))
    return CombinedScale(
        math.exp(float(mean)),
        birge / math.sqrt(float(information.sum())),
        tuple(measurements),
        tuple(_contradictions(measurements)),
    )


def _contradictions(measurements: Sequence[ScaleMeasurement]) -> list[str]:
    """One line for each two measurements that differ by more than `MAX_DISAGREEMENT`."""
    lines = []
    for one, other in itertools.combinations(measurements, 2):
        off = math.log(one.meters_per_unit / other.meters_per_unit)
        std = math.hypot(one.relative_std, other.relative_std)
        if abs(off) > MAX_DISAGREEMENT * std:
            lines.append(
                f"{one.source} and {other.source} contradict each other: "
                f"{one.meters_per_unit:.4g} ± {one.relative_std:.1%} and "
                f"{other.meters_per_unit:.4g} ± {other.relative_std:.1%} meters per unit"
            )
    return lines
