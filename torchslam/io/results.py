"""The folder of results: what a run writes, and what the pictures are drawn from."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import torch
from torch import Tensor

from torchslam.config import to_toml
from torchslam.data.formats.image_file import read_gray
from torchslam.data.formats.trajectory_file import read_trajectory, write_trajectory
from torchslam.data.sequence import Sequence
from torchslam.errors import FrameError, ResultsError
from torchslam.geometry import Camera
from torchslam.io.export.ply import write_map_cloud
from torchslam.io.frames_file import read_frames, write_frames
from torchslam.map.atlas import Submap
from torchslam.map.file import read_atlas, write_atlas
from torchslam.map.map import Map
from torchslam.system.run import Run, keyframe_rows
from torchslam.types import StepResult, Trajectory
from torchslam.utils.bounded_read import JSON_BYTES, parse_json, read_text

TRAJECTORY = "trajectory.txt"
OTHER_TRAJECTORY = "trajectory_{}.txt"  # of the submap of that number
ONLINE = "online.txt"
KEYFRAMES = "keyframes.txt"
GROUND_TRUTH = "groundtruth.txt"
CALIBRATION = "calibration.txt"  # where the camera was found by the images
MAP = "map.safetensors"
CHECKPOINT = "checkpoint.safetensors"  # while a run is going on
POINT_CLOUD = "map.ply"
CONFIG = "config.toml"
METRICS = "metrics.json"
FRAMES = "frames.csv"
EXAMPLE_IMAGE = "example.png"
PLOTS = "plots"
NEEDED = ("submap", "submaps", "session", "posed", "keyframes")  # of metrics.json, to read and draw the rest


@dataclass(frozen=True)
class Results:
    """What a results folder holds, as far as pictures need it.

    trajectory, keyframes: of the main submap, camera to world, in the units of its map; without poses where none is
    groundtruth:           in meters, where the sequence had it
    others:                of the other submaps in which the run has poses, by their numbers
    map:                   of the main submap; empty where there is none
    submaps, camera:        all of them, with their camera
    frames:                one per frame, without poses
    metrics:               the content of metrics.json
    example_image:         (H, W) in [0, 1] of keyframe `example_keyframe(map, session)`, where it could be read
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
    example_image: Tensor | None

    @property
    def session(self) -> int:
        """Which run over the map it was."""
        return int(self.metrics["session"])


def write_results(run: Run, sequence: Sequence, figures: dict[str, Any], directory: Path) -> None:
    """Write everything that a run leaves behind, pictures apart, into a folder that is made if need be.

    figures: of the run, for metrics.json. What an earlier run wrote there is replaced.
    """
    directory.mkdir(parents=True, exist_ok=True)
    stale = [directory / name for name in (GROUND_TRUTH, EXAMPLE_IMAGE)]
    for old in (*stale, *directory.glob(OTHER_TRAJECTORY.format("[0-9]*"))):
        old.unlink(missing_ok=True)
    write_trajectory(directory / TRAJECTORY, run.trajectory)
    write_trajectory(directory / ONLINE, run.online)
    for submap in run.submaps:
        if submap is not run.main and submap.posed_frames.count(run.session):
            write_trajectory(
                directory / OTHER_TRAJECTORY.format(submap.number), submap.trajectory(run.session)
            )
    write_trajectory(directory / KEYFRAMES, run.keyframes)
    if sequence.groundtruth is not None:
        write_trajectory(directory / GROUND_TRUTH, sequence.groundtruth)
    write_atlas(directory / MAP, run.submaps, run.camera, run.sessions)
    write_map_cloud(directory / POINT_CLOUD, run.map, run.session)
    (directory / CONFIG).write_text(to_toml(run.config), encoding="utf-8")
    (directory / METRICS).write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    write_frames(directory / FRAMES, run.results)
    _write_example_image(directory / EXAMPLE_IMAGE, run, sequence)


def read_results(directory: Path) -> Results:
    """The results in a folder. Raises ResultsError, TrajectoryError or FrameError for what is missing or damaged."""
    if not directory.is_dir():
        raise ResultsError(f"{directory}: no such folder of results")
    saved, figures = read_atlas(directory / MAP), read_metrics(directory)
    main = [submap.map for submap in saved.atlas if submap.number == figures["submap"]]
    beside = {submap.number: directory / OTHER_TRAJECTORY.format(submap.number) for submap in saved.atlas}
    truth, example = directory / GROUND_TRUTH, directory / EXAMPLE_IMAGE
    return Results(
        trajectory=read_trajectory(directory / TRAJECTORY) if figures["posed"] else Trajectory.empty(),
        keyframes=read_trajectory(directory / KEYFRAMES) if figures["keyframes"] else Trajectory.empty(),
        groundtruth=read_trajectory(truth) if truth.exists() else None,
        others={number: read_trajectory(path) for number, path in beside.items() if path.exists()},
        map=main[0] if main else Map(),
        submaps=tuple(saved.atlas),
        camera=saved.camera,
        frames=read_frames(directory / FRAMES),
        metrics=figures,
        example_image=read_gray(example, str(example))[0, 0] if example.exists() else None,
    )


def read_metrics(directory: Path) -> dict[str, Any]:
    """The content of metrics.json. Raises ResultsError where it is missing or something else."""
    path = directory / METRICS
    try:
        figures = parse_json(read_text(path, JSON_BYTES, "a JSON file"))
    except OSError as error:
        raise ResultsError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise ResultsError(f"{path}: not valid JSON: {error}") from None
    missing = [name for name in NEEDED if not isinstance(figures, dict) or name not in figures]
    if missing:
        raise ResultsError(f"{path}: not the figures of a run: {', '.join(missing)} missing")
    wrong = [name for name, is_right in _FIGURES.items() if name in figures and not is_right(figures[name])]
    if wrong:
        raise ResultsError(f"{path}: not the figures of a run: {wrong[0]} is {repr(figures[wrong[0]])[:100]}")
    return figures


def _is_count(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 1 << 31


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < math.inf


def _are_submaps(value: object) -> bool:
    return isinstance(value, list) and all(
        isinstance(submap, dict) and _is_count(submap.get("submap")) for submap in value
    )


# What is read of metrics.json again, and what it must be.
_FIGURES: dict[str, Callable[[Any], bool]] = {
    "submap": lambda value: value is None or _is_count(value),
    "submaps": _are_submaps,
    "ate_m": _is_number,
    **dict.fromkeys(("session", "posed", "keyframes"), _is_count),
    "failure": lambda value: isinstance(value, str),
    "source": lambda value: value is None or isinstance(value, str),
}


def results_in(directory: Path) -> list[Path]:
    """The files in a folder that `write_results` would replace."""
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
    """The keyframe that is drawn as an example: in the middle of the session; None where it has none."""
    rows = keyframe_rows(slam_map, session)
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
    cv2.imwrite(str(path), (image[0, 0] * 255.0).round().to(torch.uint8).cpu().numpy())
