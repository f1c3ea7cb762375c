"""Plots of a run, drawn from its results."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchslam.evaluation import Evaluation, evaluate
from torchslam.geometry import rigid, so3_log, transform
from torchslam.io import plots
from torchslam.io.results import PLOTS, Results, example_keyframe
from torchslam.map.map import NO_POINT, Map
from torchslam.system.run import keyframe_rows
from torchslam.types import Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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
        plots.save(figure, paths[-1])
    return paths


def _figures(results: Results) -> Iterator[tuple[str, Figure]]:
    if results.frames:
        yield "tracking", plots.plot_tracking(results.frames)
    if any(result.stage_ms for result in results.frames):
        yield "stages", plots.plot_stage_times(results.frames)
    if not len(results.trajectory):
        return
    yield from _scenes(results)
    if results.example_image is not None:
        yield from _example(results.map, results.session, results.example_image)


def _scenes(results: Results) -> Iterator[tuple[str, Figure]]:
    evaluation, truth = _evaluation(results), None
    trajectory, keyframes = results.trajectory, results.keyframes
    title = f"Path and map{_title_suffix(results)}"
    S = torch.eye(4, dtype=trajectory.T_wc.dtype)
    if evaluation is not None:
        yield "errors", _errors(evaluation, results)
        S = evaluation.S_groundtruth_estimate
        trajectory, keyframes, truth = evaluation.aligned, aligned(keyframes, S), _truth(results)
        title += f", ATE {evaluation.ate_m:.3g} m on {evaluation.path_length_m:.3g} m"
    unit = "" if truth is None else "m"
    ids = results.map.valid_points()
    points_w = transform(S, results.map.positions_w[ids])
    certainty = [
        S[:3, :3] @ covariances_w @ S[:3, :3].mT
        for covariances_w in (
            results.map.center_covariances_w()[keyframe_rows(results.map, results.session)],
            results.map.points["covariances_w"][ids],
        )
    ]
    shown = keyframes if len(keyframes) else None  # a run that only localized shows the axes of its frames
    yield "scene", plots.plot_scene(trajectory, points_w, truth, shown, unit, title)
    yield (
        "top_view",
        plots.plot_top_view(
            trajectory,
            points_w,
            truth,
            shown,
            unit,
            title,
            keyframe_covariances_w=certainty[0] if len(keyframes) else None,
            point_covariances_w=certainty[1],
        ),
    )


def _title_suffix(results: Results) -> str:
    """Return which of several submaps and sessions a plot shows; empty if there is one of each."""
    metrics, submaps = results.metrics, len(results.metrics["submaps"])
    of = f" of submap {metrics['submap']}, the main one of {submaps}" if submaps > 1 else ""
    return of + (f", session {results.session}" if results.session else "")


def _truth(results: Results) -> Trajectory | None:
    """Return the ground truth between the first and the last frame of the plotted submap."""
    truth, frames = results.groundtruth, results.frames
    if truth is None:
        return None
    start, end = frames[0].timestamp, frames[-1].timestamp
    if len(results.metrics["submaps"]) > 1:
        start, end = results.trajectory.timestamps[[0, -1]].tolist()
    during = (truth.timestamps >= start) & (truth.timestamps <= end)
    return Trajectory(truth.timestamps[during], truth.T_wc[during])


def _errors(evaluation: Evaluation, results: Results) -> Figure:
    estimated, true = evaluation.matched.T_wc[:, :3, :3], evaluation.groundtruth.T_wc[:, :3, :3]
    errors_rad = so3_log(true.mT @ estimated).norm(dim=-1)
    title = f"Error against ground truth, aligned by a similarity (scale {evaluation.scale:.4g})"
    return plots.plot_errors(
        evaluation.matched.timestamps, evaluation.errors_m, errors_rad, results.frames, title
    )


def aligned(trajectory: Trajectory, S: Tensor) -> Trajectory:
    """Poses after a similarity (4, 4) of the world."""
    rotation = S[:3, :3] / torch.linalg.det(S[:3, :3]) ** (1 / 3)
    return Trajectory(
        trajectory.timestamps,
        rigid(rotation @ trajectory.T_wc[:, :3, :3], transform(S, trajectory.positions_w)),
    )


def _evaluation(results: Results) -> Evaluation | None:
    """Return the errors against ground truth if metrics.json has them."""
    if results.groundtruth is None or "ate_m" not in results.metrics:
        return None
    return evaluate(results.trajectory, results.groundtruth)


def _example(slam_map: Map, session: int, image: Tensor) -> Iterator[tuple[str, Figure]]:
    """Plot the keypoints of the example keyframe, with tails to the previous keyframe."""
    keyframe = example_keyframe(slam_map, session)
    if keyframe is None:
        return
    columns = slam_map.keyframes
    mask, ids = columns["mask"][keyframe], columns["point_ids"][keyframe]
    previous = torch.full((len(slam_map.points) + 1, 2), torch.nan, dtype=columns["keypoints"].dtype)
    rows = keyframe_rows(slam_map, session).tolist()
    if rows[0] != keyframe:
        before = rows[rows.index(keyframe) - 1]
        seen = columns["point_ids"][before]
        previous[seen[seen >= 0]] = columns["keypoints"][before][seen >= 0]
    # NO_POINT, -1, reads the row at the end.
    counts = torch.cat((slam_map.points["times_observed"], torch.zeros(1, dtype=torch.int64)))
    yield (
        "features",
        plots.plot_features(
            image,
            columns["keypoints"][keyframe][mask],
            (ids > NO_POINT)[mask],
            previous[ids][mask],
            counts[ids][mask],
            title=f"Frame {int(columns['frame_index'][keyframe])}",
        ),
    )
