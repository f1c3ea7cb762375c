"""The scale of a map from a series of measurements of it."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.metric.scale import ScaleMeasurement, ScaleSource
from torchslam.metric.slow_noise import slow_mean
from torchslam.metric.source import Unmeasured

MAX_RELATIVE_STD = 0.25
"""Relative standard error from which on a scale is no measurement."""
LEAST_STD = 1e-6
"""Of exact data."""


def scale_of_series(
    source: ScaleSource,
    times: Float[Tensor, " N"],
    logs: Float[Tensor, " N"],
    stds: Float[Tensor, " N"],
    unit: str,
    name_of: Callable[[int], str],
    *,
    disagreement: str,
    cause: str = "",
    shared_std: float = 0.0,
    notes: tuple[str, ...] = (),
) -> ScaleMeasurement | Unmeasured:
    """Average a series of logarithms of meters per unit, up to half of them wrong; see `slow_mean`.

    Args:
        source: where they come from.
        times: seconds, ascending.
        logs: the logarithms.
        stds: their standard deviations, relative to each other.
        unit: what is counted, in the plural.
        name_of: the name of a row, such as "at 3.2 s".
        disagreement: message where they determine no scale, with `{}` for their relative standard deviation.
        cause: end of the message about rejected ones.
        shared_std: relative standard deviation of an error that all have in common.
        notes: remarks.
    """
    mean = slow_mean(times, logs, stds)
    if mean.std > MAX_RELATIVE_STD or float(mean.inliers.double().mean()) < 0.5:
        return Unmeasured(source, disagreement.format(f"{mean.scatter:.0%}"))
    # Where all others agree, deviations below the shared error are many standard deviations.
    wrong = torch.nonzero(~mean.inliers & ((logs - mean.mean).abs() > shared_std))[:, 0]
    rejected = []
    if len(wrong):
        off = (logs[wrong] - mean.mean).exp() - 1
        rejected.append(
            f"{len(wrong)} of {len(logs)} {unit}, the first one {name_of(int(wrong[0]))}, are "
            f"{float(off.min()):+.0%} to {float(off.max()):+.0%} off{cause}"
        )
    return ScaleMeasurement(
        source,
        math.exp(mean.mean),
        max(math.hypot(mean.std, shared_std), LEAST_STD),
        int(mean.inliers.sum()),
        unit,
        tuple(rejected),
        apart=mean.scatter,
        notes=notes,
    )
