"""Charts: errors, tracked points and time per stage of a run; posed frames and errors of a batch."""

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

NAMED = 40
"""Rows of a batch that are shown by name; of more, their distribution."""
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


def plot_stage_times(results: Sequence[StepResult], title: str = "") -> Figure:
    """Milliseconds per stage: stacked over the frames (means of up to 120 bins), and the mean of each."""
    stages = stage_names(results)
    milliseconds = np.array([[result.stage_ms.get(stage, 0.0) for stage in stages] for result in results])
    milliseconds = milliseconds.reshape(len(results), len(stages))
    colors = [style.STAGES[index % len(style.STAGES)] for index in range(len(stages))]
    with style.house_style():
        figure = style.new_figure(10.0, 3.6)
        over_time, summary = figure.subplots(1, 2, width_ratios=(1.7, 1.0))
        _stacked(over_time, [result.index for result in results], milliseconds, colors)
        totals = milliseconds.sum(axis=1)
        if len(totals):
            typical, slow = np.median(totals), np.percentile(totals, 95)
            over_time.set_ylim(0.0, 1.15 * max(float(slow), 1e-3))
            over_time.set_title(title or f"Time per frame: median {typical:.0f} ms, 95 % below {slow:.0f} ms")
        over_time.set(xlabel="frame", ylabel="time (ms)")
        _stage_bars(summary, stages, milliseconds, colors)
    return figure


def stage_names(results: Sequence[StepResult]) -> list[str]:
    """The stages that were timed, in the order they first ran; `total` is their frame and is left out."""
    names = dict.fromkeys(name for result in results for name in result.stage_ms)
    return [name for name in names if name != "total"]


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


def _stacked(axes: Axes, frames: list[int], milliseconds: np.ndarray, colors: list[str]) -> None:
    """Stacked steps of the stages' mean time in at most 120 bins of frames."""
    bins = [
        part for part in np.array_split(np.arange(len(frames)), min(120, max(len(frames), 1))) if len(part)
    ]
    means = np.array([milliseconds[part].mean(axis=0) for part in bins])
    starts = np.array([frames[part[0]] for part in bins], dtype=float)
    widths = np.diff(np.append(starts, frames[-1] + 1)) if bins else starts
    bottom = np.zeros(len(bins))
    for stage, color in enumerate(colors if bins else []):
        axes.bar(starts, means[:, stage], widths, bottom=bottom, align="edge", color=color, lw=0)
        bottom += means[:, stage]
    axes.margins(x=0.0)


def _stage_bars(axes: Axes, stages: list[str], milliseconds: np.ndarray, colors: list[str]) -> None:
    """A bar per stage: its mean over the frames in which it ran, with the share of frames in words."""
    axes.set_title("Mean of a stage, where it ran")
    axes.set_xlabel("time (ms)")
    axes.grid(axis="y", visible=False)
    means, labels = [], []
    for stage, name in enumerate(stages):
        ran = milliseconds[:, stage] > 0
        means.append(float(milliseconds[ran, stage].mean()) if ran.any() else 0.0)
        labels.append(name)
    bars = axes.barh(labels, means, color=colors, height=0.62)
    for bar, stage in zip(bars, range(len(stages)), strict=True):
        share = float((milliseconds[:, stage] > 0).mean())
        text = f"{bar.get_width():.1f}" + (f"  ({100 * share:.0f} % of frames)" if share < 0.995 else "")
        axes.annotate(
            text,
            (bar.get_width(), bar.get_y() + bar.get_height() / 2),
            (4, 0),
            textcoords="offset points",
            va="center",
            fontsize=8,
            color="#404040",
        )
    axes.invert_yaxis()
    axes.margins(x=0.3)


def plot_batch(
    names: Sequence[str],
    statuses: Sequence[str],
    posed: Sequence[float | None],
    errors: Sequence[float | None],
    title: str = "",
) -> Figure:
    """Plot posed fraction and relative error per sequence: by name, or sorted if there are more than `NAMED`.

    Args:
        statuses: "done", or the text to show instead of a bar
        posed: fraction of the frames that have a pose
        errors: ATE as a fraction of the path; None: unknown
    """
    with style.house_style():
        few = len(names) <= NAMED
        figure = style.new_figure(9.0, 1.3 + 0.24 * len(names) if few else 4.0)
        left, right = figure.subplots(1, 2, sharey=few)
        if few:
            _by_name(left, right, names, statuses, posed, errors)
        else:
            _sorted(left, [100.0 * (share or 0.0) for share in posed])
            _sorted(right, [100.0 * error for error in errors if error is not None])
        left.set(xlabel="posed frames (%)", xlim=(0.0, 103.0))
        right.set(xlabel="ATE (% of the path)", xscale="log", xlim=_decades(errors))
        right.xaxis.set_major_formatter(lambda value, position: f"{value:g}")
        figure.suptitle(title, x=0.01, ha="left", fontsize=10.0)
    return figure


def _by_name(
    left: Axes,
    right: Axes,
    names: Sequence[str],
    statuses: Sequence[str],
    posed: Sequence[float | None],
    errors: Sequence[float | None],
) -> None:
    """A row for each sequence, the first one at the top."""
    rows = np.arange(len(names))
    shares = np.array([100.0 * (share or 0.0) for share in posed])
    left.barh(rows, shares, color=style.ESTIMATE, height=0.62)
    left.set_yticks(rows, [name if len(name) <= 40 else name[:38] + "…" for name in names])
    left.set_ylim(len(names) - 0.4, -0.6)
    left.grid(axis="y", visible=False)
    for row, status in enumerate(statuses):
        if status != "done":
            left.annotate(
                status, (0.0, row), (4, 0), textcoords="offset points", va="center", color=style.ACCENT
            )
    known = np.array([error is not None and error > 0 for error in errors], dtype=bool)
    percent = np.array([100.0 * (error or 0.0) for error in errors])
    right.plot(percent[known], rows[known], "o", ms=5.0, color=style.ACCENT)
    for row in rows[known]:
        label = f"{percent[row]:.2g}"
        right.annotate(
            label, (percent[row], row), (6, 0), textcoords="offset points", va="center", fontsize=8
        )


def _sorted(axes: Axes, values: Sequence[float]) -> None:
    """Draw the share of the sequences that have at most each value."""
    ordered = np.sort(np.array(values, dtype=float))
    axes.step(ordered, 100.0 * np.arange(1, len(ordered) + 1) / max(len(ordered), 1), color=style.ESTIMATE)
    axes.set(ylabel=f"of {len(ordered)} sequences (%)", ylim=(0.0, 103.0))


def _decades(errors: Sequence[float | None]) -> tuple[float, float]:
    """Powers of ten around the errors, in percent."""
    exponents = [np.log10(100.0 * error) for error in errors if error is not None and error > 0]
    low, high = np.floor(min(exponents, default=0.0)), np.ceil(max(exponents, default=0.0))
    return 10.0**low, 10.0 ** max(high, low + 1)
