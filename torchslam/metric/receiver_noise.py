"""The noise of a receiver by its differences from a path that drifts.

The map drifts as slowly as the receiver wanders: neither can be told from the other by a similarity. But from one
position to the next both hardly change, so that positions beside each other show the white noise alone. How much a
receiver wanders is assumed, in proportion to that.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchslam.geometry.robust import NORMAL_MEDIAN
from torchslam.metric.slow_noise import GATE

SLOW_STRENGTH = 1.0
"""Standard deviation of the noise that wanders, in those of the white noise of one position."""
SLOW_SECONDS = 60.0
"""Seconds after which it is forgotten: satellites move by half a degree, a vehicle comes past other walls."""
NEIGHBORS = 5
"""Positions, the middle one among them, whose median shows whether that is wrong."""
LEAST_STD = 0.01
"""Meters: the least standard deviation that is assumed, the rounding of files."""


class ReceiverNoise(NamedTuple):
    """White noise of N positions.

    Attributes:
        white: standard deviations along the axes, meters.
        agrees: positions that agree with their neighbors.
    """

    white: Float[Tensor, "N 3"]
    agrees: Bool[Tensor, " N"]


def slow_covariances(times: Float[Tensor, " G"], white: Float[Tensor, "N 3"]) -> Float[Tensor, "3 G G"]:
    """Covariances along the axes of the noise that wanders, at times, of a receiver with that white noise."""
    strength = SLOW_STRENGTH * white.median(0).values
    correlations = torch.exp(-(times[:, None] - times).abs() / SLOW_SECONDS)
    return strength.square()[:, None, None] * correlations


def receiver_noise(
    residuals: Float[Tensor, "N 3"], stated: Float[Tensor, "N 2"], has_height: Bool[Tensor, " N"]
) -> ReceiverNoise:
    """The white noise of positions by their differences from a path.

    Args:
        residuals: of five positions or more in the order of time, meters: east, north, up.
        stated: standard deviations, horizontal and vertical, of which only ratios count; NaN if unknown.
        has_height: whether the third coordinate was measured.
    """
    stds = torch.cat((stated[:, :1].expand(-1, 2), stated[:, 1:]), dim=-1)
    typical = stds.nanmedian(0).values
    stds = torch.where(stds.isnan(), torch.where(typical.isnan(), 1.0, typical), stds)
    middle = slice(NEIGHBORS // 2, -(NEIGHBORS // 2))
    whitened = residuals / stds
    spread = (_bends(whitened).abs().median(0).values / NORMAL_MEDIAN).clamp_min(1e-9)
    off = whitened[middle] - whitened.unfold(0, NEIGHBORS, 1).median(-1).values
    agrees = torch.ones_like(has_height)
    # The median of neighbors is itself uncertain.
    near = off.abs() <= GATE * math.sqrt(1 + math.pi / 2 / NEIGHBORS) * spread
    near[:, 2] |= ~has_height[middle]
    agrees[middle] = near.all(-1)
    # A median: what is wrong for a while agrees with its neighbors, but jumps at both ends.
    bends = _bends(whitened[agrees]).abs()
    horizontal, vertical = bends[:, :2].median() / NORMAL_MEDIAN, bends[:, 2].median() / NORMAL_MEDIAN
    factors = torch.stack((horizontal, horizontal, vertical))
    return ReceiverNoise((factors * stds).clamp_min(LEAST_STD), agrees)


def _bends(values: Float[Tensor, "N 3"]) -> Float[Tensor, "M 3"]:
    """Each value less the mean of those before and after it, with the variance of one value."""
    return (values[1:-1] - 0.5 * (values[:-2] + values[2:])) / math.sqrt(1.5)
