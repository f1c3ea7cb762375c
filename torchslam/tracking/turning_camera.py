"""How fast a camera turns while a map is looked for, and whether two of its views show more than a turn.

A camera that turns keeps each view for a short time only, and with a rolling shutter it bends what it sees. Both hide
the parallax of a camera that moves, or look like it.
"""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchslam.config import Config
from torchslam.geometry import SharedCamera
from torchslam.geometry.lie import so3_log
from torchslam.geometry.rolling_shutter import at_middle_row
from torchslam.geometry.rotating_camera import (
    MAX_FOCAL_SIGMAS,
    RotatingCamera,
    fit_rotating_camera,
    rotation_between,
)
from torchslam.tracking.matcher import run_matcher
from torchslam.types import FrameFeatures, Matcher

THRESHOLD_PX = 1.5
"""Inlier threshold of the two-view models, pixels of reduced images. Tried at this value only."""
RATE_VIEWS = 3
"""Views that tell how fast the camera turns at the first or the last of them: two intervals, with which the rate is
extrapolated by half an interval. Tried at this value only."""
MAX_READOUT = 1.0
"""Longest readout of an image, in intervals between frames: no camera needs more time. Tried at this value only."""
READOUT_SIGMAS = 3.0
"""Standard deviations from zero at which a readout time counts as measured. Tried at this value only."""
MOST_FOCAL_STD = math.log(3.0) / MAX_FOCAL_SIGMAS
"""Standard deviation of the logarithm of a guessed focal length, and the largest for any camera. Three of them are a
factor of three, about the ratio of the focal lengths of usual lenses."""


class TurningCamera:
    """The views that tell how fast the camera turns at the reference frame and at the last one."""

    def __init__(self, camera: SharedCamera, config: Config, matcher: Matcher) -> None:
        self.camera, self.matcher = camera, matcher
        self.threshold_px = THRESHOLD_PX * config.features.reduction(camera.current.size)
        self.min_matches = config.initialization.min_matches
        # Standard deviation of the logarithm of a focal length; zero if it is exact.
        self.std = MOST_FOCAL_STD if config.camera.guessed else min(config.camera.std, MOST_FOCAL_STD)
        self.seeks_readout = config.camera.readout_std > 0
        self._first: list[FrameFeatures] = []
        self._last: list[FrameFeatures] = []
        self._first_rates: list[Tensor] = []  # once they are known

    def refer_to(self, view: FrameFeatures) -> None:
        """Start with a reference frame."""
        self._first, self._last, self._first_rates = [view], [view], []

    def add(self, view: FrameFeatures) -> None:
        """Add the next frame."""
        if len(self._first) < RATE_VIEWS:
            self._first.append(view)
        self._last = [*self._last, view][-RATE_VIEWS:]

    def fit(
        self, pixels_1: Float[Tensor, "M 2"], pixels_2: Float[Tensor, "M 2"], mask: Bool[Tensor, " M"]
    ) -> tuple[RotatingCamera, Float[Tensor, "2 3"]]:
        """The rotation that explains matches of the reference and the last view best, and the turns during a readout.

        The focal length may be as wrong as the configuration says of the camera. The readout is that of the sensor
        model or, where it has none, at most the interval between two frames. The turns, rotation vectors from the first
        row to the last one of both views, are zero where no readout time is known.
        """
        turns, known = self._turns(), self.camera.model.readout
        if known is not None:
            turns = float(known.seconds) / self._interval * turns
            pixels_1, pixels_2 = self.at_middle_rows((pixels_1, pixels_2), turns)
        is_sought = known is None and self.seeks_readout
        options = self.std, self.threshold_px, mask[None], turns[None] if is_sought else None
        found = fit_rotating_camera(pixels_1[None], pixels_2[None], self.camera.current, *options)
        if not is_sought:
            return found, turns if known is not None else torch.zeros_like(turns)
        readout = float(found.readout)
        if readout <= READOUT_SIGMAS * float(found.readout_std):
            return found, torch.zeros_like(turns)
        return found, min(readout, MAX_READOUT) * turns

    def at_middle_rows(
        self, pixels: tuple[Float[Tensor, "M 2"], Float[Tensor, "M 2"]], turns: Float[Tensor, "2 3"]
    ) -> tuple[Float[Tensor, "M 2"], Float[Tensor, "M 2"]]:
        """Keypoints of the reference and of the last view as global shutters see them at the middle rows."""
        first, last = (
            at_middle_row(x[None], self.camera.current, turn[None])[0]
            for x, turn in zip(pixels, turns, strict=True)
        )
        return first, last

    def _turns(self) -> Float[Tensor, "2 3"]:
        """Rotation vectors of both views over the interval before the last one; zero if few views tell them."""
        if len(self._last) < RATE_VIEWS:
            return self.camera.current.params.new_zeros(2, 3)
        first = self._first_rates = self._first_rates or self._rates(self._first)
        last = self._rates(self._last)
        return self._interval * torch.stack((1.5 * first[0] - 0.5 * first[1], 1.5 * last[1] - 0.5 * last[0]))

    @property
    def _interval(self) -> float:
        """Seconds between the last two frames; infinite with fewer."""
        if len(self._last) < 2:
            return math.inf
        return self._last[-1].timestamp - self._last[-2].timestamp

    def _rates(self, views: list[FrameFeatures]) -> list[Float[Tensor, "3"]]:
        """Angular velocities between each view and the next, radians per second; zero if too few matches tell it."""
        rates = []
        for view_1, view_2 in pairwise(views):
            pairs = run_matcher(self.matcher, view_1, view_2)
            if len(pairs.first) < self.min_matches:
                rates.append(self.camera.current.params.new_zeros(3))
                continue
            pixels_1, pixels_2 = view_1.keypoints[pairs.first], view_2.keypoints[pairs.second]
            R_21 = rotation_between(pixels_1[None], pixels_2[None], self.camera.current, self.threshold_px)
            rates.append(so3_log(R_21[0]) / (view_2.timestamp - view_1.timestamp))
        return rates
