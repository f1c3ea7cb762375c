"""Speeds of a vehicle, as of its wheels: their integral is the length of the camera's path."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchslam.data.formats.speed_file import Speeds, read_speeds
from torchslam.metric.camera_path import CameraPath, Clock, clock_notes, clocks_of, on_clock_of_images
from torchslam.metric.options import Given
from torchslam.metric.path_lengths import (
    MIN_STRETCHES,
    STRETCH,
    Stretches,
    best_shift,
    camera_lengths,
    measured,
    stretch_ends,
)
from torchslam.metric.source import MetricSource, ScaleMeasurement, ScaleSource, SubmapView, Unmeasured
from torchslam.utils.indexing import between_rows

MAX_GAP = 2.5
"""Seconds between two speeds up to which the speed in between is known: a second or two is usual for cars, which change
theirs evenly by 3 m/s in one."""


@dataclass(frozen=True)
class SpeedSource:
    """The speeds of one file.

    Attributes:
        speeds: the speeds.
        clock: the clock of the file as given by the user.
    """

    speeds: Speeds
    clock: Clock = field(default_factory=Clock)

    def measure(self, view: SubmapView) -> ScaleMeasurement | Unmeasured:
        """The unit of a submap; see `MetricSource`."""
        path = CameraPath.of(view)
        if len(path.timestamps) < MIN_STRETCHES:
            return Unmeasured(ScaleSource.SPEED, f"only {len(path.timestamps)} frames have a pose")
        file = self.speeds.path
        times = on_clock_of_images(self.speeds.timestamps, path, self.clock, file, "--speed-clock")
        ends = stretch_ends(float(path.timestamps[0]), float(path.timestamps[-1]))
        lengths_w, seen = camera_lengths(path, ends)

        def at(shift: float) -> Stretches:
            lengths, known = self._lengths(times + shift, ends)
            return Stretches(ends[:-1] + STRETCH / 2, lengths_w, lengths, known & seen)

        shift = best_shift(at, path) if self.clock.seconds is None else 0.0
        return measured(at(shift), ScaleSource.SPEED, "the speeds", tuple(clock_notes(file, shift)))

    def _lengths(
        self, times: Float[Tensor, " N"], ends: Float[Tensor, " E"]
    ) -> tuple[Float[Tensor, " S"], Bool[Tensor, " S"]]:
        """Meters between successive times by the trapezoidal rule, and where no gap is in it."""
        speeds, steps = self.speeds.speeds, times.diff()
        driven = torch.zeros_like(times)
        driven[1:] = (steps * (speeds[1:] + speeds[:-1]) / 2).cumsum(0)
        left, part = between_rows(times, ends)
        part = part.clamp(0, 1)
        gain = (speeds[left + 1] - speeds[left]) * part / 2
        at = driven[left] + part * steps[left] * (speeds[left] + gain)
        gaps = torch.zeros_like(times)
        gaps[1:] = (steps > MAX_GAP).cumsum(0)
        known = (gaps[left + 1][1:] == gaps[left][:-1]) & (ends[:-1] >= times[0]) & (ends[1:] <= times[-1])
        return at.diff(), known


def from_options(given: Given) -> list[MetricSource]:
    """The sources of `--speed FILE`, with `--speed-clock` for each file or for all.

    Raises MeasurementError for a file that is wrong.
    """
    return [SpeedSource(read_speeds(file), clock) for file, clock in clocks_of(given, "speed")]
