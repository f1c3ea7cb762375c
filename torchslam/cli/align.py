"""Scale a finished run to meters by markers, clicked lengths, the camera height, or other measurements.

The options are those of `torchslam run`. Map, trajectories, metrics, plots and viewer of the results folder are written
again; later exports are in meters. Dense depth of the folder is removed: `torchslam densify` computes it again.
If the run is in meters already, its scale is kept, and the measurements are compared with it.

Exit status: 0 done, 2 an error, 3 no source determined the scale, and nothing was changed.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from torchslam.cli import arguments
from torchslam.config import load_config
from torchslam.data.trajectories import read_trajectory, write_trajectory
from torchslam.errors import ConfigError, ResultsError, TrajectoryError
from torchslam.evaluation import evaluate
from torchslam.io.export.ply import write_map_cloud
from torchslam.io.export.scene import Images, open_images, scene_of
from torchslam.io.report import accuracy, unit_words
from torchslam.io.results import (
    DENSE_CLOUD,
    DEPTHS,
    KEYFRAMES,
    MAP,
    MESH,
    METRICS,
    ONLINE,
    OTHER_TRAJECTORY,
    PICTURE_NAMES,
    PICTURES,
    POINT_CLOUD,
    TRAJECTORY,
    aligned,
    read_image_source,
    read_metrics,
    read_results,
    readout_of,
)
from torchslam.io.viewer.page import write_view
from torchslam.io.write_run import draw
from torchslam.map.atlas import Submap
from torchslam.map.file import SavedAtlas, read_atlas, write_atlas
from torchslam.metric.meters import bring_into_meters
from torchslam.metric.options import KINDS, given_options, sources_of
from torchslam.metric.source import SubmapView
from torchslam.utils.console import say, table, warn
from torchslam.utils.files import write_whole

DONE = 0
"""Exit status of a run in meters."""
NOTHING = 3
"""Exit status where no source determined the scale."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `torchslam align`."""
    arguments.add_directory(parser)
    arguments.add_metric(parser)
    parser.add_argument(
        "--images", metavar="PATH", help="the images of the run, if they are not where the run read them"
    )


def execute(options: argparse.Namespace) -> int:
    """Execute `torchslam align`; returns the exit status."""
    directory: Path = options.directory
    sources = sources_of(given_options(load_config(None, arguments.metric_overrides(options)).metric))
    if not sources:
        flags = ", ".join(kind.options[0].flag for kind in KINDS)
        raise ConfigError(f"no source of scale: give one of {flags}")
    if not directory.is_dir():
        raise ResultsError(f"{directory}: no such results folder")
    metrics, saved = read_metrics(directory), read_atlas(directory / MAP)
    session = int(metrics["session"])
    moved: dict[int, Float[Tensor, "4 4"]] = {}
    unmeasured: list[str] = []
    for submap in saved.atlas:
        if not submap.posed_frames.count(session):
            continue
        images = _images(directory, metrics, saved, submap, options.images)
        view = SubmapView(submap, saved.camera, session, images, readout_of(metrics))
        S_mw, silent = bring_into_meters(view, sources)
        moved |= {submap.number: S_mw} if submap.metric is not None else {}
        if submap.number == metrics["submap"]:
            unmeasured = [f"{each.source}: {each.reason}" for each in silent]
    for line in unmeasured:
        warn(line)
    if not moved:
        say(f"{directory}: no source determined the scale; nothing was changed")
        return NOTHING
    metrics = _write(directory, metrics, saved, moved, unmeasured)
    for line in (metrics["metric"] or {}).get("remarks", ()):
        warn(line)
    print(table({"unit": unit_words(metrics), "results": str(directory)} | accuracy(metrics)))
    return DONE


def _images(
    directory: Path, metrics: dict[str, Any], saved: SavedAtlas, submap: Submap, elsewhere: str | None
) -> Images | None:
    """The images of the run, by its frames; None and a message where they are not available."""
    source = read_image_source(directory, metrics, saved.atlas, elsewhere)
    if source is None:
        return None
    scene = scene_of(submap, saved.camera, int(metrics["session"]), keyframes_alone=False)
    try:
        return open_images(source, scene, otherwise="use --images for its new location")
    except ResultsError as error:
        if elsewhere is not None:
            raise
        say(f"without images: {error}")
        return None


def _write(
    directory: Path,
    metrics: dict[str, Any],
    saved: SavedAtlas,
    moved: dict[int, Float[Tensor, "4 4"]],
    unmeasured: list[str],
) -> dict[str, Any]:
    """Write what depends on the unit; returns the metrics."""
    results, main = read_results(directory), int(metrics["submap"])
    by_number = {submap.number: submap for submap in saved.atlas}
    session = results.session
    for number, S_mw in moved.items():
        submap = by_number[number]
        name = TRAJECTORY if number == main else OTHER_TRAJECTORY.format(number)
        write_trajectory(directory / name, submap.trajectory(session))  # markers have moved single poses
        if number == main:
            write_trajectory(directory / ONLINE, aligned(read_trajectory(directory / ONLINE), S_mw))
            write_trajectory(directory / KEYFRAMES, submap.map.keyframe_trajectory(session))
            write_map_cloud(directory / POINT_CLOUD, submap.map, session, submap.metric)
    write_atlas(directory / MAP, saved.atlas, saved.camera, saved.sessions)
    gone = [directory / name for name in (DENSE_CLOUD, DEPTHS, MESH) if (directory / name).exists()]
    for path in [*gone, *(directory / PICTURES).glob(PICTURE_NAMES)]:
        path.unlink()
    if gone:
        say(
            f"dense depth had another scale and is removed; `torchslam densify {directory}` computes it again"
        )
        metrics.pop("dense", None)
    metric = by_number[main].metric
    metrics |= {"metric": None if metric is None else metric.as_dict(), "unmeasured": unmeasured}
    if results.groundtruth is not None and "ate_m" in metrics:
        try:
            metrics |= evaluate(by_number[main].trajectory(session), results.groundtruth).as_dict()
        except TrajectoryError as error:
            warn(f"no evaluation: {error}")
    write_whole(directory / METRICS, (json.dumps(metrics, indent=2) + "\n").encode())
    written = read_results(directory)
    draw(written, directory)
    write_view(written, directory)
    return metrics
