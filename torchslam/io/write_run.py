"""Output of a finished run: colored map, results folder, plots and viewer."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.data.sequence import Sequence
from torchslam.errors import FrameError
from torchslam.evaluation import Evaluation, evaluate
from torchslam.geometry import so3_log, transform
from torchslam.io import plots as figures
from torchslam.io.results import PLOTS, Results, aligned, example_keyframe, read_results, write_results
from torchslam.io.viewer.page import write_view
from torchslam.map.map import NO_POINT, Map
from torchslam.system.run import Run
from torchslam.types import Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def write_run(
    run: Run,
    sequence: Sequence,
    metrics: dict[str, Any],
    folder: Path,
    *,
    online: Run | None = None,
    plots: bool = True,
    viewer: bool = True,
) -> None:
    """Color the map points, write the results folder and draw the run.

    Args:
        run: the finished run; its map points receive colors.
        sequence: the images of the run.
        metrics: the content of metrics.json, as by `compute_metrics`.
        folder: the results folder.
        online: the run frame by frame, if `run` is a global map.
        plots: whether to draw the plots.
        viewer: whether to write the viewer page.
    """
    colorize_points([submap.map for submap in run.submaps], sequence, run.session)
    write_results(run, sequence, metrics, folder, online)
    if not (plots or viewer):
        return
    results = read_results(folder)
    if plots:
        draw(results, folder)
    if viewer:
        write_view(results, folder)


def colorize_points(maps: Iterable[Map], sequence: Sequence, session: int) -> None:
    """Set the color of every point observed by keyframes of a session to its mean color in their images.

    The images are read again in temporal order; unreadable ones are skipped.
    """
    for slam_map in maps:
        if len(slam_map.points) == 0:
            continue
        device = slam_map.positions_w.device
        total = torch.zeros(len(slam_map.points), 4, dtype=torch.int64, device=device)
        for keyframe in slam_map.keyframe_rows(session).tolist():
            _add_colors(total, slam_map, keyframe, sequence)
        seen = torch.nonzero(total[:, 3])[:, 0]
        count = total[seen, 3:]
        slam_map.points["colors"][seen] = ((total[seen, :3] + count // 2) // count).to(torch.uint8)


def _add_colors(total: Tensor, slam_map: Map, keyframe: int, sequence: Sequence) -> None:
    """Add red, green, blue and a count of one to the rows (L, 4) of the points that a keyframe observes."""
    try:
        image = sequence.color(int(slam_map.keyframes["frame_index"][keyframe])).to(total.device)
    except FrameError:
        return
    ids = slam_map.keyframes["point_ids"][keyframe]
    height, width = image.shape[:2]
    pixels = slam_map.keyframes["detected"][keyframe][ids >= 0].round().long()
    colors = image[pixels[:, 1].clamp(0, height - 1), pixels[:, 0].clamp(0, width - 1)].long()
    ones = torch.ones_like(colors[:, :1])
    total.index_add_(0, ids[ids >= 0], torch.cat((colors, ones), dim=1))


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
        figures.save(figure, paths[-1])
    return paths


def _figures(results: Results) -> Iterator[tuple[str, Figure]]:
    if results.frames:
        yield "tracking", figures.plot_tracking(results.frames)
    if not len(results.trajectory):
        return
    yield from _scenes(results)
    if results.example_image is not None:
        yield from _example(results.map, results.session, results.example_image)


def _scenes(results: Results) -> Iterator[tuple[str, Figure]]:
    evaluation, truth = _evaluation(results), None
    trajectory, keyframes = results.trajectory, results.keyframes
    title = f"Path and map{_title_suffix(results)}"
    S = torch.eye(4, dtype=trajectory.T_wc.dtype, device="cpu")
    if evaluation is not None:
        yield "errors", _errors(evaluation, results)
        S = evaluation.S_groundtruth_estimate
        trajectory, keyframes, truth = evaluation.aligned, aligned(keyframes, S), _truth(results)
        title += f", ATE {evaluation.ate_m:.3g} m on {evaluation.path_length_m:.3g} m"
    unit = "" if truth is None and not results.metrics.get("metric") else "m"
    ids = results.map.valid_points()
    points_w = transform(S, results.map.positions_w[ids])
    certainty = [
        S[:3, :3] @ covariances_w @ S[:3, :3].mT
        for covariances_w in (
            results.map.center_covariances_w()[results.map.keyframe_rows(results.session)],
            results.map.points["covariances_w"][ids],
        )
    ]
    shown = keyframes if len(keyframes) else None  # a run that only localized shows the axes of its frames
    yield "scene", figures.plot_scene(trajectory, points_w, truth, shown, unit, title)
    yield (
        "top_view",
        figures.plot_top_view(
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
    return figures.plot_errors(
        evaluation.matched.timestamps, evaluation.errors_m, errors_rad, results.frames, title
    )


def _evaluation(results: Results) -> Evaluation | None:
    """Return the errors against ground truth if metrics.json has them."""
    if results.groundtruth is None or "ate_m" not in results.metrics:
        return None
    return evaluate(results.trajectory, results.groundtruth)


def _example(slam_map: Map, session: int, image: Float[Tensor, "H W"]) -> Iterator[tuple[str, Figure]]:
    """Plot the keypoints of the example keyframe, with tails to the previous keyframe."""
    keyframe = example_keyframe(slam_map, session)
    if keyframe is None:
        return
    columns = slam_map.keyframes
    mask, ids = columns["mask"][keyframe], columns["point_ids"][keyframe]
    previous = torch.full(
        (len(slam_map.points) + 1, 2), torch.nan, dtype=columns["keypoints"].dtype, device="cpu"
    )
    rows = slam_map.keyframe_rows(session).tolist()
    if rows[0] != keyframe:
        before = rows[rows.index(keyframe) - 1]
        seen = columns["point_ids"][before]
        previous[seen[seen >= 0]] = columns["keypoints"][before][seen >= 0]
    # NO_POINT, -1, reads the row at the end.
    counts = torch.cat((slam_map.points["times_observed"], torch.zeros(1, dtype=torch.int64, device="cpu")))
    yield (
        "features",
        figures.plot_features(
            image,
            columns["keypoints"][keyframe][mask],
            (ids > NO_POINT)[mask],
            previous[ids][mask],
            counts[ids][mask],
            title=f"Frame {int(columns['frame_index'][keyframe])}",
        ),
    )
