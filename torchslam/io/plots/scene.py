"""Plots of the path and the map: two 3-D views, and a top view with covariance ellipses."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float
from torch import Tensor

from torchslam.io.export.recording import gaps
from torchslam.io.plots import charts as style
from torchslam.types import Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d import Axes3D


SIGMAS = 3.0  # size of an ellipse in standard deviations
TRUTH_LINE: dict[str, Any] = {"color": style.GROUND_TRUTH, "lw": 1.0, "ls": (0, (4, 2))}
"""Style of the true trajectory."""


def upright_axes(T_wc: Float[np.ndarray, "K 4 4"]) -> tuple[Float[np.ndarray, "3 3"], tuple[str, str, str]]:
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


def inside(points: Float[np.ndarray, "N D"], box: Float[np.ndarray, "D 2"]) -> Bool[np.ndarray, " N"]:
    """True for points within the limits."""
    return np.all((points >= box[:, 0]) & (points <= box[:, 1]), axis=1)


class _Scene:
    """Everything drawn, as numpy arrays in upright axes (z up); covariances are zero where unknown."""

    def __init__(
        self,
        trajectory: Trajectory,
        points_w: Tensor,
        groundtruth: Trajectory | None,
        keyframes: Trajectory | None,
        keyframe_covariances_w: Tensor | None = None,
        point_covariances_w: Tensor | None = None,
    ) -> None:
        T_wc = style.to_numpy(trajectory.T_wc)
        upright, self.labels = upright_axes(T_wc)
        shown = T_wc if keyframes is None else style.to_numpy(keyframes.T_wc)
        rows = style.thin(len(shown), 30)  # more hide each other
        points = style.to_numpy(points_w).reshape(-1, 3)
        finite = np.isfinite(points).all(axis=1)
        truth = np.zeros((0, 3)) if groundtruth is None else style.to_numpy(groundtruth.positions_w)

        def turned(covariances_w: Tensor | None, count: int) -> np.ndarray:
            if covariances_w is None:
                return np.zeros((count, 3, 3))
            return upright @ style.to_numpy(covariances_w) @ upright.T

        self.path, self.gaps = T_wc[:, :3, 3] @ upright.T, gaps(trajectory.timestamps)
        self.rotations, self.cameras = upright @ shown[rows, :3, :3], shown[rows, :3, 3] @ upright.T
        self.camera_covariances = turned(keyframe_covariances_w, len(shown))[rows]
        self.points = points[finite] @ upright.T
        self.point_covariances = turned(point_covariances_w, len(points))[finite]
        self.groundtruth = truth @ upright.T


def plot_scene(
    trajectory: Trajectory,
    points_w: Float[Tensor, "N 3"],
    groundtruth: Trajectory | None = None,
    keyframes: Trajectory | None = None,
    unit: str = "m",
    title: str = "",
) -> Figure:
    """The path, the map and the camera axes from two sides, equal scales on all axes.

    Axes, red x, green y, blue z (the viewing direction), are those of keyframes, by default of all frames. `unit` is ""
    if the scale is unknown.
    """
    scene = _Scene(trajectory, points_w, groundtruth, keyframes)
    box = style.robust_box(np.concatenate([scene.path, scene.groundtruth]), scene.points)
    with style.house_style():
        figure = style.new_figure(11.0, 4.7)
        # The layout engine would leave half of the picture to the invisible corners of the cubes.
        figure.set_layout_engine("none")
        for column, azimuth in enumerate((-62.0, 28.0)):
            axes = figure.add_axes((0.52 * column, 0.07, 0.48, 0.87), projection="3d", computed_zorder=False)
            _draw_3d(axes, scene, box, azimuth, unit or "map units")
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="lower center", ncols=len(labels))
        figure.suptitle(_title(title, scene, box), x=0.015, y=0.98, ha="left", fontsize=10.5)
    return figure


def plot_top_view(
    trajectory: Trajectory,
    points_w: Float[Tensor, "N 3"],
    groundtruth: Trajectory | None = None,
    keyframes: Trajectory | None = None,
    unit: str = "m",
    title: str = "",
    keyframe_covariances_w: Float[Tensor, "K 3 3"] | None = None,
    point_covariances_w: Float[Tensor, "N 3 3"] | None = None,
) -> Figure:
    """The path and the map seen against the cameras' mean up direction, equal scales. As `plot_scene`.

    Covariances of positions are drawn as ellipses of three standard deviations, those of keyframes magnified by the
    power of ten in the legend; none where zero.
    """
    scene = _Scene(trajectory, points_w, groundtruth, keyframes, keyframe_covariances_w, point_covariances_w)
    box = style.robust_box(np.concatenate([scene.path, scene.groundtruth])[:, :2], scene.points[:, :2])
    span = box[:, 1] - box[:, 0]
    width = float(np.clip(6.2 * span[0] / span[1], 4.5, 11.0))
    with style.house_style():
        figure = style.new_figure(width, float(np.clip(width * span[1] / span[0], 3.2, 7.0)) + 0.7)
        axes = figure.add_subplot()
        _draw_above(axes, scene, box)
        label = unit or "map units"
        axes.set(xlim=box[0], ylim=box[1], aspect="equal")
        axes.set(xlabel=f"{scene.labels[0]} ({label})", ylabel=f"{scene.labels[1]} ({label})")
        lines = textwrap.wrap(_title(title, scene, box), int(12 * width))
        figure.suptitle("\n".join(lines), x=0.02, ha="left", fontsize=10.5)
        figure.legend(loc="outside lower center", ncols=4 if width > 8.0 else 2)
    return figure


def _draw_3d(axes: Axes3D, scene: _Scene, box: np.ndarray, azimuth: float, unit: str) -> None:
    from matplotlib.ticker import MaxNLocator
    from mpl_toolkits.mplot3d.art3d import Line3DCollection

    points, dots = _drawn_points(scene.points, box)
    axes.scatter(*points.T, depthshade=False, zorder=1, **dots)
    for index, part in enumerate(np.split(scene.path, scene.gaps)):
        axes.plot(*part.T, color=style.ESTIMATE, lw=2.4, zorder=3, label="_" * (index > 0) + "estimate")
    if len(scene.groundtruth):
        axes.plot(*scene.groundtruth.T, zorder=4, label="ground truth", **TRUTH_LINE)
    length = 0.04 * float((box[:, 1] - box[:, 0]).max())
    for axis, color in enumerate(style.AXES_RGB):
        tips = scene.cameras + length * scene.rotations[:, :, axis]
        lines = Line3DCollection(np.stack([scene.cameras, tips], axis=1), colors=color, lw=1.0, zorder=2)
        lines.set_label(f"camera {'xyz'[axis]}")
        axes.add_collection3d(lines)
    axes.set(xlim=box[0], ylim=box[1], zlim=box[2], proj_type="ortho")
    axes.view_init(elev=28.0, azim=azimuth)
    _fit(axes, box)
    for axis, name in zip((axes.xaxis, axes.yaxis, axes.zaxis), scene.labels, strict=True):
        axis.set_pane_color((1.0, 1.0, 1.0, 0.0))
        axis.set_label_text(f"{name} ({unit})")
        axis.labelpad = 0.0 if axis is axes.zaxis else 6.0
        axis.set_major_locator(MaxNLocator(nbins=5, steps=[1, 2, 5, 10]))


def _fit(axes: Axes3D, box: np.ndarray) -> None:
    """Equal scales, and the largest zoom at which the box and its labels stay in their half of the picture."""
    from mpl_toolkits.mplot3d.proj3d import proj_transform

    spans = box[:, 1] - box[:, 0]
    axes.set_box_aspect(tuple(spans))
    axes.apply_aspect()
    corners = np.stack(np.meshgrid(*box, indexing="ij"), axis=-1).reshape(-1, 3)
    x, y, _ = proj_transform(*corners.T, axes.get_proj())
    room = axes.get_position(original=True)
    extent = np.ptp(axes.transData.transform(np.stack([x, y], axis=1)), axis=0)
    available = np.array([room.width, room.height]) * axes.get_figure(root=True).bbox.size
    axes.set_box_aspect(tuple(spans), zoom=float(0.84 * (available / extent).min()))


def _draw_above(axes: Axes, scene: _Scene, box: np.ndarray) -> None:
    from matplotlib.collections import LineCollection

    points, dots = _drawn_points(scene.points, box)
    axes.scatter(points[:, 0], points[:, 1], label="map point (lighter: higher)", **dots)
    for index, part in enumerate(np.split(scene.path, scene.gaps)):
        axes.plot(*part[:, :2].T, color=style.ESTIMATE, lw=2.4, label="_" * (index > 0) + "estimate")
    if len(scene.groundtruth):
        axes.plot(*scene.groundtruth[:, :2].T, label="ground truth", **TRUTH_LINE)
    width = float((box[:, 1] - box[:, 0]).max())
    tips = scene.cameras + 0.035 * width * scene.rotations[:, :, 2]
    ahead = np.stack([scene.cameras, tips], axis=1)[:, :, :2]
    lines = LineCollection(list(ahead), colors=style.AXES_RGB[2], lw=0.9)
    lines.set_label("viewing direction")
    axes.add_collection(lines)
    rows = style.thin(len(scene.points), 1500)
    centers, covariances = scene.points[rows, :2], scene.point_covariances[rows, :2, :2]
    draw_ellipses(axes, centers, covariances, "map point", "#cdc6c9", linewidth=0.5, zorder=0.5)
    centers, covariances = scene.cameras[:, :2], scene.camera_covariances[:, :2, :2]
    draw_ellipses(axes, centers, covariances, "keyframe", style.ACCENT, magnified_in=width)
    if len(scene.path):
        axes.plot(*scene.path[0, :2], "o", ms=6, mfc="white", mec=style.ESTIMATE, mew=1.5, label="start")
        axes.plot(*scene.path[-1, :2], "s", ms=5, color=style.ESTIMATE, label="end")


def _drawn_points(points: np.ndarray, box: np.ndarray) -> tuple[np.ndarray, dict[str, Any]]:
    """The points (L, 3) inside the picture, thinned where there are very many, and their style.

    They are larger if there are few, and in muted colors unlike those of the path.
    """
    from matplotlib.colors import LinearSegmentedColormap

    points = points[inside(points[:, : len(box)], box)]
    points = points[style.thin(len(points), 25_000)]
    heights = LinearSegmentedColormap.from_list("heights", ["#4d4463", "#8f7f86", "#cfa274"])
    size = float(np.clip(8e3 / max(len(points), 1), 1.5, 5.0))
    return points, {"c": points[:, 2], "cmap": heights, "s": size, "alpha": 0.75, "linewidths": 0}


def _title(title: str, scene: _Scene, box: np.ndarray) -> str:
    """The caption with the figures behind the picture: points, and how many of them lie outside of it."""
    outside = len(scene.points) - int(inside(scene.points[:, : len(box)], box).sum())
    figures = f"{len(scene.path)} poses, {len(scene.points)} points"
    figures += f" ({outside} outside the picture)" if outside else ""
    return f"{title}: {figures}" if title else figures


def draw_ellipses(
    axes: Axes,
    centers: np.ndarray,
    covariances: np.ndarray,
    what: str,
    color: str,
    magnified_in: float = 0.0,
    linewidth: float = 0.9,
    zorder: float = 5,
) -> None:
    """Draw covariances (L, 2, 2) around centers (L, 2), with an entry in the legend; skip those that are zero.

    Ellipses are magnified by the largest power of ten that keeps them small in a plot of the width `magnified_in`, if
    that is not 0.
    """
    from matplotlib.collections import EllipseCollection

    variances, directions = np.linalg.eigh(covariances)
    radii = SIGMAS * np.sqrt(variances.clip(min=0.0))
    known = radii[:, 1] > 0
    if not known.any():
        return
    radii, directions = radii[known], directions[known]
    largest = max(1.0, 0.06 * magnified_in / radii.max())
    magnification = 10.0 ** int(np.floor(np.log10(largest)))
    diameters = 2 * magnification * radii
    label = f"{what}, {SIGMAS:g} sigma" + (f" x {magnification:g}" if magnification > 1.0 else "")
    ellipses = EllipseCollection(
        diameters[:, 1],
        diameters[:, 0],
        np.degrees(np.arctan2(directions[:, 1, 1], directions[:, 0, 1])),
        units="xy",
        offsets=centers[known],
        offset_transform=axes.transData,
        facecolors="none",
        edgecolors=color,
        linewidths=linewidth,
        zorder=zorder,
    )
    axes.add_collection(ellipses)
    # A legend cannot show a collection of ellipses.
    axes.plot([], [], "o", ms=8, mfc="none", mec=color, mew=linewidth, label=label)
