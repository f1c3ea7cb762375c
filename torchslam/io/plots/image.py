"""Features and matches on an image."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from torchslam.io.plots import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def plot_features(
    image: Tensor, keypoints: Tensor, matched: Tensor, previous: Tensor, lengths: Tensor, title: str = ""
) -> Figure:
    """Keypoints on an image: map points as dots with a tail to where they were before, the others as rings.

    Args:
        image: (H, W) in [0, 1]
        keypoints: (N, 2) pixels
        matched: (N,) bool, keypoints of map points
        previous: (N, 2) pixels of the same map points in an earlier frame, NaN if it did not observe them
        lengths: (N,) number of keyframes that observe the point, for the color
    """
    from matplotlib.ticker import MaxNLocator

    gray = style.to_numpy(image)
    height, width = gray.shape
    is_matched = matched.cpu().numpy()
    x, y = style.to_numpy(keypoints).T
    with style.house_style():
        figure = style.new_figure(8.0, 6.9 * height / width + 0.75)
        axes = figure.add_subplot()
        axes.imshow(0.25 + 0.75 * gray, cmap="gray", vmin=0.0, vmax=1.0)
        axes.plot(
            x[~is_matched],
            y[~is_matched],
            "o",
            ms=2.6,
            mfc="none",
            mec="#f2ede2",
            mew=0.6,
            alpha=0.85,
            zorder=1,
        )
        _draw_tails(axes, keypoints[matched], previous[matched])
        counts = lengths.cpu().numpy()[is_matched]
        dots = axes.scatter(
            x[is_matched],
            y[is_matched],
            12,
            counts,
            cmap="viridis",
            linewidths=0.3,
            edgecolors="#10222e",
            zorder=3,
        )
        if is_matched.any():
            ticks = MaxNLocator(integer=True)
            figure.colorbar(
                dots, ax=axes, shrink=0.7, pad=0.015, ticks=ticks, label="keyframes that saw the point"
            )
        axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xlabel="x (px)", ylabel="y (px)")
        axes.grid(visible=False)
        figures = f"{len(keypoints)} features, {int(is_matched.sum())} of them map points"
        axes.set_title(f"{title}: {figures}" if title else figures)
        axes.set_title("tails lead back to the keyframe before", loc="right", fontsize=8.5, color=style.MUTED)
    return figure


def _draw_tails(axes: Axes, pixels: Tensor, previous: Tensor) -> None:
    from matplotlib.collections import LineCollection

    tails = style.to_numpy(torch.stack([previous, pixels], dim=1))
    known = np.isfinite(tails).all(axis=(1, 2))
    axes.add_collection(LineCollection(list(tails[known]), colors=style.ACCENT, lw=0.9, alpha=0.9, zorder=2))
