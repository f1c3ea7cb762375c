"""The path of the camera between its poses, and the clocks of other instruments against that of the images."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchslam.data.text_file import parse_moment, utc_from_gps
from torchslam.errors import MeasurementError
from torchslam.geometry import se3_interpolate, se3_inverse
from torchslam.metric.options import Given
from torchslam.metric.source import SubmapView
from torchslam.utils.indexing import between_rows

SINCE_1970 = 1e8
"""Seconds: times from here on (1973) count from 1970 or 1980, smaller ones from the start of a recording or a day."""
MAX_GAP = 0.5
"""Seconds between two poses up to which the path between them is known in any case. Cars turn within a second."""
SEARCH_LIMIT, SEARCH_SHARE = 20.0, 0.25
"""Seconds, and share of the recording's duration, by which a clock may be off: GPS time is ahead of UTC by 18, and most
of a file has a pose with any clock."""


@dataclass(frozen=True)
class CameraPath:
    """The posed frames of a submap at ascending seconds, float64 on the CPU.

    `first_image` is the time of the first image of the recording, if images come at an even rate.
    """

    timestamps: Float[Tensor, " K"]
    T_wc: Float[Tensor, "K 4 4"]
    first_image: float

    @staticmethod
    def of(view: SubmapView) -> CameraPath:
        """The path of a session in a submap; of frames with the same time the first."""
        times, frames = view.timestamps.detach().double().cpu(), view.frame_index.double().cpu()
        T_wc = se3_inverse(view.T_cw.detach().double().cpu())
        later = torch.ones_like(times, dtype=torch.bool)
        later[1:] = times.diff() > 0
        times, T_wc, frames = times[later], T_wc[later], frames[later]
        first = float(times[0]) if len(times) else 0.0
        if len(times) > 1 and frames[-1] > frames[0]:  # images before the map, at the rate of those in it
            first -= float(frames[0] * (times[-1] - times[0]) / (frames[-1] - frames[0]))
        return CameraPath(times, T_wc, first)

    @property
    def duration(self) -> float:
        """Seconds from the first pose to the last one."""
        return float(self.timestamps[-1] - self.timestamps[0])

    @property
    def up_w(self) -> Float[Tensor, " 3"]:
        """Mean direction that is up in the images, a unit vector."""
        up = -self.T_wc[:, :3, 1].mean(0)
        return up / up.norm().clamp_min(1e-9)

    def at(
        self, times: Float[Tensor, "*shape"]
    ) -> tuple[Float[Tensor, "*shape 3"], Float[Tensor, "*shape 3"], Bool[Tensor, "*shape"]]:
        """Positions and velocities at times, and whether they are known: between two poses that are near enough.

        Positions are on the line between those of the poses. Times have any order; unknown ones have finite values.
        """
        left, part, known = self._interval(times)
        positions, interval = self.T_wc[:, :3, 3], self.timestamps.diff()
        step = positions[left + 1] - positions[left]
        return positions[left] + part[..., None] * step, step / interval[left][..., None], known

    def poses_at(self, times: Float[Tensor, " N"]) -> tuple[Float[Tensor, "N 4 4"], Bool[Tensor, " N"]]:
        """Poses T_wc at times, and whether they are known."""
        left, part, known = self._interval(times)
        return se3_interpolate(self.T_wc[left], self.T_wc[left + 1], part), known

    def _interval(
        self, times: Float[Tensor, "*shape"]
    ) -> tuple[Tensor, Float[Tensor, "*shape"], Bool[Tensor, "*shape"]]:
        """The row of the pose before, the part of the interval that has passed, and whether it is short enough."""
        left, part = between_rows(self.timestamps, times)
        interval = self.timestamps.diff()
        longest = max(MAX_GAP, 3 * float(interval.median()))  # for slow recordings
        known = (part >= 0) & (part <= 1) & (interval[left] <= longest)
        return left, part.clamp(0, 1), known

    def on_its_clock(
        self, times: Float[Tensor, " N"], clock: Clock, file: Path, option: str
    ) -> Float[Tensor, " N"]:
        """The times of a file on the clock of the images.

        Both clocks count from 1970, or both from the start of the recording; GPS time, which counts from 1980 without
        leap seconds, is recognized where UTC does not fit and it does.

        Raises MeasurementError, saying what to state, where the two have nothing in common.
        """
        own = self.timestamps
        if clock.seconds is not None:
            times = times + clock.seconds
        elif clock.start is not None:
            if not _is_absolute(times):
                raise MeasurementError(
                    f"{option}: the times of {file} are no dates, from {_span(times)}; give the seconds to add to them"
                )
            times = times - clock.start + self.first_image
        elif _is_absolute(times) and _is_absolute(own) and not _overlap(times, own):
            as_gps = times.new_tensor([utc_from_gps(time) for time in times.tolist()])
            times = as_gps if _overlap(as_gps, own) else times
        if _overlap(times, own):
            return times
        if _is_absolute(times) and not _is_absolute(own):
            advice = f"give {option} the date and time of the first image, such as 2024-05-01T10:00:00Z"
        elif float(times[-1] - times[0]) > 100 * self.duration > 0:
            advice = "if they count milli- or nanoseconds, call the column time_ms or time_ns"
        else:
            advice = f"give {option} the seconds to add to them"
        raise MeasurementError(
            f"{file}: its times, from {_span(times)}, are not those of the images, from {_span(own)}; {advice}"
        )


@dataclass(frozen=True)
class Clock:
    """A clock as given by the user: the seconds that are added to the file's times to give those of the images.

    The other way to say it is when the first image was taken, seconds since 1970.
    """

    seconds: float | None = None
    start: float | None = None


def parse_clock(text: str, option: str) -> Clock:
    """`-0.3`, seconds to add to a file's times, or `2024-05-01T10:00:00Z`, the moment of the first image.

    Raises MeasurementError naming the option.
    """
    if re.fullmatch(r"[-+]?\d{1,12}(\.\d{1,12})?", text):
        return Clock(seconds=float(text))
    moment = parse_moment(text)
    if moment is None:
        raise MeasurementError(
            f"{option}: `{text}` is neither seconds to add to the times of the file, nor the date and time of the "
            "first image, such as 2024-05-01T10:00:00Z"
        )
    return Clock(start=moment)


def clocks_of(given: Given, option: str) -> list[tuple[str, Clock]]:
    """The files of `--OPTION FILE`, each with its `--OPTION-clock`; a single one holds for all.

    Raises MeasurementError for a clock that is none, or where their numbers differ.
    """
    files = [words[0] for words in given[option]]
    clocks = [parse_clock(words[0], f"--{option}-clock") for words in given.get(f"{option}_clock", ())]
    if len(clocks) not in (0, 1, len(files)):
        raise MeasurementError(
            f"--{option}-clock is given {len(clocks)} times, but --{option} {len(files)} times"
        )
    if len(clocks) < len(files):
        clocks = (clocks or [Clock()]) * len(files)
    return list(zip(files, clocks, strict=True))


def clock_notes(file: Path, shift: float, std: float | None = None) -> list[str]:
    """Notes about a clock if that of the images is this many seconds ahead, with the error if it is known."""
    if not shift:
        return []
    error = "" if std is None else f" ± {std:.2f}"
    return [
        f"{file}: its clock is {abs(shift):.2f}{error} s {'behind' if shift > 0 else 'ahead of'} that of the images"
    ]


def found_shift(
    cost_at: Callable[[float], float | None], duration: float, step: float, least_gain: float
) -> float:
    """Seconds that the clock of the images is ahead, in steps; zero unless another one fits far better.

    Args:
        cost_at: minus the logarithm of the likelihood, up to a constant, if it is this many seconds ahead; None where
            too few samples are left.
        duration: of the recording, seconds.
        step: between the clocks that are tried, seconds.
        least_gain: logarithm of the likelihood ratio from which on another clock is believed.
    """
    count = int(min(SEARCH_LIMIT, SEARCH_SHARE * duration) / step)
    best, gain, reference = 0.0, least_gain, math.nan
    for shift in (step * number for number in sorted(range(-count, count + 1), key=abs)):
        cost = cost_at(shift)
        if cost is None:
            continue
        reference = cost if math.isnan(reference) else reference
        if reference - cost > gain:
            best, gain = shift, reference - cost
    return best


def _is_absolute(times: Float[Tensor, " N"]) -> bool:
    return float(times[0]) >= SINCE_1970


def _overlap(times: Float[Tensor, " N"], own: Float[Tensor, " K"]) -> bool:
    return bool(((times >= own[0]) & (times <= own[-1])).any())


def _span(times: Float[Tensor, " N"]) -> str:
    digits = 3 if abs(float(times[-1])) < SINCE_1970 else 1
    return f"{float(times[0]):.{digits}f} to {float(times[-1]):.{digits}f} s"
