"""Charts of a run over time: errors and tracked points."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from torch import Tensor

from torchslam.io.plots import style
from torchslam.types import State, StepResult

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure

_SHADES = {
    State.LOST: (style.LOST, "lost"),
    State.UNCERTAIN: (style.UNCERTAIN, "uncertain"),
    State.INITIALIZING: (style.INITIALIZING, "initializing"),
}


def plot_errors(
    timestamps: Float[Tensor, " N"],
    errors_m: Float[Tensor, " N"],
    errors_rad: Float[Tensor, " N"] | None = None,
    results: Sequence[StepResult] = (),
    title: str = "",
) -> Figure:
    """The error of every posed frame over time, colored by its size; spans without a pose shaded.

    Args:
        timestamps: seconds of the posed frames that have ground truth.
        errors_m: meters between the aligned and the true camera center.
        errors_rad: radians between the aligned and the true orientation.
        results: results of all frames, for the shading.
    """
    seconds = style.to_numpy(timestamps)
    origin = _origin(seconds, results)
    rows = [("position error (m)", style.to_numpy(errors_m))]
    if errors_rad is not None:
        rows.append(("rotation error (°)", np.degrees(style.to_numpy(errors_rad))))
    with style.house_style():
        figure = style.new_figure(9.0, 1.4 + 1.8 * len(rows))
        panels = figure.subplots(len(rows), 1, sharex=True, squeeze=False)[:, 0]
        for axes, (label, errors) in zip(panels, rows, strict=True):
            _shade(axes, results, origin)
            _colored_line(axes, seconds - origin, errors)
            rmse = float(np.sqrt(np.mean(errors**2))) if len(errors) else 0.0
            axes.axhline(rmse, color=style.MUTED, lw=0.9, ls=(0, (4, 3)), label="RMSE")
            axes.annotate(
                f"{rmse:.3g}", (1.0, rmse), (3, 0), ("axes fraction", "data"), "offset points", va="center"
            )
            axes.set(ylabel=label, ylim=(0.0, 1.08 * float(errors.max(initial=1e-9))))
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
        panels[-1].set_xlabel("time (s)")
        panels[0].set_title(title or "Error against ground truth")
    return figure


def plot_tracking(results: Sequence[StepResult], title: str = "") -> Figure:
    """Map points matched per frame and those that agree with its pose; keyframes and lost spans marked."""
    origin = _origin(np.zeros(0), results)
    seconds = np.array([result.timestamp for result in results]) - origin
    matches = np.array([result.matches for result in results], dtype=float)
    inliers = np.array([result.inliers for result in results], dtype=float)
    keyframes = np.array([result.is_keyframe for result in results], dtype=bool)
    with style.house_style():
        figure = style.new_figure(9.0, 3.2)
        axes = figure.add_subplot()
        _shade(axes, results, origin)
        axes.fill_between(seconds, matches, color=style.ESTIMATE, alpha=0.16, lw=0, label="matched")
        axes.plot(seconds, inliers, color=style.ESTIMATE, lw=1.2, label="agree with the pose")
        axes.plot(seconds[keyframes], inliers[keyframes], "o", ms=3.0, color=style.ACCENT, label="keyframe")
        axes.set(xlabel="time (s)", ylabel="map points in the frame", ylim=(0.0, None))
        posed = inliers > 0
        median = np.median(inliers[posed]) if posed.any() else 0.0
        axes.set_title(f"{title or 'Tracking'}: {median:.0f} points agree with a pose (median)")
        axes.margins(x=0.0)
        figure.legend(loc="outside lower center", ncols=6)
    return figure


def _origin(seconds: np.ndarray, results: Sequence[StepResult]) -> float:
    if results:
        return results[0].timestamp
    return float(seconds[0]) if len(seconds) else 0.0


def _shade(axes: Axes, results: Sequence[StepResult], origin: float) -> None:
    """Shade the spans of frames that have no pose or an uncertain one, each kind labeled once."""
    labeled: set[State] = set()
    start = 0
    for end in range(1, len(results) + 1):
        state = results[start].state
        if end < len(results) and results[end].state is state:
            continue
        if state in _SHADES:
            color, label = _SHADES[state]
            last = results[min(end, len(results) - 1)].timestamp
            axes.axvspan(
                results[start].timestamp - origin,
                last - origin,
                color=color,
                lw=0,
                label="_" * (state in labeled) + label,
            )
            labeled.add(state)
        start = end


def _colored_line(axes: Axes, seconds: np.ndarray, errors: np.ndarray) -> None:
    """A line colored by its height, broken where frames are missing."""
    from matplotlib.collections import LineCollection

    knots = np.stack([seconds, errors], axis=1)
    segments = np.stack([knots[:-1], knots[1:]], axis=1) if len(knots) > 1 else np.zeros((0, 2, 2))
    steps = np.diff(seconds)
    near = steps <= 5.0 * np.median(steps) if len(steps) else np.zeros(0, dtype=bool)
    lines = LineCollection(list(segments[near]), cmap=_error_colors(), lw=1.6, capstyle="round")
    lines.set_array(segments[near, :, 1].mean(axis=1))
    lines.set_clim(0.0, float(np.percentile(errors, 98)) if len(errors) else 1.0)
    axes.add_collection(lines)
    axes.set_xlim(min(0.0, seconds.min(initial=0.0)), seconds.max(initial=1e-3))


def _error_colors() -> Colormap:
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("errors", ["#3d8f7c", "#e0b352", "#c8553d"])
