"""Charts of a run over time, the features of an image, and the common style of all plots."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from torchslam.data.formats.image_file import write_image
from torchslam.types import State, StepResult

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ESTIMATE = "#3f7aa6"
GROUND_TRUTH = "#2f2f2f"
ACCENT = "#c8553d"
MUTED = "#7a7a7a"
AXES_RGB = ("#d5493f", "#57a145", "#3f8fe8")  # the camera's x, y, z

_RC: dict[Any, Any] = {
    "font.size": 9.0,
    "axes.titlesize": 10.0,
    "axes.titlelocation": "left",
    "axes.titlepad": 8.0,
    "axes.labelcolor": "#404040",
    "axes.edgecolor": "#9a9a9a",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e7e5e0",
    "grid.linewidth": 0.7,
    "xtick.color": "#606060",
    "ytick.color": "#606060",
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "figure.facecolor": "white",
    "savefig.dpi": 150,
}
"""Settings of matplotlib for all pictures."""
_FILTER, _UP = 19, 32
"""OpenCV's IMWRITE_PNG_FILTER and its value UP. OpenCV before 4.12 has no names for them and ignores them."""
PNG = (cv2.IMWRITE_PNG_COMPRESSION, 1, _FILTER, _UP)
"""Encoding of the pictures: the difference of each row to the one above, compressed by level 1 of zlib. The five of
fr2_desk_20 take 70 ms and 1.24 MB; level 3 takes 89 ms and 1.15 MB, or 219 ms and 1.13 MB with a filter chosen for each
row, as Pillow does."""


@contextmanager
def house_style() -> Iterator[None]:
    """Inside, figures are made in the house style; matplotlib's global settings are restored after."""
    import matplotlib

    with matplotlib.rc_context(_RC):
        yield


