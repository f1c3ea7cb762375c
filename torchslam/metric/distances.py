"""Known lengths as a source of meters: the user clicked two image points, and knows the meters between them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from torchslam.errors import MeasurementError
from torchslam.metric.image_depth import locate_pixel
from torchslam.metric.meters import MAX_DISAGREEMENT, combine_scales
from torchslam.metric.options import Given
from torchslam.metric.source import ScaleMeasurement, ScaleSource, SubmapView, Unmeasured, parse_length

UNIT_STD = 0.01
"""Relative standard deviation of the unit of a map from place to place, by its drift: two lengths in different places
differ by about that much, however well their ends are found (redkitchen, against its depth images)."""
LENGTHS = 1e-6, 1e5  # meters of a known length: in a microscope, and in an aerial image
MAX_RELATIVE_STD = 0.5
"""Relative error of a length from which on it is not used."""


@dataclass(frozen=True)
class Click:
    """An image point by the index of its frame, and x and y; (0, 0) is the center of the top left pixel."""

    frame: int
    pixel: tuple[float, float]

    def __str__(self) -> str:
        return f"{self.frame}:{self.pixel[0]:g},{self.pixel[1]:g}"


@dataclass(frozen=True)
class Distance:
    """A known length between two clicks, meters."""

    first: Click
    second: Click
    meters: float

    def __str__(self) -> str:
        return f"{self.first} {self.second}"


def from_options(given: Given) -> list[Distances]:
    """The source of all `--distance`. Raises MeasurementError for a wrong click or length."""
    return [Distances([parse_distance(words) for words in given["distance"]])]


def parse_distance(words: Sequence[str]) -> Distance:
    """Read `FRAME:X,Y FRAME:X,Y METERS`. Raises MeasurementError for anything else."""
    whole = f"--distance {' '.join(words)}"
    first, second = (_click(word, whole) for word in words[:2])
    meters = parse_length(words[2], whole, *LENGTHS)
    if first == second:
        raise MeasurementError(f"{whole}: both points are the same")
    return Distance(first, second, meters)


def _click(word: str, whole: str) -> Click:
    """Read `FRAME:X,Y`."""
    frame, _, pixel = word.partition(":")
    try:
        x, y = map(float, pixel.split(","))
        number = int(frame)
    except ValueError:
        raise MeasurementError(f"{whole}: write a point as FRAME:X,Y, not {word!r}") from None
    if number < 0 or not math.isfinite(x) or not math.isfinite(y):
        raise MeasurementError(f"{whole}: {word} is no point of an image")
    return Click(number, (x, y))


@dataclass(frozen=True)
class Distances:
    """Lengths between clicked points."""

    distances: Sequence[Distance]

    def check(self, size: tuple[int, int]) -> None:
        """Check that all clicks are in images of (width, height). Raises MeasurementError if a click is outside."""
        width, height = size
        for click in (click for each in self.distances for click in (each.first, each.second)):
            x, y = click.pixel
            if not (-0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5):
                raise MeasurementError(
                    f"--distance {click}: outside of the image of {width} x {height} pixels"
                )

    def measure(self, view: SubmapView) -> ScaleMeasurement | Unmeasured:
        """Locate the clicked points of a submap, and compare their distances with the known ones.

        Raises MeasurementError if a click is outside of the image.
        """
        if not view.has_images:
            return Unmeasured(ScaleSource.DISTANCE, "there are no images to find the points in")
        self.check(view.camera.size)
        measured = [measure_distance(view, each) for each in self.distances]
        failed = [one for one in measured if isinstance(one, str)]
        found = [one for one in measured if not isinstance(one, str)]
        if not found:
            return Unmeasured(ScaleSource.DISTANCE, "; ".join(failed))
        combined = combine_scales(found)
        logs = [math.log(one.meters_per_unit / combined.meters_per_unit) for one in found]
        used = [each for each, one in zip(self.distances, measured, strict=True) if not isinstance(one, str)]
        rejected = [
            f"the length {each} is {abs(log):.1%} ± {one.relative_std:.1%} off the mean of all"
            for each, one, log in zip(used, found, logs, strict=True)
            if len(found) > 1 and abs(log) > MAX_DISAGREEMENT * one.relative_std
        ]
        return ScaleMeasurement(
            ScaleSource.DISTANCE,
            combined.meters_per_unit,
            combined.relative_std,
            len(found),
            "known lengths" if len(found) > 1 else "known length",
            (*rejected, *failed),
            apart=math.sqrt(sum(log**2 for log in logs) / len(logs)) if len(found) > 1 else None,
        )


def measure_distance(view: SubmapView, distance: Distance) -> ScaleMeasurement | str:
    """The unit of a submap by one length, or the reason why it has none."""
    first = locate_pixel(view, distance.first.frame, distance.first.pixel)
    if isinstance(first, str):
        return first
    second = locate_pixel(view, distance.second.frame, distance.second.pixel)
    if isinstance(second, str):
        return second
    between_w = second.point_w - first.point_w
    length = float(between_w.norm())
    direction_w = between_w / max(length, 1e-12)
    variance = float(direction_w @ (first.covariance_w + second.covariance_w) @ direction_w)
    relative = math.hypot(math.sqrt(variance) / max(length, 1e-12), UNIT_STD)
    if not relative < MAX_RELATIVE_STD:
        return f"{distance} is shorter than its error"
    return ScaleMeasurement(ScaleSource.DISTANCE, distance.meters / length, relative, 1, "known length")
