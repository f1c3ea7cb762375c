"""Poses by time: the nearest one, or one between two. Pure functions over timestamps and trajectories."""

from __future__ import annotations

import torch
from torch import Tensor

from torchslam.geometry.lie import se3_interpolate
from torchslam.types import Trajectory


def nearest(timestamps: Tensor, reference: Tensor) -> tuple[Tensor, Tensor]:
    """The nearest reference time of each timestamp.

    timestamps (N,) and reference (M,), M >= 1, sorted, in seconds -> indices (N,) into `reference` and
    distances (N,) seconds. Of two that are equally near the earlier one is taken.
    """
    right = _next(timestamps, reference)
    left = (right - 1).clamp(min=0)
    to_left, to_right = (timestamps - reference[left]).abs(), (timestamps - reference[right]).abs()
    return torch.where(to_left <= to_right, left, right), torch.minimum(to_left, to_right)


def interpolate_poses(trajectory: Trajectory, timestamps: Tensor, tolerance: float) -> tuple[Tensor, Tensor]:
    """Poses of a trajectory at other times, along the geodesic between the two neighbors in time.

    timestamps (N,) seconds -> T_wc (N, 4, 4), valid (N,): whether some pose lies within `tolerance` seconds.
    Before the first and after the last pose the end pose is taken; invalid rows are finite.
    """
    times = trajectory.timestamps
    _, distances = nearest(timestamps, times)
    right = _next(timestamps, times)
    left = (right - 1).clamp(min=0)
    interval = times[right] - times[left]
    fraction = ((timestamps - times[left]) / torch.where(interval > 0, interval, 1.0)).clamp(0, 1)
    T_wc = se3_interpolate(trajectory.T_wc[left], trajectory.T_wc[right], fraction.to(trajectory.T_wc))
    # At a pose's own time and beyond the ends it is taken as it is, without the rounding of log and exp.
    exact = ((fraction >= 1) | (interval == 0))[:, None, None]
    return torch.where(exact, trajectory.T_wc[right], T_wc), distances <= tolerance


def _next(timestamps: Tensor, reference: Tensor) -> Tensor:
    """(N,) the first reference time that is not before each timestamp, the last one where all are."""
    return torch.searchsorted(reference.contiguous(), timestamps.contiguous()).clamp(max=len(reference) - 1)
