"""What the speeds or the odometry of a vehicle say about the unit of a map: lengths of the same stretches."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchslam.geometry import so3_log
from torchslam.metric.camera_path import CameraPath, found_shift
from torchslam.metric.slow_noise import scale_of_series
from torchslam.metric.source import ScaleMeasurement, ScaleSource, Unmeasured

STRETCH = 1.0
"""Seconds of a stretch: long enough that noise of single poses does not matter, short enough to separate slips from
drift."""
PARTS = 5
"""Straight parts of a stretch over which the path of the camera is measured: a car turns by less than 10 degrees in
one."""
MIN_STRETCHES = 4
"""From fewer, their scatter cannot be estimated."""
STANDING = 0.15
"""Part of the typical length of a stretch below which it is not used: the vehicle stands, or nearly."""
SEARCH_STEP = 0.1
"""Seconds between the clocks that are tried."""
SEARCH_GAIN = 18.0
"""Logarithm of the likelihood ratio from which on another clock is believed, as for a difference of six standard
deviations. Of 20 trials over 15 s, 12.5 believed a wrong one with slipping wheels, and 25 missed one of .8 s."""


@dataclass(frozen=True)
class Stretches:
    """S stretches of time, each with its length in the map and in meters.

    Attributes:
        times: of their middles, seconds.
        lengths_w: in the unit of the map.
        lengths: in meters.
        known: where both are.
    """

    times: Float[Tensor, " S"]
    lengths_w: Float[Tensor, " S"]
    lengths: Float[Tensor, " S"]
    known: Bool[Tensor, " S"]


def stretch_ends(first: float, last: float) -> Float[Tensor, " E"]:
    """Times a stretch apart."""
    count = int((last - first) / STRETCH)
    return first + STRETCH * torch.arange(count + 1, dtype=torch.float64, device="cpu")


def camera_lengths(
    path: CameraPath, ends: Float[Tensor, " E"]
) -> tuple[Float[Tensor, " S"], Bool[Tensor, " S"]]:
    """Lengths of the camera's path between successive times, and where it is known; arcs between the parts' ends."""
    fractions = torch.arange(PARTS + 1, dtype=torch.float64, device="cpu") / PARTS
    times = ends[:-1, None] + fractions * STRETCH
    T_wc, known = path.poses_at(times.flatten())
    T_wc, known = T_wc.unflatten(0, times.shape), known.unflatten(0, times.shape)
    chords = T_wc[..., :3, 3].diff(dim=1).norm(dim=-1)
    half = so3_log(T_wc[:, :-1, :3, :3].mT @ T_wc[:, 1:, :3, :3]).norm(dim=-1) / 2
    arcs = torch.where(half > 1e-6, half / half.clamp_min(1e-6).sin(), 1.0)
    return (chords * arcs).sum(1), known.all(1)


def best_shift(stretches_at: Callable[[float], Stretches], path: CameraPath) -> float:
    """Seconds that the clock of the images is ahead; see `found_shift`."""

    def cost_at(shift: float) -> float | None:
        found = stretches_at(shift)
        lengths_w, lengths = found.lengths_w[found.known], found.lengths[found.known]
        if len(lengths) < 2 * MIN_STRETCHES or not bool((lengths_w > 0).any()):
            return None
        scale = lengths.sum() / lengths_w.sum()
        off = (lengths - scale * lengths_w).abs().median() / lengths.mean().clamp_min(1e-9)
        return len(lengths) * math.log(max(float(off), 1e-6))

    return found_shift(cost_at, path.duration, SEARCH_STEP, SEARCH_GAIN)


def measured(
    found: Stretches, source: ScaleSource, what: str, notes: tuple[str, ...] = ()
) -> ScaleMeasurement | Unmeasured:
    """The unit by the ratios of lengths, with the error that their disagreement shows.

    Args:
        found: the stretches.
        source: whose they are.
        what: the name of the instrument's lengths in messages.
        notes: remarks.
    """
    if int(found.known.sum()) < MIN_STRETCHES:
        return Unmeasured(
            source, f"{what} and the camera's path share {int(found.known.sum())} stretches of {STRETCH:g} s"
        )
    moving = found.known
    for lengths in (found.lengths_w, found.lengths):
        moving = moving & (lengths > STANDING * lengths[found.known].quantile(0.9)) & (lengths > 0)
    if int(moving.sum()) < MIN_STRETCHES:
        return Unmeasured(source, "the camera hardly moves, or not when the vehicle does")
    times, logs = found.times[moving], (found.lengths[moving] / found.lengths_w[moving]).log()
    relative = found.lengths[moving].mean() / found.lengths[moving]  # short ones are less sure
    return scale_of_series(
        source,
        times,
        logs,
        relative.clamp_min(1e-3),
        "stretches",
        lambda row: f"at {float(times[row]):.1f} s",
        disagreement=f"{what} and the camera's path differ by {{}} from stretch to stretch",
        cause=", as with wheels that slip",
        notes=notes,
    )
