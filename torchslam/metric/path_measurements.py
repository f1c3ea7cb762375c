"""What sources measured of single parts of a path, and its place in the observation graph of a submap in meters.

A source says how many meters the unit of a map has. Where it also says which part of the path it knows this from, the
parts can be told apart: they correct the drift of the scale along the path. Parts are given by their times, and become
measurements of keyframes (`torchslam.optim.measurements`) once the map is in meters.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchslam.geometry import transform
from torchslam.map.map import Map
from torchslam.metric.receiver_noise import slow_covariances
from torchslam.metric.slow_noise import group_means
from torchslam.optim.measurements import MeasuredLengths, MeasuredPositions, Measurement

MAX_POSITIONS = 1000
"""Positions that correct a path: their covariance is dense. Of more, evenly spread ones are used."""
LEAST_KEYFRAMES = 2
"""Keyframes without which no part of a path has a length."""


class Path(Protocol):
    """The path of the camera between its poses, such as a `CameraPath`."""

    def at(
        self, times: Float[Tensor, "*shape"]
    ) -> tuple[Float[Tensor, "*shape 3"], Float[Tensor, "*shape 3"], Bool[Tensor, "*shape"]]:
        """Positions and velocities at times, and whether they are known."""


@dataclass(frozen=True)
class Keyframes:
    """The keyframes of a session in a submap, in the order of time.

    Attributes:
        path: through all posed frames of the session.
        rows: of the keyframes in the map, which are those of its observation graph.
        timestamps: seconds, ascending.
        T_cw: world to camera, float64 on the CPU.
        meters_per_unit: of the map as it was when the sources measured, whose poses are in meters now.
    """

    path: Path
    rows: Int[Tensor, " K"]
    timestamps: Float[Tensor, " K"]
    T_cw: Float[Tensor, "K 4 4"]
    meters_per_unit: float

    @classmethod
    def of(cls, path: Path, slam_map: Map, session: int, meters_per_unit: float) -> Keyframes:
        """The keyframes of a session."""
        frames = slam_map.keyframes
        rows = torch.nonzero(frames["session"] == session)[:, 0]
        rows = rows[torch.argsort(frames["timestamp"][rows], stable=True)]
        return cls(
            path,
            rows.cpu(),
            frames["timestamp"][rows].detach().double().cpu(),
            slam_map.T_cw[rows].detach().double().cpu(),
            meters_per_unit,
        )

    def nearest(self, times: Float[Tensor, " N"]) -> Int[Tensor, " N"]:
        """The number of the keyframe that is nearest in time."""
        after = torch.searchsorted(self.timestamps, times.contiguous()).clamp(1, len(self.timestamps) - 1)
        is_before = times - self.timestamps[after - 1] < self.timestamps[after] - times
        return after - is_before.long()


class PathMeasurement(Protocol):
    """What a source knows of parts of a path."""

    def on(self, keyframes: Keyframes) -> Measurement | None:
        """The measurement of keyframes of a map in meters; None where too few of them are there."""


@dataclass(frozen=True)
class PathPositions:
    """N positions along a path.

    Attributes:
        times: on the clock of the images, seconds, ascending.
        positions_e: in the frame that the map in meters has: east, north, up.
        white: standard deviations of their white noise along the axes, meters.
    """

    times: Float[Tensor, " N"]
    positions_e: Float[Tensor, "N 3"]
    white: Float[Tensor, "N 3"]

    def on(self, keyframes: Keyframes) -> MeasuredPositions | None:
        """See `PathMeasurement`. Positions that are nearest to the same keyframe are averaged."""
        at_w, _, known = keyframes.path.at(self.times)
        rows = torch.nonzero(known)[:, 0]
        rows = rows[:: 1 + (len(rows) - 1) // MAX_POSITIONS]
        if len(rows) == 0 or len(keyframes.rows) < LEAST_KEYFRAMES:
            return None
        numbers, group, size = torch.unique_consecutive(
            keyframes.nearest(self.times[rows]), return_inverse=True, return_counts=True
        )
        if len(numbers) < LEAST_KEYFRAMES:
            return None
        count = size.double()
        # The way from the keyframe to the moment of the position turns with the keyframe.
        points_c = transform(keyframes.T_cw[numbers[group]], at_w[rows, None])[:, 0]
        variances = group_means(self.white[rows].square(), group, count) / count[:, None]
        times = group_means(self.times[rows], group, count)
        covariances = slow_covariances(times, self.white[rows]) + torch.diag_embed(variances.mT)
        return MeasuredPositions(
            keyframes.rows[numbers],
            group_means(points_c, group, count),
            group_means(self.positions_e[rows], group, count),
            torch.linalg.inv(covariances),
        )


@dataclass(frozen=True)
class PathScales:
    """Meters per unit of the map along S parts of a path.

    Attributes:
        starts, ends: of the parts, seconds.
        meters_per_unit: of the map as it was when they were measured.
        stds: relative standard deviations, as if the parts were independent.
    """

    starts: Float[Tensor, " S"]
    ends: Float[Tensor, " S"]
    meters_per_unit: Float[Tensor, " S"]
    stds: Float[Tensor, " S"]

    @classmethod
    def of_mean(
        cls,
        starts: Float[Tensor, " S"],
        ends: Float[Tensor, " S"],
        meters_per_unit: Float[Tensor, " S"],
        relative: Float[Tensor, " S"],
        std: float,
    ) -> PathScales:
        """Parts whose mean has the relative standard deviation `std`: what they share is in the error of each.

        Args:
            starts: seconds.
            ends: seconds.
            meters_per_unit: of each part.
            relative: standard deviations of the parts relative to each other.
            std: of the mean of their logarithms, weighted by information.
        """
        return cls(
            starts, ends, meters_per_unit, std * relative * relative.square().reciprocal().sum().sqrt()
        )

    def on(self, keyframes: Keyframes) -> MeasuredLengths | None:
        """See `PathMeasurement`: the distance between the keyframes that are nearest to both ends of a part.

        Where that is one keyframe, they are those before and after it.
        """
        last = len(keyframes.rows) - 1
        if last + 1 < LEAST_KEYFRAMES:
            return None
        first, second = keyframes.nearest(self.starts), keyframes.nearest(self.ends)
        same = first == second
        first, second = (first - same.long()).clamp_min(0), (second + same.long()).clamp_max(last)
        ends_w = -(keyframes.T_cw[:, :3, :3].mT @ keyframes.T_cw[:, :3, 3:])[..., 0]
        chords = (ends_w[second] - ends_w[first]).norm(dim=-1)
        kept = chords > 0
        if not bool(kept.any()):
            return None
        return MeasuredLengths(
            torch.stack((keyframes.rows[first], keyframes.rows[second]), dim=1)[kept],
            (chords * self.meters_per_unit / keyframes.meters_per_unit)[kept],
            self.stds.square().reciprocal()[kept],
        )


def whole_path(keyframes: Keyframes, meters_per_unit: float, relative_std: float) -> MeasuredLengths | None:
    """The scale of a source that does not say where it has it from: the distance of the keyframes farthest apart."""
    centers_w = -(keyframes.T_cw[:, :3, :3].mT @ keyframes.T_cw[:, :3, 3:])[..., 0]
    if len(centers_w) < LEAST_KEYFRAMES:
        return None
    first = int((centers_w - centers_w.mean(0)).norm(dim=-1).argmax())
    second = int((centers_w - centers_w[first]).norm(dim=-1).argmax())
    length = (centers_w[second] - centers_w[first]).norm()
    if not float(length) > 0:
        return None
    return MeasuredLengths(
        keyframes.rows[[first, second]][None],
        (length * meters_per_unit / keyframes.meters_per_unit)[None],
        torch.full_like(length, relative_std**-2)[None],
    )
