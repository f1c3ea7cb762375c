"""Output of a finished run: metrics, colored map, results folder, plots and viewer."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchslam.data.sequence import Sequence
from torchslam.errors import FrameError
from torchslam.io.pictures import draw
from torchslam.io.results import read_results, write_results
from torchslam.io.viewer.page import write_view
from torchslam.map.map import Map
from torchslam.system.run import Run, keyframe_rows


def write_run(
    run: Run,
    sequence: Sequence,
    metrics: dict[str, Any],
    folder: Path,
    *,
    plots: bool = True,
    viewer: bool = True,
) -> None:
    """Color the map points, write the results folder and draw the run.

    Args:
        run: the finished run; its map points receive colors.
        sequence: the images of the run.
        metrics: the content of metrics.json, as by `compute_metrics`.
        folder: the results folder.
        plots: whether to draw the plots.
        viewer: whether to write the viewer page.
    """
    colorize_points([submap.map for submap in run.submaps], sequence, run.session)
    write_results(run, sequence, metrics, folder)
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
        for keyframe in keyframe_rows(slam_map, session).tolist():
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
    pixels = slam_map.keyframes["keypoints"][keyframe][ids >= 0].round().long()
    colors = image[pixels[:, 1].clamp(0, height - 1), pixels[:, 0].clamp(0, width - 1)].long()
    ones = torch.ones_like(colors[:, :1])
    total.index_add_(0, ids[ids >= 0], torch.cat((colors, ones), dim=1))
