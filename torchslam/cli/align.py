"""Scale a finished run to meters by markers, clicked lengths, the camera height, or other measurements.

The options are those of `torchslam run`. Map, trajectories, metrics, plots and viewer of the results folder are written
again; later exports are in meters. Dense depth of the folder is removed: `torchslam densify` computes it again.
If the run is in meters already, its scale is kept, and the measurements are compared with it.

Exit status: 0 done, 2 an error, 3 no source determined the scale, and nothing was changed.
"""

from __future__ import annotations

import argparse
from typing import Any

from jaxtyping import Float
from torch import Tensor

from torchslam.cli import arguments
from torchslam.config import load_config
from torchslam.data.trajectories import read_trajectory, write_trajectory
from torchslam.errors import ConfigError, ResultsError, TrajectoryError
from torchslam.evaluation import evaluate
from torchslam.io import results as files
from torchslam.io.export.ply import write_map_cloud
from torchslam.io.export.scene import Images
from torchslam.io.report import accuracy, unit_words
from torchslam.io.results import SavedRun, aligned, delete_dense, open_run, read_results, write_metrics
from torchslam.io.write_run import redraw
from torchslam.map.atlas import Submap
from torchslam.map.file import write_atlas
from torchslam.metric.meters import bring_into_meters
from torchslam.metric.options import KINDS, given_options, sources_of
from torchslam.metric.source import SubmapView
from torchslam.utils.console import say, table, warn


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `torchslam align`."""
    arguments.add_directory(parser)
    arguments.add_metric(parser)
    arguments.add_images(parser)


def execute(options: argparse.Namespace) -> int:
    """Execute `torchslam align`; returns the exit status."""
    sources = sources_of(given_options(load_config(None, arguments.metric_overrides(options)).metric))
    if not sources:
        flags = ", ".join(kind.options[0].flag for kind in KINDS)
        raise ConfigError(f"no source of scale: give one of {flags}")
    run = open_run(options.directory)
    moved: dict[int, Float[Tensor, "4 4"]] = {}
    unmeasured: list[str] = []
    for submap in run.submaps:
        if not submap.posed_frames.count(run.session):
            continue
        images = _images(run, submap, options.images)
        view = SubmapView(submap, run.camera, run.session, images, run.readout)
        S_mw, silent = bring_into_meters(view, sources)
        moved |= {submap.number: S_mw} if submap.metric is not None else {}
        if submap is run.main:
            unmeasured = [f"{each.source}: {each.reason}" for each in silent]
    for line in unmeasured:
        warn(line)
    if not moved:
        say(f"{run.directory}: no source determined the scale; nothing was changed")
        return 3
    metrics = _write(run, moved, unmeasured)
    for line in (metrics["metric"] or {}).get("remarks", ()):
        warn(line)
    print(table({"unit": unit_words(metrics), "results": str(run.directory)} | accuracy(metrics)))
    return 0


def _images(run: SavedRun, submap: Submap, elsewhere: str | None) -> Images | None:
    """The images of the run, by its frames; None and a message where they are not available."""
    otherwise = "use --images for its new location"
    try:
        scene = run.scene(submap, keyframes_alone=False)
        return run.images(scene, elsewhere=elsewhere, otherwise=otherwise)
    except ResultsError as error:
        if elsewhere is not None:
            raise
        say(f"without images: {error}")
        return None


def _write(run: SavedRun, moved: dict[int, Float[Tensor, "4 4"]], unmeasured: list[str]) -> dict[str, Any]:
    """Write what depends on the unit; returns the metrics."""
    directory, session, metrics = run.directory, run.session, run.metrics
    results = read_results(directory)  # before anything changes: all of it can be read
    for submap in run.submaps:
        if submap.number not in moved:
            continue
        name = files.TRAJECTORY if submap is run.main else files.OTHER_TRAJECTORY.format(submap.number)
        write_trajectory(directory / name, submap.trajectory(session))  # markers have moved single poses
        if submap is run.main:
            online = aligned(read_trajectory(directory / files.ONLINE), moved[submap.number])
            write_trajectory(directory / files.ONLINE, online)
            write_trajectory(directory / files.KEYFRAMES, submap.map.keyframe_trajectory(session))
            write_map_cloud(directory / files.POINT_CLOUD, submap.map, session, submap.metric)
    write_atlas(directory / files.MAP, run.submaps, run.camera, run.sessions)
    if delete_dense(directory):
        say(
            f"dense depth had another scale and is removed; `torchslam densify {directory}` computes it again"
        )
        metrics.pop("dense", None)
    main = run.main
    metric = None if main is None else main.metric
    metrics |= {"metric": None if metric is None else metric.as_dict(), "unmeasured": unmeasured}
    if main is not None and results.groundtruth is not None and "ate_m" in metrics:
        try:
            metrics |= evaluate(main.trajectory(session), results.groundtruth).as_dict()
        except TrajectoryError as error:
            warn(f"no evaluation: {error}")
    write_metrics(directory, metrics)
    redraw(directory)
    return metrics