def new_figure(width: float, height: float) -> Figure:
    """A figure of the given size in inches that needs neither a screen nor pyplot's global state."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG; the same figure gives the same bytes."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    path.parent.mkdir(parents=True, exist_ok=True)
    canvas = FigureCanvasAgg(figure)
    with house_style():
        figure.set_dpi(_RC["savefig.dpi"])
        canvas.draw()  # once with the layout; `Figure.savefig` draws twice
    write_image(path, cv2.cvtColor(np.asarray(canvas.buffer_rgba()), cv2.COLOR_RGBA2BGR), PNG)


def to_numpy(values: Shaped[Tensor, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """A tensor of any device and dtype as float64 array, without its graph."""
    return values.detach().cpu().double().numpy()


def robust_box(path: Float[np.ndarray, "K D"], points: Float[np.ndarray, "N D"]) -> Float[np.ndarray, "D 2"]:
    """Limits that hold the whole path and the bulk of the points, but no far outliers.

    Points count between their 3rd and 97th percentile, and only as far from the path's center as 4 times
    the median point is, or 1.5 times the path extends.
    """
    if not len(path) and not len(points):
        return np.tile(np.array([-1.0, 1.0]), (points.shape[-1], 1))
    anchor = path if len(path) else np.median(points, axis=0, keepdims=True)
    low, high = anchor.min(axis=0), anchor.max(axis=0)
    if len(points):
        center = (low + high) / 2
        usual = float(np.median(np.linalg.norm(points - center, axis=1)))
        reach = max(4.0 * usual, 1.5 * float(np.linalg.norm(high - low)))
        point_low, point_high = np.percentile(points, [3.0, 97.0], axis=0)
        low = np.minimum(low, np.maximum(point_low, center - reach))
        high = np.maximum(high, np.minimum(point_high, center + reach))
    pad = 0.06 * max(float((high - low).max()), 1e-6)
    return np.stack([low - pad, high + pad], axis=1)


def thin(count: int, limit: int) -> Int[np.ndarray, " R"]:
    """Indices of at most `limit` of `count` rows, evenly spread, first and last included."""
    return np.arange(count) if count <= limit else np.linspace(0, count - 1, limit).round().astype(int)


SHADES = {
    State.LOST: ("#f3d9d2", "lost"),
    State.UNCERTAIN: ("#e2d2ec", "uncertain"),
    State.INITIALIZING: ("#f1ecdf", "initializing"),
}


def plot_errors(
    timestamps: Float[Tensor, " N"],
    errors_m: Float[Tensor, " N"],
    errors_rad: Float[Tensor, " N"] | None = None,
    results: Sequence[StepResult] = (),
    title: str = "",
) -> Figure:
    """The error of every posed frame with ground truth over time, colored by its size; spans without a pose shaded.

    The shading is by the results of all frames.
    """
    seconds = to_numpy(timestamps)
    origin = results[0].timestamp if results else float(seconds[0]) if len(seconds) else 0.0
    rows = [("position error (m)", to_numpy(errors_m))]
    if errors_rad is not None:
        rows.append(("rotation error (°)", np.degrees(to_numpy(errors_rad))))
    with house_style():
        figure = new_figure(9.0, 1.4 + 1.8 * len(rows))
        panels = figure.subplots(len(rows), 1, sharex=True, squeeze=False)[:, 0]
        for axes, (label, errors) in zip(panels, rows, strict=True):
            _shade(axes, results, origin)
            _colored_line(axes, seconds - origin, errors)
            rmse = float(np.sqrt(np.mean(errors**2))) if len(errors) else 0.0
            axes.axhline(rmse, color=MUTED, lw=0.9, ls=(0, (4, 3)), label="RMSE")
            axes.annotate(
                f"{rmse:.3g}", (1.0, rmse), (3, 0), ("axes fraction", "data"), "offset points", va="center"
            )
            axes.set(ylabel=label, ylim=(0.0, 1.08 * float(errors.max(initial=1e-9))))
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
        panels[-1].set_xlabel("time (s)")
        panels[0].set_title(title or "Error against ground truth")
    return figure


def plot_tracking(results: Sequence[StepResult], title: str = "", breaks: Sequence[str] = ()) -> Figure:
    """Map points matched per frame and those that agree with its pose; keyframes and lost spans marked.

    breaks: those of the check, as in metrics.json
    """
    origin = results[0].timestamp if results else 0.0
    seconds = np.array([result.timestamp for result in results]) - origin
    matches = np.array([result.matches for result in results], dtype=float)
    inliers = np.array([result.inliers for result in results], dtype=float)
    keyframes = np.array([result.is_keyframe for result in results], dtype=bool)
    with house_style():
        figure = new_figure(9.0, 3.2)
        axes = figure.add_subplot()
        _shade(axes, results, origin)
        axes.fill_between(seconds, matches, color=ESTIMATE, alpha=0.16, lw=0, label="matched")
        axes.plot(seconds, inliers, color=ESTIMATE, lw=1.2, label="agree with the pose")
        axes.plot(seconds[keyframes], inliers[keyframes], "o", ms=3.0, color=ACCENT, label="keyframe")
        starts = [int(found[1]) for each in breaks if (found := re.search(r"between frames (\d+)", each))]
        if (at := np.isin([result.index for result in results], starts)).any():
            axes.vlines(seconds[at], 0, 1, "red", transform=axes.get_xaxis_transform(), label="break")
        axes.set(xlabel="time (s)", ylabel="map points in the frame", ylim=(0.0, None))
        posed = inliers > 0
        median = np.median(inliers[posed]) if posed.any() else 0.0
        axes.set_title(f"{title or 'Tracking'}: {median:.0f} points agree with a pose (median)")
        axes.margins(x=0.0)
        figure.legend(loc="outside lower center", ncols=6)
    return figure


def _shade(axes: Axes, results: Sequence[StepResult], origin: float) -> None:
    """Shade the spans of frames that have no pose or an uncertain one, each kind labeled once."""
    labeled: set[State] = set()
    start = 0
    for end in range(1, len(results) + 1):
        state = results[start].state
        if end < len(results) and results[end].state is state:
            continue
        if state in SHADES:
            color, label = SHADES[state]
            label = "_" * (state in labeled) + label
            times = (results[row].timestamp - origin for row in (start, min(end, len(results) - 1)))
            axes.axvspan(*times, color=color, lw=0, label=label)
            labeled.add(state)
        start = end


def _colored_line(axes: Axes, seconds: np.ndarray, errors: np.ndarray) -> None:
    """A line colored by its height, broken where frames are missing."""
    from matplotlib.collections import LineCollection
    from matplotlib.colors import LinearSegmentedColormap

    knots = np.stack([seconds, errors], axis=1)
    segments = np.stack([knots[:-1], knots[1:]], axis=1) if len(knots) > 1 else np.zeros((0, 2, 2))
    steps = np.diff(seconds)
    near = steps <= 5.0 * np.median(steps) if len(steps) else np.zeros(0, dtype=bool)
    colors = LinearSegmentedColormap.from_list("errors", ["#3d8f7c", "#e0b352", "#c8553d"])
    lines = LineCollection(list(segments[near]), cmap=colors, lw=1.6, capstyle="round")
    lines.set_array(segments[near, :, 1].mean(axis=1))
    lines.set_clim(0.0, float(np.percentile(errors, 98)) if len(errors) else 1.0)
    axes.add_collection(lines)
    axes.set_xlim(min(0.0, seconds.min(initial=0.0)), seconds.max(initial=1e-3))


def plot_features(
    image: Float[Tensor, "H W"],
    keypoints: Float[Tensor, "N 2"],
    matched: Bool[Tensor, " N"],
    previous: Float[Tensor, "N 2"],
    lengths: Int[Tensor, " N"],
    title: str = "",
) -> Figure:
    """Keypoints on an image: map points as dots with a tail to where they were before, the others as rings.

    Args:
        image: gray in [0, 1].
        matched: keypoints of map points.
        previous: pixels of the same map points in an earlier frame, NaN if it did not observe them.
        lengths: number of keyframes that observe the point, for the color.
    """
    from matplotlib.collections import LineCollection
    from matplotlib.ticker import MaxNLocator

    gray = to_numpy(image)
    height, width = gray.shape
    is_matched = matched.cpu().numpy()
    x, y = to_numpy(keypoints).T
    with house_style():
        figure = new_figure(8.0, 6.9 * height / width + 0.75)
        axes = figure.add_subplot()
        axes.imshow(0.25 + 0.75 * gray, cmap="gray", vmin=0.0, vmax=1.0)
        rings: dict[str, Any] = {"ms": 2.6, "mfc": "none", "mec": "#f2ede2", "mew": 0.6, "alpha": 0.85}
        axes.plot(x[~is_matched], y[~is_matched], "o", zorder=1, **rings)
        tails = to_numpy(torch.stack([previous, keypoints], dim=1))[is_matched]
        known = np.isfinite(tails).all(axis=(1, 2))
        axes.add_collection(LineCollection(list(tails[known]), colors=ACCENT, lw=0.9, alpha=0.9, zorder=2))
        counts = lengths.cpu().numpy()[is_matched]
        edge: dict[str, Any] = {"linewidths": 0.3, "edgecolors": "#10222e"}
        dots = axes.scatter(x[is_matched], y[is_matched], 12, counts, cmap="viridis", zorder=3, **edge)
        if is_matched.any():
            about: dict[str, Any] = {
                "ticks": MaxNLocator(integer=True),
                "label": "keyframes that saw the point",
            }
            figure.colorbar(dots, ax=axes, shrink=0.7, pad=0.015, **about)
        axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xlabel="x (px)", ylabel="y (px)")
        axes.grid(visible=False)
        figures = f"{len(keypoints)} features, {int(is_matched.sum())} of them map points"
        axes.set_title(f"{title}: {figures}" if title else figures)
        axes.set_title("tails lead back to the keyframe before", loc="right", fontsize=8.5, color=MUTED)
    return figure
