"""Common style of all plots: palette, fonts, axes limits without far outliers, saving."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ESTIMATE = "#3f7aa6"
GROUND_TRUTH = "#2f2f2f"
ACCENT = "#c8553d"
LOST = "#f3d9d2"
UNCERTAIN = "#e2d2ec"
INITIALIZING = "#f1ecdf"
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
    path.parent.mkdir(parents=True, exist_ok=True)
    with house_style():
        figure.savefig(path, format="png", metadata={"Software": None})


def to_numpy(values: Shaped[Tensor, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """A tensor of any device and dtype as float64 array, without its graph."""
    return values.detach().cpu().double().numpy()


def upright_axes(
    T_wc: Float[np.ndarray, "K 4 4"],
) -> tuple[Float[np.ndarray, "3 3"], tuple[str, str, str]]:
    """The signed axis permutation that brings the cameras' mean up direction closest to +z, and its names.

    The names are labels such as ("x", "z", "-y"). The world's own axes are kept, so the labels stay true: a world
    whose y points down (cameras, KITTI) is drawn over its x-z plane.
    """
    up = -T_wc[:, :3, 1].mean(axis=0) if len(T_wc) else np.array([0.0, 0.0, 1.0])
    vertical = int(np.abs(up).argmax())
    sign = 1.0 if up[vertical] >= 0 else -1.0
    first, second = [axis for axis in range(3) if axis != vertical]
    rows = np.zeros((3, 3))
    rows[0, first], rows[1, second], rows[2, vertical] = 1.0, 1.0, sign
    names = ["xyz"[first], "xyz"[second], ("-" if sign < 0 else "") + "xyz"[vertical]]
    if np.linalg.det(rows) < 0:  # keep the picture right-handed, not mirrored
        rows[1] *= -1
        names[1] = "-" + names[1]
    return rows, (names[0], names[1], names[2])


def robust_box(
    path: Float[np.ndarray, "K D"], points: Float[np.ndarray, "N D"], margin: float = 0.06
) -> Float[np.ndarray, "D 2"]:
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
        reach = max(
            4.0 * float(np.median(np.linalg.norm(points - center, axis=1))),
            1.5 * float(np.linalg.norm(high - low)),
        )
        point_low, point_high = np.percentile(points, [3.0, 97.0], axis=0)
        low = np.minimum(low, np.maximum(point_low, center - reach))
        high = np.maximum(high, np.minimum(point_high, center + reach))
    pad = margin * max(float((high - low).max()), 1e-6)
    return np.stack([low - pad, high + pad], axis=1)


def inside(points: Float[np.ndarray, "N D"], box: Float[np.ndarray, "D 2"]) -> Bool[np.ndarray, " N"]:
    """True for points within the limits."""
    return np.all((points >= box[:, 0]) & (points <= box[:, 1]), axis=1)


def thin(count: int, limit: int) -> Int[np.ndarray, " R"]:
    """Indices of at most `limit` of `count` rows, evenly spread, first and last included."""
    return np.arange(count) if count <= limit else np.linspace(0, count - 1, limit).round().astype(int)


def length_label(unit: str) -> str:
    """`m` or, where the scale is unknown, a word for it."""
    return unit if unit else "map units"
