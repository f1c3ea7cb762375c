"""Output of a finished run: the results folder, with the colors of the map, plots and viewer."""

from __future__ import annotations

import csv
import datetime
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch

from torchslam.config import to_toml
from torchslam.data.calibration import CALIBRATION, write_calibration
from torchslam.data.formats.image_file import write_image
from torchslam.data.opening import full_name
from torchslam.data.sequence import Sequence
from torchslam.data.trajectories import write_trajectory
from torchslam.errors import FrameError
from torchslam.geometry import geodetic_from_enu
from torchslam.io import results as files
from torchslam.io.export.ply import write_map_cloud
from torchslam.io.plots import draw
from torchslam.io.results import delete_dense, example_keyframe, read_results, write_metrics
from torchslam.io.viewer.page import write_view
from torchslam.loop_closing.records import write_closures
from torchslam.map.file import write_atlas
from torchslam.map.map import Map
from torchslam.map.unit import MetricUnit
from torchslam.metric.camera_path import SINCE_1970
from torchslam.system.run import Run
from torchslam.types import StepResult, Trajectory
from torchslam.utils.memory import return_freed_memory

GEOJSON = "trajectory.geojson"
GPX = "trajectory.gpx"
DIGITS = 9
"""Decimals of degrees: a tenth of a millimeter."""


def write_run(
    run: Run,
    sequence: Sequence,
    metrics: dict[str, Any],
    folder: Path,
    *,
    plots: bool = True,
    viewer: bool = True,
) -> None:
    """Write a run and its drawings into a results folder.

    Args:
        run: the finished run; its map points receive colors.
        sequence: the images of the run.
        metrics: the content of metrics.json, as by `compute_metrics`.
        folder: the results folder.
        plots, viewer: whether to draw the plots and to write the viewer page.
    """
    return_freed_memory()
    sequence = sequence.unzoomed(run.zoom)
    colorize_points([submap.map for submap in run.submaps], sequence, run.session)
    write_results(run, sequence, metrics, folder)
    redraw(folder, plots, viewer)


def redraw(folder: Path, plots: bool = True, viewer: bool = True) -> list[Path]:
    """Draw plots and viewer page of a results folder from its files; return what was written."""
    if not (plots or viewer):
        return []
    results = read_results(folder)
    paths = draw(results, folder) if plots else []
    return [*paths, write_view(results, folder)] if viewer else paths


