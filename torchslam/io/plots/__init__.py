"""Plots of one run: functions of plain values that return a matplotlib figure; `save` writes it, `draw` writes all."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.geometry import so3_log, transform
from torchslam.io.plots.charts import plot_errors, plot_features, plot_tracking, save
from torchslam.io.plots.scene import plot_scene, plot_top_view
from torchslam.io.results import PLOTS, Results, aligned, example_keyframe
from torchslam.map.map import NO_POINT, Map

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["draw", "plot_errors", "plot_features", "plot_scene", "plot_top_view", "plot_tracking", "save"]


def draw(results: Results, directory: Path) -> list[Path]:
    """Draw all plots that the results allow into the folder `plots` and return the files.

    With ground truth, path and map are aligned to it by a similarity.
    """
    folder = directory / PLOTS
    for old in folder.glob("*.png"):
        old.unlink()
    paths = []
    for name, figure in _figures(results):
        paths.append(folder / f"{name}.png")
        save(figure, paths[-1])
    return paths


def _figures(results: Results) -> Iterator[tuple[str, Figure]]:
    if results.frames:
        yield "tracking", plot_tracking(results.frames, breaks=results.breaks)
    if not len(results.trajectory):
        return
    yield from _scenes(results)
    keyframe = example_keyframe(results.map, results.session)
    if results.example_image is not None and keyframe is not None:
        yield "features", _example(results.map, keyframe, results.session, results.example_image)


def _scenes(results: Results) -> Iterator[tuple[str, Figure]]:
    """The errors, and path and map of the main submap from the side and from above."""
    evaluation, truth = results.evaluation(results.trajectory), None
    trajectory, keyframes, frames = results.trajectory, results.keyframes, results.frames
    submaps = len(results.submaps)
    title = f"Path and map of submap {results.metrics['submap']}, the main one of {submaps}"
    title = title if submaps > 1 else "Path and map"
    title += f", session {results.session}" if results.session else ""
    S = torch.eye(4, dtype=trajectory.T_wc.dtype, device="cpu")
    if evaluation is not None:
        true, matched = evaluation.groundtruth.T_wc[:, :3, :3], evaluation.matched
        errors_rad = so3_log(true.mT @ matched.T_wc[:, :3, :3]).norm(dim=-1)
        about = f"Error against ground truth, aligned by a similarity (scale {evaluation.scale:.4g})"
        yield "errors", plot_errors(matched.timestamps, evaluation.errors_m, errors_rad, frames, about)
        S = evaluation.S_groundtruth_estimate
        truth = results.truth(frames[0].timestamp, frames[-1].timestamp)
        if submaps > 1:
            truth = results.truth(*trajectory.timestamps[[0, -1]].tolist())
        trajectory, keyframes = evaluation.aligned, aligned(keyframes, S)
        title += f", ATE {evaluation.ate_m:.3g} m on {evaluation.path_length_m:.3g} m"
    unit = "" if truth is None and not results.metrics.get("metric") else "m"
    ids, rows = results.map.valid_points(), results.map.keyframe_rows(results.session)
    points_w = transform(S, results.map.positions_w[ids])
    both = (results.map.center_covariances_w()[rows], results.map.points["covariances_w"][ids])
    of_keyframes, of_points = (S[:3, :3] @ covariances_w @ S[:3, :3].mT for covariances_w in both)
    shown = keyframes if len(keyframes) else None  # a run that only localized shows the axes of its frames
    yield "scene", plot_scene(trajectory, points_w, truth, shown, unit, title)
    certainty = of_keyframes if len(keyframes) else None
    yield "top_view", plot_top_view(trajectory, points_w, truth, shown, unit, title, certainty, of_points)


def _example(slam_map: Map, keyframe: int, session: int, image: Float[Tensor, "H W"]) -> Figure:
    """Plot the keypoints of the example keyframe, with tails to the previous keyframe."""
    columns = slam_map.keyframes
    mask, ids = columns["mask"][keyframe], columns["point_ids"][keyframe]
    kind = columns["keypoints"].dtype
    previous = torch.full((len(slam_map.points) + 1, 2), torch.nan, dtype=kind, device="cpu")
    rows = slam_map.keyframe_rows(session).tolist()
    if rows[0] != keyframe:
        before = rows[rows.index(keyframe) - 1]
        seen = columns["point_ids"][before]
        previous[seen[seen >= 0]] = columns["keypoints"][before][seen >= 0]
    # NO_POINT, -1, reads the row at the end.
    counts = torch.cat((slam_map.points["times_observed"], torch.zeros(1, dtype=torch.int64, device="cpu")))
    return plot_features(
        image,
        columns["keypoints"][keyframe][mask],
        (ids > NO_POINT)[mask],
        previous[ids][mask],
        counts[ids][mask],
        title=f"Frame {int(columns['frame_index'][keyframe])}",
    )
