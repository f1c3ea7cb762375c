from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.figure import Figure

from torchslam.io import plots
from torchslam.io.plots.scene import upright_axes
from torchslam.types import State, StepResult, Trajectory

pytestmark = pytest.mark.filterwarnings("error")


@pytest.fixture
def points_w(generator: torch.Generator) -> torch.Tensor:
    """Around the path, with a few that are absurdly far away and one that is not a number."""
    points = 3 * torch.randn(500, 3, generator=generator, dtype=torch.float64)
    points[:5] *= 1e4
    points[5] = torch.nan
    return points


def features_figure(generator: torch.Generator, matched: int = 30) -> Figure:
    image = torch.rand(120, 160, generator=generator)
    keypoints = torch.rand(80, 2, generator=generator) * torch.tensor([160.0, 120.0])
    previous = keypoints + 3.0
    previous[::2] = torch.nan
    return plots.plot_features(
        image, keypoints, torch.arange(80) < matched, previous, torch.arange(80) % 7, "Frame 3"
    )


@pytest.fixture
def figures(
    trajectory: Trajectory, points_w: torch.Tensor, results: list[StepResult], generator: torch.Generator
) -> dict[str, Callable[[], Figure]]:
    errors = torch.rand(len(trajectory), generator=generator, dtype=torch.float64)
    return {
        "scene": lambda: plots.plot_scene(trajectory, points_w, trajectory, unit="m"),
        "top_view": lambda: plots.plot_top_view(trajectory, points_w, trajectory, unit="m"),
        "errors": lambda: plots.plot_errors(trajectory.timestamps, errors, 0.1 * errors, results),
        "tracking": lambda: plots.plot_tracking(results),
        "features": lambda: features_figure(torch.Generator().manual_seed(0)),
    }


NAMES = ["scene", "top_view", "errors", "tracking", "features"]


@pytest.mark.parametrize("name", NAMES)
def test_plots_are_drawn_deterministically(
    name: str, figures: dict[str, Callable[[], Figure]], tmp_path: Path
) -> None:
    for attempt in ("one", "two"):
        plots.save(figures[name](), tmp_path / attempt / f"{name}.png")
    first = tmp_path / "one" / f"{name}.png"
    assert first.read_bytes() == (tmp_path / "two" / f"{name}.png").read_bytes()
    picture = cv2.imread(str(first))
    assert min(picture.shape[:2]) > 300
    assert 0.01 < (picture < 200).any(axis=2).mean() < 0.9  # neither blank nor black


def test_far_points_do_not_stretch_the_picture(trajectory: Trajectory, points_w: torch.Tensor) -> None:
    figure = plots.plot_top_view(trajectory, points_w)
    axes = figure.axes[0]
    assert np.ptp(axes.get_xlim()) < 30
    assert axes.get_aspect() == 1.0
    assert "5 outside" in figure.get_suptitle().replace("\n", " ")


def test_a_map_with_y_down_is_plotted_over_x_and_z(trajectory: Trajectory, points_w: torch.Tensor) -> None:
    axes = plots.plot_top_view(trajectory, points_w, unit="").axes[0]
    assert axes.get_xlabel() == "x (map units)"
    assert axes.get_ylabel() == "z (map units)"
    path = next(line for line in axes.lines if line.get_label() == "estimate")
    np.testing.assert_allclose(path.get_xdata(), trajectory.positions_w[:, 0].numpy())
    np.testing.assert_allclose(path.get_ydata(), trajectory.positions_w[:, 2].numpy())


@pytest.mark.parametrize("up", [[0, 0, 1], [0, 0, -1], [0, 1, 0], [0, -1, 0], [1, 0, 0], [-1, 0, 0]])
def test_upright_axes_bring_up_to_z_without_mirroring(up: list[int]) -> None:
    T_wc = np.eye(4)[None].copy()
    T_wc[0, :3, 1] = -np.array(up)
    matrix, labels = upright_axes(T_wc)
    np.testing.assert_array_equal(matrix @ up, [0, 0, 1])
    assert np.linalg.det(matrix) == pytest.approx(1.0)
    for row, label in zip(matrix, labels, strict=True):
        assert row["xyz".index(label[-1])] == (-1 if label.startswith("-") else 1)


def test_camera_axes_follow_the_rotation(trajectory: Trajectory, points_w: torch.Tensor) -> None:
    axes = plots.plot_top_view(trajectory, points_w).axes[0]
    lines = next(part for part in axes.collections if isinstance(part, LineCollection))
    segments = np.array(lines.get_segments())
    directions = segments[:, 1] - segments[:, 0]
    ahead = trajectory.T_wc[:, :3, 2].numpy()[:, [0, 2]]
    np.testing.assert_allclose(
        directions / np.linalg.norm(directions, axis=1, keepdims=True),
        ahead / np.linalg.norm(ahead, axis=1, keepdims=True),
        atol=1e-9,
    )


