"""The results folder of a run: its files, written and read."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.config import to_toml
from torchslam.data.calibration import CALIBRATION, write_calibration
from torchslam.data.formats.image_file import read_gray, write_image
from torchslam.data.opening import full_name
from torchslam.data.sequence import Sequence
from torchslam.data.text_file import read_cells, read_object
from torchslam.data.trajectories import read_trajectory, write_trajectory
from torchslam.dense.cloud import PointCloud
from torchslam.errors import FrameError, ResultsError
from torchslam.geometry import Camera, rigid, transform
from torchslam.geometry.rolling_shutter import MAX_READOUT, Readout
from torchslam.global_mapping.saved_stages import delete_stages
from torchslam.io.export.earth import GEOJSON, GPX, write_earth
from torchslam.io.export.ply import read_cloud, upright_from_map, write_map_cloud
from torchslam.io.export.scene import ExampleFrame, ImageSource
from torchslam.map.atlas import Submap
from torchslam.map.file import read_atlas, write_atlas
from torchslam.map.map import Map
from torchslam.system.run import Run
from torchslam.types import Explanation, State, StepResult, Trajectory
from torchslam.utils.console import is_unicode
from torchslam.utils.files import write_whole

TRAJECTORY = "trajectory.txt"
OTHER_TRAJECTORY = "trajectory_{}.txt"  # of the submap of that number
ONLINE = "online.txt"
KEYFRAMES = "keyframes.txt"
GROUND_TRUTH = "groundtruth.txt"
MAP = "map.safetensors"
CHECKPOINT = "checkpoint.safetensors"  # while a run is going on
STAGES = "global_mapping"  # folder of the saved stages of global mapping, during a run
POINT_CLOUD = "map.ply"
DENSE_CLOUD = "dense.ply"  # of the main submap, z up as in POINT_CLOUD
MESH = "mesh.ply"  # of the main submap, z up as in POINT_CLOUD
DEPTHS = Path("dense") / "depths.safetensors"  # of keyframes of the main submap
PICTURES = Path("dense") / "pictures"
PICTURE_NAMES = "[0-9]" * 6 + ".png"
"""Pattern of the names of depth pictures: six digits of the frame."""
CONFIG = "config.toml"
METRICS = "metrics.json"
FRAMES = "frames.csv"
EXAMPLE_IMAGE = "example.png"
PLOTS = "plots"
PROBE = ".torchslam-can-write"
NEEDED = ("submap", "submaps", "session", "posed", "keyframes")  # of metrics.json, to read and draw the rest


@dataclass(frozen=True)
class Results:
    """Content of a results folder, for plots and viewer.

    Attributes:
        trajectory, keyframes: camera to world in the main submap, in its units; possibly empty.
        groundtruth: in meters, if the sequence has it.
        others: trajectories in the other submaps, by submap number.
        map: map of the main submap; empty if there is none.
        submaps, camera: all submaps and their camera.
        frames: one result per frame, without poses.
        metrics: the content of metrics.json.
        example_image: gray in [0, 1], of keyframe `example_keyframe(map, session)`, if readable.
        cloud: the dense cloud in the world of the main submap, if there is one.
    """

    trajectory: Trajectory
    keyframes: Trajectory
    groundtruth: Trajectory | None
    others: dict[int, Trajectory]
    map: Map
    submaps: tuple[Submap, ...]
    camera: Camera
    frames: list[StepResult]
    metrics: dict[str, Any]
    example_image: Float[Tensor, "H W"] | None
    cloud: PointCloud | None = None

    @property
    def session(self) -> int:
        """Number of the run on the map."""
        return int(self.metrics["session"])


def aligned(trajectory: Trajectory, S: Float[Tensor, "4 4"]) -> Trajectory:
    """Return a trajectory after a similarity of the world."""
    return Trajectory(trajectory.timestamps, aligned_poses(trajectory.T_wc, S))


def aligned_poses(T_wc: Float[Tensor, "N 4 4"], S: Float[Tensor, "4 4"]) -> Float[Tensor, "N 4 4"]:
    """Return poses after a similarity of the world."""
    rotation = S[:3, :3] / torch.linalg.det(S[:3, :3]) ** (1 / 3)
    return rigid(rotation @ T_wc[:, :3, :3], transform(S, T_wc[:, :3, 3]))


def prepare(folder: Path, overwrite: bool, resume: bool) -> None:
    """Create the results folder and check that it can be written to, before the run.

    Args:
        folder: the results folder.
        overwrite: replace existing results; their checkpoint and saved stages are deleted at once.
        resume: continue from the checkpoint and the saved stages in the folder.

    Raises:
        ResultsError: if the folder has results that would be lost, or a name with which they could not be read again.
        OSError: if the folder cannot be written to.
    """
    if not is_unicode(str(folder.absolute())):
        raise ResultsError(
            f"{folder}: its name is not UTF-8, so that maps in it could not be read: choose another one"
        )
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(folder / PROBE, b"")
    (folder / PROBE).unlink()
    there = results_in(folder)
    unfinished = [path for path in (folder / CHECKPOINT, folder / STAGES) if path.exists()]
    if overwrite:
        delete_unfinished(folder)
    elif unfinished and not resume:
        raise ResultsError(
            f"{unfinished[0]}: an unfinished run: --resume continues it, --overwrite replaces it"
        )
    elif there and not unfinished:
        what = "but no checkpoint to resume from" if resume else "which would be lost"
        raise ResultsError(f"{there[0]}: results of an earlier run, {what}: --overwrite replaces them")


def delete_unfinished(folder: Path) -> None:
    """Delete what an unfinished run would be resumed from."""
    (folder / CHECKPOINT).unlink(missing_ok=True)
    delete_stages(folder / STAGES)


def write_results(
    run: Run, sequence: Sequence, metrics: dict[str, Any], directory: Path, online: Run | None = None
) -> None:
    """Write the results of a run, except plots and viewer, into a folder; existing results are replaced.

    Args:
        run: the finished run.
        sequence: its images.
        metrics: the content of metrics.json.
        directory: the results folder, created if missing.
        online: the run frame by frame, if `run` is a global map.
    """
    directory.mkdir(parents=True, exist_ok=True)
    stale = [
        directory / name for name in (GROUND_TRUTH, EXAMPLE_IMAGE, DENSE_CLOUD, DEPTHS, MESH, GEOJSON, GPX)
    ]
    stale += [*directory.glob(OTHER_TRAJECTORY.format("[0-9]*")), *(directory / PICTURES).glob(PICTURE_NAMES)]
    for old in stale:
        old.unlink(missing_ok=True)
    write_trajectory(directory / TRAJECTORY, run.trajectory)
    if run.metric is not None:
        write_earth(directory, run.trajectory, run.metric)
    write_trajectory(directory / ONLINE, (run if online is None else online).online)
    for submap in run.submaps:
        if submap is not run.main and submap.posed_frames.count(run.session):
            write_trajectory(
                directory / OTHER_TRAJECTORY.format(submap.number), submap.trajectory(run.session)
            )
    write_trajectory(directory / KEYFRAMES, run.keyframes)
    if sequence.groundtruth is not None:
        write_trajectory(directory / GROUND_TRUTH, sequence.groundtruth)
    write_atlas(directory / MAP, run.submaps, run.camera, run.sessions)
    write_map_cloud(directory / POINT_CLOUD, run.map, run.session, run.metric)
    if run.calibration is not None and not run.session:
        remark, std = str(metrics.get("camera", "")), run.calibration.focal_std
        write_calibration(directory / CALIBRATION, run.camera, [remark] if remark else [], std)
    (directory / CONFIG).write_text(to_toml(run.config), encoding="utf-8")
    (directory / METRICS).write_text(json.dumps(metrics, indent=2) + "\n", encoding="utf-8")
    write_frames(directory / FRAMES, run.results, sequence)
    _write_example_image(directory / EXAMPLE_IMAGE, run, sequence)


def read_results(directory: Path) -> Results:
    """Read a results folder. Raises ResultsError, TrajectoryError or FrameError for missing or damaged files."""
    if not directory.is_dir():
        raise ResultsError(f"{directory}: no such results folder")
    saved, metrics = read_atlas(directory / MAP), read_metrics(directory)
    main = [submap for submap in saved.atlas if submap.number == metrics["submap"]]
    paths = {submap.number: directory / OTHER_TRAJECTORY.format(submap.number) for submap in saved.atlas}
    truth, example = directory / GROUND_TRUTH, directory / EXAMPLE_IMAGE
    cloud = directory / DENSE_CLOUD
    return Results(
        trajectory=read_trajectory(directory / TRAJECTORY) if metrics["posed"] else Trajectory.empty(),
        keyframes=read_trajectory(directory / KEYFRAMES) if metrics["keyframes"] else Trajectory.empty(),
        groundtruth=read_trajectory(truth) if truth.exists() else None,
        others={number: read_trajectory(path) for number, path in paths.items() if path.exists()},
        map=main[0].map if main else Map(),
        submaps=tuple(saved.atlas),
        camera=saved.camera,
        frames=read_frames(directory / FRAMES),
        metrics=metrics,
        example_image=read_gray(example, str(example))[0, 0] if example.exists() else None,
        cloud=read_cloud(cloud, upright_from_map(main[0].map, main[0].metric))
        if main and cloud.exists()
        else None,
    )


def read_metrics(directory: Path) -> dict[str, Any]:
    """Read metrics.json. Raises ResultsError if it is missing or invalid."""
    path = directory / METRICS
    metrics = read_object(path, ResultsError)
    if metrics is None:
        raise ResultsError(f"{path}: cannot be read: No such file or directory")
    missing = [name for name in NEEDED if name not in metrics]
    if missing:
        raise ResultsError(f"{path}: not the metrics of a run: {', '.join(missing)} missing")
    wrong = [
        name for name, is_right in _METRIC_CHECKS.items() if name in metrics and not is_right(metrics[name])
    ]
    if wrong:
        raise ResultsError(f"{path}: not the metrics of a run: {wrong[0]} is {repr(metrics[wrong[0]])[:100]}")
    return metrics


def readout_of(metrics: dict[str, Any]) -> Readout | None:
    """The readout of a rolling shutter that a run found or was given; None for a global shutter."""
    entry = metrics.get("readout")
    return None if entry is None else Readout.known(1e-3 * entry["ms"], 1e-3 * entry["std_ms"])


def _is_readout(value: object) -> bool:
    """Whether a value is none, or what `readout_of` reads."""
    if value is None:
        return True
    if not isinstance(value, dict):
        return False
    milliseconds: list[Any] = [value.get("ms"), value.get("std_ms")]
    return all(_is_number(number) and abs(number) <= 1e3 * MAX_READOUT for number in milliseconds)


def _is_count(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 1 << 31


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < math.inf


def _are_submaps(value: object) -> bool:
    return isinstance(value, list) and all(
        isinstance(submap, dict) and _is_count(submap.get("submap")) for submap in value
    )


# Validation of the entries that are read from metrics.json.
_METRIC_CHECKS: dict[str, Callable[[Any], bool]] = {
    "submap": lambda value: value is None or _is_count(value),
    "submaps": _are_submaps,
    "ate_m": _is_number,
    "readout": _is_readout,
    **dict.fromkeys(("session", "posed", "keyframes"), _is_count),
    "failure": lambda value: isinstance(value, str),
    "source": lambda value: value is None or isinstance(value, str),
}


def results_in(directory: Path) -> list[Path]:
    """Return the files in a folder that `write_results` would replace."""
    names = (
        METRICS,
        TRAJECTORY,
        MAP,
        KEYFRAMES,
        ONLINE,
        GROUND_TRUTH,
        POINT_CLOUD,
        CONFIG,
        FRAMES,
        EXAMPLE_IMAGE,
    )
    return [directory / name for name in names if (directory / name).exists()]


def example_keyframe(slam_map: Map, session: int) -> int | None:
    """Return the keyframe in the middle of the session, for the example plot; None if there is none."""
    rows = slam_map.keyframe_rows(session)
    return int(rows[len(rows) // 2]) if len(rows) else None


def _write_example_image(path: Path, run: Run, sequence: Sequence) -> None:
    keyframe = example_keyframe(run.map, run.session)
    if keyframe is None:
        return
    index = int(run.map.keyframes["frame_index"][keyframe])
    try:
        image = sequence.image(index)
    except FrameError:  # simulated features need no image; then there is nothing to draw
        return
    write_image(path, (image[0, 0] * 255.0).round().to(torch.uint8).cpu().numpy())


FRAME_COLUMNS = ("index", "timestamp", "state", "submap", "keyframe", "matches", "inliers", "reason", "image")
STAGE_SUFFIX = "_ms"
MAX_FRAMES_BYTES = 1 << 28
"""Size limit of frames.csv, enough for two million frames."""


def write_frames(path: str | Path, results: list[StepResult], sequence: Sequence | None = None) -> None:
    """Write one row per frame; a missing submap, file or stage is an empty cell. The poses are in online.txt."""
    stages = list(dict.fromkeys(name for result in results for name in result.stage_ms))
    with Path(path).open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([*FRAME_COLUMNS, *(stage + STAGE_SUFFIX for stage in stages)])
        for result in results:
            times = [f"{result.stage_ms[stage]:.3f}" if stage in result.stage_ms else "" for stage in stages]
            submap = "" if result.submap is None else result.submap
            image = "" if sequence is None else sequence.file_name(result.index)
            row = [result.index, repr(result.timestamp), result.state.value, submap]
            writer.writerow(
                [*row, int(result.is_keyframe), result.matches, result.inliers, result.reason, image, *times]
            )


def read_frames(path: str | Path) -> list[StepResult]:
    """Read the rows of frames.csv, without poses. Raises ResultsError naming file and line."""
    return [result for result, _ in _read_rows(path)]


def source_of(path: str, fps: float | None, sequence: Sequence) -> dict[str, Any]:
    """Return the entries of metrics.json from which the images are found again: path and options of `open_sequence`."""
    entries = {"source": full_name(path), "source_fps": fps}
    return entries | {"source_as_stored": True} if sequence.as_stored else entries


def read_image_source(
    directory: Path, metrics: dict[str, Any], submaps: Iterable[Submap], elsewhere: str | None = None
) -> ImageSource | None:
    """Read where the images of a run are, and by what they are found; None if they are not stated.

    Args:
        directory: the results folder.
        metrics: its metrics.
        submaps: those of its map.
        elsewhere: the images' new location; None: where the run read them.

    Raises:
        ResultsError: frames.csv is missing or damaged.
    """
    path, session = elsewhere or metrics.get("source"), int(metrics["session"])
    if path is None:
        return None
    rows = _read_rows(directory / FRAMES)
    main = [submap.map for submap in submaps if submap.number == metrics["submap"]]
    keyframe = example_keyframe(main[0], session) if main else None
    image, example = directory / EXAMPLE_IMAGE, None
    if keyframe is not None and image.exists():
        frame_id = int(main[0].keyframes["frame_index"][keyframe])
        time = float(main[0].keyframes["timestamp"][keyframe])
        example = ExampleFrame(frame_id, time, read_gray(image, str(image)))
    files = {result.index: file for result, file in rows if file}
    return ImageSource(
        path, metrics.get("source_fps"), files, example, metrics.get("source_as_stored") is True
    )


def _read_rows(path: str | Path) -> list[tuple[StepResult, str]]:
    """The frames and their files, empty if frames are no files."""
    rows = read_cells(path, ResultsError, MAX_FRAMES_BYTES, ",")
    header = next(rows, ("", []))[1]
    cells = ((where, dict(zip(header, each, strict=True))) for where, each in rows)
    # Folders that earlier versions wrote have no files.
    return [(_frame_result(row, where), row.get("image") or "") for where, row in cells]


def _frame_result(row: dict[str, str], where: str) -> StepResult:
    try:
        _check_counts(row)
        return StepResult(
            index=int(row["index"]),
            timestamp=_finite(row["timestamp"]),
            state=State(row["state"]),
            T_cw=None,
            submap=int(row["submap"]) if row["submap"] else None,
            is_keyframe=bool(int(row["keyframe"])),
            matches=int(row["matches"]),
            inliers=int(row["inliers"]),
            reasons=Explanation.parsed(row["reason"]),
            stage_ms={
                name.removesuffix(STAGE_SUFFIX): _finite(value)
                for name, value in row.items()
                if name.endswith(STAGE_SUFFIX) and value
            },
        )
    except (KeyError, ValueError, TypeError, AttributeError) as error:
        raise ResultsError(f"{where}: not a row of frames.csv: {error}") from None


def _check_counts(row: dict[str, str]) -> None:
    """Raise ValueError for impossible counts and missing columns."""
    for name in ("index", "submap", "keyframe", "matches", "inliers"):
        if row[name] and not 0 <= int(row[name]) < 1 << 31:
            raise ValueError(f"{name} is {int(row[name])}")


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"`{text}` is not a finite number")
    return number
