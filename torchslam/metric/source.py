"""The interface of a source of metric measurements: from a finished submap to a measurement of its unit.

One camera determines a map up to a similarity. A marker, a known length, positions, speeds or an inertial sensor each
measure how many meters its unit has.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchslam.data.text_file import parse_number
from torchslam.errors import FrameError, MeasurementError
from torchslam.geometry import Camera
from torchslam.geometry.rolling_shutter import Readout
from torchslam.map.atlas import Submap


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
        meters_per_unit: length of a map unit, meters.
        relative_std: its relative standard error, the disagreement of the single measurements included.
        count, unit: how many single measurements count, and what they are, in the plural, such as 12 "markers".
        rejected: one line for each single measurement, or group of them, that contradicts the others.
        up_w: unit vector against gravity in the frame of the map; None where the source does not determine it.
        up_std: its standard error, radians.
        S_ew: similarity from the map to a metric frame of the source (east, north, up), scale in the rotation block;
            None where the source has no such frame.
        origin: latitude and longitude in degrees and altitude in meters (WGS84) of the origin of that frame; None where
            it is nowhere on earth.
        apart: relative standard deviation of the single measurements; None where it is not known.
        notes: remarks for the user, one line each.
        stated: what the user gave, such as the sizes of markers; named where another source contradicts it.
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
    stated: str = ""

    def __post_init__(self) -> None:
        if not (0 < self.meters_per_unit < math.inf and 0 < self.relative_std < math.inf):
            raise MeasurementError(
                f"a scale of {self.meters_per_unit} with an error of {self.relative_std} is no measurement"
            )


@dataclass(frozen=True)
class Unmeasured:
    """A source without a result for a submap, and the reason, such as "the camera does not move"."""

    source: ScaleSource
    reason: str


class Images(Protocol):
    """The images of a session by the indices of its frames, such as a `Sequence`."""

    @property
    def brings_features(self) -> bool:
        """True if the frames come with features, and images are not used."""

    def image(self, index: int) -> Float[Tensor, "1 1 H W"]:
        """Return a gray image in [0, 1]. Raises FrameError if it cannot be read."""

    def file_name(self, index: int) -> str:
        """Return the file of a frame below the folder of all; empty if frames are no files."""


@dataclass(frozen=True)
class SubmapView:
    """A submap after its final adjustment, as one session sees it. Its unit is arbitrary.

    Attributes:
        submap: map and posed frames.
        camera: of all frames.
        session: the session whose frames the measurements belong to.
        sequence: the images of the session; None where they are not available.
        readout: of a rolling shutter; None: a global one.
    """

    submap: Submap
    camera: Camera
    session: int = 0
    sequence: Images | None = None
    readout: Readout | None = None

    @property
    def rows(self) -> Int[Tensor, " K"]:
        """Rows of the session's frames in `submap.posed_frames`, in the order of time."""
        frames = self.submap.posed_frames.frames
        own = torch.nonzero(frames["session"] == self.session)[:, 0]
        return own[torch.argsort(frames["timestamp"][own], stable=True)]

    @property
    def timestamps(self) -> Float[Tensor, " K"]:
        """Seconds, ascending, of the session's posed frames."""
        return self.submap.posed_frames.frames["timestamp"][self.rows]

    @property
    def frame_index(self) -> Int[Tensor, " K"]:
        """Indices of the same frames in the sequence."""
        return self.submap.posed_frames.frames["frame_index"][self.rows]

    @property
    def T_cw(self) -> Float[Tensor, "K 4 4"]:
        """Poses of the same frames, world to camera, in the arbitrary unit of the submap."""
        return self.submap.posed_frames.T_cw(self.submap.map)[self.rows]

    @property
    def has_images(self) -> bool:
        """Whether there are images to look at."""
        return self.sequence is not None and not self.sequence.brings_features

    def grays(self, rows: list[int]) -> dict[int, Float[np.ndarray, "H W"]]:
        """The images of rows of the view that can be read, gray in [0, 1]."""
        images = {row: self.gray(int(self.frame_index[row])) for row in rows}
        return {row: image for row, image in images.items() if image is not None}

    def gray(self, frame_index: int) -> Float[np.ndarray, "H W"] | None:
        """The image of a frame, gray in [0, 1]; None if there is none, or it cannot be read."""
        try:
            return None if self.sequence is None else self.sequence.image(frame_index)[0, 0].cpu().numpy()
        except FrameError:
            return None


class MetricSource(Protocol):
    """A source of measurements, such as markers, the positions of a GPS file, or an inertial sensor."""

    def measure(self, view: SubmapView) -> ScaleMeasurement | Unmeasured:
        """Measure the unit of a submap.

        Raises:
            MeasurementError: the measurements themselves are wrong, for whatever submap. The run ends with its results
                in an arbitrary unit, and with this message.
        """


def parse_length(text: str, whole: str, least: float, most: float) -> float:
    """Read a length of an option, meters. Raises MeasurementError, with the `whole` option, for an impossible one."""
    length = parse_number(text, f"{whole}: no length in meters (sizes are in meters)", MeasurementError)
    if not least <= length <= most:
        hint = f"; {text} mm are {length / 1000:g}" if length > most else ""
        raise MeasurementError(
            f"{whole}: {text} is no length in meters; sizes are in meters, from {least:g} to {most:g}{hint}"
        )
    return length