def test_the_path_is_broken_where_poses_are_missing(trajectory: Trajectory, points_w: torch.Tensor) -> None:
    keep = torch.ones(len(trajectory), dtype=torch.bool)
    keep[10:20] = False
    broken = Trajectory(trajectory.timestamps[keep], trajectory.T_wc[keep])
    lines = plots.plot_top_view(broken, points_w).axes[0].lines
    parts = [line for line in lines if line.get_label().lstrip("_") == "estimate"]
    assert [len(part.get_xdata()) for part in parts] == [10, 10]


def test_spans_without_a_certain_pose_are_shaded(results: list[StepResult]) -> None:
    doubtful = [
        replace(result, state=State.UNCERTAIN) if 6 <= result.index < 9 else result for result in results
    ]
    patches = plots.plot_tracking(doubtful).axes[0].patches
    spans = {patch.get_label(): patch for patch in patches if not patch.get_label().startswith("_")}
    assert spans.keys() == {"initializing", "lost", "uncertain"}
    for name, first, count in (("lost", 18, 4), ("uncertain", 6, 3)):
        assert spans[name].get_x() == pytest.approx(first / 30)
        assert spans[name].get_width() == pytest.approx(count / 30)
    assert len({patch.get_facecolor() for patch in spans.values()}) == 3


def test_breaks_of_the_check_are_marked(results: list[StepResult]) -> None:
    axes = plots.plot_tracking(results, breaks=["the path breaks between frames 6 and 7"]).axes[0]
    (marks,) = [each for each in axes.collections if each.get_label() == "break"]
    assert [segment[0][0] for segment in marks.get_segments()] == pytest.approx([6 / 30])


def test_error_picture_states_the_rmse(results: list[StepResult]) -> None:
    seconds = torch.tensor([100.0, 100.5, 101.0], dtype=torch.float64)
    figure = plots.plot_errors(seconds, torch.tensor([0.3, 0.4, 0.0]), None, results)
    assert [text.get_text() for text in figure.axes[0].texts] == [f"{(0.25 / 3) ** 0.5:.3g}"]


def test_empty_plots_are_drawn(tmp_path: Path, generator: torch.Generator) -> None:
    pose = Trajectory(torch.zeros(1, dtype=torch.float64), torch.eye(4, dtype=torch.float64)[None])
    empty = [
        plots.plot_scene(pose, torch.zeros(0, 3)),
        plots.plot_top_view(pose, torch.zeros(0, 3)),
        plots.plot_errors(torch.zeros(1), torch.zeros(1)),
        plots.plot_tracking([]),
        features_figure(generator, matched=0),
    ]
    for index, figure in enumerate(empty):
        plots.save(figure, tmp_path / f"{index}.png")


def test_ellipses_show_keyframe_covariances(trajectory: Trajectory, points_w: torch.Tensor) -> None:
    covariances_w = 1e-6 * torch.eye(3, dtype=torch.float64).repeat(len(trajectory), 1, 1)
    covariances_w[0] = 0  # the fixed one
    covariances_w[1:, 0, 0] *= 4
    figure = plots.plot_top_view(
        trajectory, points_w, keyframes=trajectory, keyframe_covariances_w=covariances_w
    )
    (ellipses,) = (c for c in figure.axes[0].collections if isinstance(c, EllipseCollection))
    legend = [text.get_text() for text in figure.legends[0].get_texts()]
    (label,) = (text for text in legend if "sigma" in text)
    magnification = float(label.split(" x ")[1])
    assert magnification in (10, 100, 1000)
    widths, heights = ellipses.get_widths(), ellipses.get_heights()
    assert len(widths) == len(trajectory) - 1
    np.testing.assert_allclose(widths, 2 * 3 * 2e-3 * magnification)
    np.testing.assert_allclose(heights, 2 * 3 * 1e-3 * magnification)


def test_ellipses_of_points_are_of_true_size(trajectory: Trajectory, points_w: torch.Tensor) -> None:
    covariances_w = 1e-6 * torch.eye(3, dtype=torch.float64).repeat(len(points_w), 1, 1)
    figure = plots.plot_top_view(trajectory, points_w, point_covariances_w=covariances_w)
    (ellipses,) = (c for c in figure.axes[0].collections if isinstance(c, EllipseCollection))
    assert len(ellipses.get_offsets()) == int(points_w.isfinite().all(-1).sum())
    np.testing.assert_allclose(ellipses.get_widths(), 2 * 3e-3)
