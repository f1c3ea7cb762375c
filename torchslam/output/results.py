"""The folder of results: what a run writes, and what the pictures are drawn from."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import torch
from torch import Tensor

from torchslam.config import to_toml
from torchslam.data.image_file import read_grey
from torchslam.data.sequence import Sequence
from torchslam.data.trajectory_file import read_trajectory, write_trajectory
from torchslam.errors import FrameError, ResultsError
from torchslam.output.frames_file import read_frames, write_frames
from torchslam.output.ply import write_ply
from torchslam.run import Run
from torchslam.values import StepResult, Trajectory
from torchslam.world.map import Map
from torchslam.world.map_file import read_map, write_worlds

TRAJECTORY = "trajectory.txt"
KEYFRAMES = "keyframes.txt"
GROUND_TRUTH = "groundtruth.txt"
MAP = "map.safetensors"
POINT_CLOUD = "map.ply"
CONFIG = "config.toml"
METRICS = "metrics.json"
FRAMES = "frames.csv"
EXAMPLE_IMAGE = "example.png"
PLOTS = "plots"


@dataclass(frozen=True)
class Results:
    """What a results folder holds, as far as pictures need it.

    trajectory, keyframes: camera to world, in the units of the map; without poses when no map was initialised
    groundtruth:           in metres, where the sequence had it
    frames:                one per frame, without poses
    metrics:               the content of metrics.json
    example_image:         (H, W) in [0, 1] of keyframe `example_keyframe(map)`, where it could be read
    """

    trajectory: Trajectory
    keyframes: Trajectory
    groundtruth: Trajectory | None
    map: Map
    frames: list[StepResult]
    metrics: dict[str, Any]
    example_image: Tensor | None


def write_results(run: Run, sequence: Sequence, figures: dict[str, Any], directory: Path) -> None:
    """Write everything that a run leaves behind, pictures apart, into a folder that is made if need be.

    figures: of the run, for metrics.json. What an earlier run wrote there is replaced.
    """
    directory.mkdir(parents=True, exist_ok=True)
    for name in (GROUND_TRUTH, EXAMPLE_IMAGE):
        (directory / name).unlink(missing_ok=True)
    write_trajectory(directory / TRAJECTORY, run.trajectory)
    write_trajectory(directory / KEYFRAMES, run.keyframes)
    if sequence.groundtruth is not None:
        write_trajectory(directory / GROUND_TRUTH, sequence.groundtruth)
    write_worlds(directory / MAP, run.worlds, run.camera, run.sessions)
    _write_point_cloud(directory / POINT_CLOUD, run)
    (directory / CONFIG).write_text(to_toml(run.config), encoding="utf-8")
    (directory / METRICS).write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    write_frames(directory / FRAMES, run.results)
    _write_example_image(directory / EXAMPLE_IMAGE, run.map, sequence)


def read_results(directory: Path) -> Results:
    """The results in a folder. Raises ResultsError, TrajectoryError or FrameError for what is missing or damaged."""
    if not directory.is_dir():
        raise ResultsError(f"{directory}: no such folder of results")
    slam_map, _ = read_map(directory / MAP)
    is_empty = slam_map.num_keyframes == 0
    truth, example = directory / GROUND_TRUTH, directory / EXAMPLE_IMAGE
    return Results(
        trajectory=_no_poses() if is_empty else read_trajectory(directory / TRAJECTORY),
        keyframes=_no_poses() if is_empty else read_trajectory(directory / KEYFRAMES),
        groundtruth=read_trajectory(truth) if truth.exists() else None,
        map=slam_map,
        frames=read_frames(directory / FRAMES),
        metrics=_read_metrics(directory / METRICS),
        example_image=read_grey(example, str(example))[0, 0] if example.exists() else None,
    )


def example_keyframe(slam_map: Map) -> int:
    """The keyframe that is drawn as an example: in the middle of the run."""
    return slam_map.num_keyframes // 2


def _write_point_cloud(path: Path, run: Run) -> None:
    if run.map.num_keyframes == 0:
        nothing = torch.zeros(0, 3)
        write_ply(path, nothing, nothing, torch.zeros(0), nothing)
        return
    alive = run.map.living_points()
    normals_w = -run.map.points["normals_w"][alive]
    counts = run.map.points["times_observed"][alive]
    write_ply(path, run.map.positions_w[alive], normals_w, counts, run.keyframes.positions_w)


def _write_example_image(path: Path, slam_map: Map, sequence: Sequence) -> None:
    if slam_map.num_keyframes == 0:
        return
    index = int(slam_map.keyframes["frame_index"][example_keyframe(slam_map)])
    try:
        image = sequence.image(index)
    except FrameError:  # simulated features need no image; then there is nothing to draw
        return
    cv2.imwrite(str(path), (image[0, 0] * 255.0).round().to(torch.uint8).cpu().numpy())


def _read_metrics(path: Path) -> dict[str, Any]:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ResultsError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise ResultsError(f"{path}: not valid JSON: {error}") from None


def _no_poses() -> Trajectory:
    return Trajectory(torch.zeros(0, dtype=torch.float64), torch.zeros(0, 4, 4, dtype=torch.float64))