def colorize_points(maps: Iterable[Map], sequence: Sequence, session: int) -> None:
    """Set the color of every point observed by keyframes of a session to its mean color in their images.

    The images are read again in temporal order; unreadable ones are skipped.
    """
    for slam_map in maps:
        if len(slam_map.points) == 0:
            continue
        device = slam_map.positions_w.device
        total = torch.zeros(
            len(slam_map.points), 4, dtype=torch.int64, device=device
        )  # of colors, and a count
        for keyframe in slam_map.keyframe_rows(session).tolist():
            try:
                image = sequence.color(int(slam_map.keyframes["frame_index"][keyframe])).to(device)
            except FrameError:
                continue
            ids = slam_map.keyframes["point_ids"][keyframe]
            height, width = image.shape[:2]
            pixels = slam_map.keyframes["detected"][keyframe][ids >= 0].round().long()
            colors = image[pixels[:, 1].clamp(0, height - 1), pixels[:, 0].clamp(0, width - 1)].long()
            total.index_add_(0, ids[ids >= 0], torch.nn.functional.pad(colors, (0, 1), value=1))
        seen = torch.nonzero(total[:, 3])[:, 0]
        count = total[seen, 3:]
        slam_map.points["colors"][seen] = ((total[seen, :3] + count // 2) // count).to(torch.uint8)


def write_results(run: Run, sequence: Sequence, metrics: dict[str, Any], directory: Path) -> None:
    """Write the results of a run as `write_run`, but no colors, plots and viewer; existing results are replaced."""
    directory.mkdir(parents=True, exist_ok=True)
    stale = [
        directory / name for name in (files.GROUND_TRUTH, files.EXAMPLE_IMAGE, files.GRAPH, GEOJSON, GPX)
    ]
    for old in [*stale, *directory.glob(files.OTHER_TRAJECTORY.format("[0-9]*"))]:
        old.unlink(missing_ok=True)
    delete_dense(directory)
    write_trajectory(directory / files.TRAJECTORY, run.trajectory)
    if run.metric is not None:
        write_earth(directory, run.trajectory, run.metric)
    write_trajectory(directory / files.ONLINE, run.online)
    for submap in run.submaps:
        if submap is not run.main and submap.posed_frames.count(run.session):
            path = directory / files.OTHER_TRAJECTORY.format(submap.number)
            write_trajectory(path, submap.trajectory(run.session))
    write_trajectory(directory / files.KEYFRAMES, run.keyframes)
    if sequence.groundtruth is not None:
        write_trajectory(directory / files.GROUND_TRUTH, sequence.groundtruth)
    write_atlas(directory / files.MAP, run.submaps, run.camera, run.sessions)
    if any(len(submap.map.points) for submap in run.submaps):
        run.graph.save(directory / files.GRAPH)
    write_closures(directory / files.LOOPS, run.loop_closures)
    write_map_cloud(directory / files.POINT_CLOUD, run.map, run.session, run.metric)
    if run.calibration is not None and not run.session:
        remark, std = str(metrics.get("camera", "")), run.calibration.focal_std
        write_calibration(directory / CALIBRATION, run.camera, [remark] if remark else [], std)
    (directory / files.CONFIG).write_text(to_toml(run.config), encoding="utf-8")
    write_metrics(directory, metrics)
    write_frames(directory / files.FRAMES, run.results, sequence)
    keyframe = example_keyframe(run.map, run.session)
    if keyframe is not None:
        try:
            image = sequence.image(int(run.map.keyframes["frame_index"][keyframe]))
        except FrameError:  # simulated features need no image; then there is nothing to draw
            return
        pixels = (image[0, 0] * 255.0).round().to(torch.uint8).cpu().numpy()
        write_image(directory / files.EXAMPLE_IMAGE, pixels)


def source_of(path: str, fps: float | None, sequence: Sequence) -> dict[str, Any]:
    """Return the entries of metrics.json from which the images are found again: path and options of `open_sequence`."""
    entries = {"source": full_name(path), "source_fps": fps}
    return entries | {"source_as_stored": True} if sequence.as_stored else entries


def write_frames(path: str | Path, results: list[StepResult], sequence: Sequence | None = None) -> None:
    """Write one row per frame; a missing submap, file or stage is an empty cell. The poses are in online.txt."""
    columns = ("index", "timestamp", "state", "submap", "keyframe", "matches", "inliers", "reason", "image")
    stages = list(dict.fromkeys(name for result in results for name in result.stage_ms))
    with Path(path).open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([*columns, *(stage + files.STAGE_SUFFIX for stage in stages)])
        for result in results:
            times = [f"{result.stage_ms[stage]:.3f}" if stage in result.stage_ms else "" for stage in stages]
            submap = "" if result.submap is None else result.submap
            image = "" if sequence is None else sequence.file_name(result.index)
            row = [result.index, repr(result.timestamp), result.state.value, submap]
            writer.writerow(
                [*row, int(result.is_keyframe), result.matches, result.inliers, result.reason, image, *times]
            )


def write_earth(folder: Path, trajectory: Trajectory, unit: MetricUnit) -> list[Path]:
    """Write the path of a map whose origin is known as a GeoJSON line and as a GPX track; return the files.

    The axes of the world are east, north and up. Nothing is written if the unit has no origin on the Earth. GPX has
    times if those of the images are dates. Sources: RFC 7946 (longitude before latitude); GPX 1.1.
    """
    if unit.origin is None or not len(trajectory):
        return []
    origin = torch.tensor(unit.origin, dtype=torch.float64, device="cpu")
    places = geodetic_from_enu(trajectory.positions_w.detach().double().cpu(), origin).tolist()
    times = trajectory.timestamps.tolist()
    line = [[round(lon, DIGITS), round(lat, DIGITS), round(altitude, 4)] for lat, lon, altitude in places]
    path = {
        "type": "Feature",
        "properties": {"timestamps": times, "meters_relative_std": unit.relative_std},
        "geometry": {"type": "LineString" if len(line) > 1 else "MultiPoint", "coordinates": line},
    }
    content = json.dumps({"type": "FeatureCollection", "features": [path]})
    (folder / GEOJSON).write_text(content + "\n", encoding="utf-8")
    points = []
    for time, (latitude, longitude, altitude) in zip(times, places, strict=True):
        place = f'<trkpt lat="{latitude:.{DIGITS}f}" lon="{longitude:.{DIGITS}f}"><ele>{altitude:.4f}</ele>'
        moment = datetime.datetime.fromtimestamp(time, tz=datetime.UTC) if time >= SINCE_1970 else None
        stamp = "" if moment is None else f"<time>{moment:%Y-%m-%dT%H:%M:%S.%f}Z</time>"
        points.append(f"{place}{stamp}</trkpt>")
    header = '<?xml version="1.0" encoding="UTF-8"?>\n<gpx version="1.1" creator="torchslam" '
    header += 'xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>'
    lines = "\n".join([header, *points, "</trkseg></trk></gpx>\n"])
    (folder / GPX).write_text(lines, encoding="utf-8")
    return [folder / GEOJSON, folder / GPX]
