"""Output of a finished run: metrics, colored map, results folder, plots and viewer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torchslam.data import Sequence
from torchslam.io.export.colors import colorize_points
from torchslam.io.pictures import draw
from torchslam.io.results import read_results, write_results
from torchslam.io.viewer.page import write_view
from torchslam.system.run import Run


def write_run(
    run: Run,
    sequence: Sequence,
    figures: dict[str, Any],
    folder: Path,
    *,
    plots: bool = True,
    viewer: bool = True,
) -> None:
    """Color the map points, write the results folder and draw the run.

    Args:
        run: the finished run; its map points receive colors.
        sequence: the images of the run.
        figures: the content of metrics.json, as by `compute_metrics`.
        folder: the results folder.
        plots: whether to draw the plots.
        viewer: whether to write the viewer page.
    """
    colorize_points([submap.map for submap in run.submaps], sequence, run.session)
    write_results(run, sequence, figures, folder)
    if not (plots or viewer):
        return
    results = read_results(folder)
    if plots:
        draw(results, folder)
    if viewer:
        write_view(results, folder)
