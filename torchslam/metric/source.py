"""The interface of a source of metric measurements: from a finished submap to a measurement of its unit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchslam.geometry import Camera
from torchslam.geometry.rolling_shutter import Readout
from torchslam.map.atlas import Submap
from torchslam.metric.scale import ScaleMeasurement, ScaleSource


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


@dataclass(frozen=True)
class Unmeasured:
    """A source without a result for a submap.

    Attributes:
        source: which one.
        reason: why, for the user, such as "the camera does not move".
    """

    source: ScaleSource
    reason: str


class MetricSource(Protocol):
    """A source of measurements, such as markers, the positions of a GPS file, or an inertial sensor."""

    def measure(self, view: SubmapView) -> ScaleMeasurement | Unmeasured:
        """Measure the unit of a submap.

        Raises:
            MeasurementError: the measurements themselves are wrong, for whatever submap. The run ends with its results
                in an arbitrary unit, and with this message.
        """
