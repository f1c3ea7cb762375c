"""Plot of one depth map: image, depth, normals and confidence side by side."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from torchslam.io.plots import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH = 14.0  # inches
UNKNOWN = "#d9d7d2"
LIMITS = (0.01, 0.99)
"""Quantiles of the depth that have the first and the last color."""
MARKS = 4  # on the scale of the depth


def draw_depth(
    image: UInt8[Tensor, "h w 3"],
    depth: Float[Tensor, "H W"],
    normal: Float[Tensor, "3 H W"],
    confidence: Float[Tensor, "H W"],
    path: Path,
    title: str = "",
) -> None:
    """Write `plot_depth` as a PNG file."""
    style.save(plot_depth(image, depth, normal, confidence, title), path)


def plot_depth(
    image: UInt8[Tensor, "h w 3"],
    depth: Float[Tensor, "H W"],
    normal: Float[Tensor, "3 H W"],
    confidence: Float[Tensor, "H W"],
    title: str = "",
) -> Figure:
    """Image, depth, normals and confidence of a frame. Where depth is unknown, nothing is drawn.

    Args:
        image: red, green, blue, of any size.
        depth: map units, 0 where unknown.
        normal: in the camera frame, facing the camera.
        confidence: 0 to 1.
        title: of the image.
    """
    from matplotlib.colors import LogNorm

    known = style.to_numpy(depth) > 0
    height, width = known.shape
    low, high = _limits(depth)
    # x to the right, y up, z to the camera: a surface that faces the camera is blue.
    facing = torch.stack((normal[0], -normal[1], -normal[2]), dim=-1)
    colors = ((style.to_numpy(facing) + 1) / 2).clip(0, 1)
    with style.house_style():
        figure = style.new_figure(WIDTH, 0.245 * WIDTH * height / width + 0.9)
        axes = figure.subplots(1, 4)
        axes[0].imshow(image.cpu().numpy())
        shown = axes[1].imshow(_only(style.to_numpy(depth), known), cmap="turbo_r", norm=LogNorm(low, high))
        axes[2].imshow(_only(colors, known))
        sure = axes[3].imshow(_only(style.to_numpy(confidence), known), cmap="viridis", vmin=0.0, vmax=1.0)
        marks = np.geomspace(low, high, MARKS + 2)[1:-1].tolist()
        scale = figure.colorbar(shown, ax=axes[1], orientation="horizontal", pad=0.03, aspect=40)
        scale.set_ticks(marks, labels=[f"{mark:.2g}" for mark in marks], minor=False)
        scale.minorticks_off()
        figure.colorbar(sure, ax=axes[3], orientation="horizontal", pad=0.03, aspect=40)
        share = f"{100 * known.mean():.0f}% known"
        names = (title or "image", f"depth (map units), {share}", "normals", "confidence")
        for each, name in zip(axes, names, strict=True):
            _frame(each, name)
    return figure


def _limits(depth: Tensor) -> tuple[float, float]:
    """The depths of the first and the last color, increasing."""
    found = depth[depth > 0].double()
    if not len(found):
        return 0.5, 2.0
    low, high = np.quantile(found.cpu().numpy(), LIMITS).tolist()
    return low, max(high, 1.01 * low)


def _only(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Values (H, W) masked, or colors (H, W, 3) with an opacity of 0, where they are unknown."""
    if values.ndim == 3:
        return np.concatenate((values, known[..., None]), axis=-1)
    return np.ma.masked_array(values, ~known)


def _frame(axes: Axes, name: str) -> None:
    axes.set(xticks=[], yticks=[], facecolor=UNKNOWN, anchor="N")  # some have a scale below
    axes.set_title(name)
    axes.grid(visible=False)
    for spine in axes.spines.values():
        spine.set_visible(False)
