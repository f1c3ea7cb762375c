"""Run one row of a batch, from its settings to its folder of results; engines call it in any process."""

from __future__ import annotations

import glob
import json
import time
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch

from torchslam.batch.result_store import DIGITS, DONE, NO_MAP, Columns, hash_files, program_hash, run_or_reuse
from torchslam.batch.rows import Row
from torchslam.calibration.find_camera import camera_remark, find_camera, with_stated_std
from torchslam.config import Config, MetricConfig, load_config, to_toml
from torchslam.data import Sequence, open_sequence
from torchslam.data.formats.depth_images import find_depth_images, parse_depth_folder
from torchslam.data.readers.live import is_live
from torchslam.data.sequence import Calibrated
from torchslam.data.trajectories import read_trajectory
from torchslam.data.transforms import WithGroundTruth
from torchslam.errors import SequenceError
from torchslam.global_mapping.links import learned_config
from torchslam.global_mapping.mapper import mapping_config
from torchslam.global_mapping.recording import run_recording
from torchslam.io.report import compute_metrics
from torchslam.io.write_run import source_of, write_run
from torchslam.metric.options import given_files, given_options, sources_of
from torchslam.system.front_end import source
from torchslam.system.online_run import OnlineRun
from torchslam.system.slam import SLAM
from torchslam.utils.console import without_credentials
from torchslam.utils.files import fingerprint

TIMES = "times.json"
TIMED = ("fps", "ms_median", "ms_p95", "ms_longest", "stage_ms")
"""Metrics that vary between runs. Only `times.json` has them, with `cpu_s`: processor seconds of the run including
reading of images and calibration, without evaluation and writing."""


@dataclass(frozen=True)
class Task:
    """A row with the options that all rows of a batch share.

    Attributes:
        output: Folder of the batch.
        overwrite: Replace results of other settings, inputs or versions.
        plots: Draw plots and write view.html.
    """

    row: Row
    output: str
    device: str = "cpu"
    overwrite: bool = False
    plots: bool = True

    def as_dict(self) -> dict[str, Any]:
        """Convert to JSON values for `run_row`."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Task:
        """Restore a task from `as_dict`, also after a round trip through JSON."""
        row = dict(values["row"])
        return cls(**{**values, "row": Row(**{**row, "overrides": tuple(row["overrides"])})})


def run_row(task: Mapping[str, Any]) -> Columns:
    """Run a sequence, evaluate it and write its results, unless they exist already.

    The same task, a `Task` as a dictionary, gives the same bytes (except `times.json`) in any process and after any
    other task: it runs on one thread and keeps no state. It raises no Exception, see `run_or_reuse`.
    """
    todo = Task.from_dict(task)
    with _one_thread(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # metrics.json lists the unreadable frames
        return run_or_reuse(
            Path(todo.output),
            todo.row.name,
            lambda: {"configuration": configuration(todo), "input": _input(todo)},
            lambda folder: _run(todo, folder),
            todo.overwrite,
        )


def settings_of(row: Row) -> Config:
    """Load the configuration of a row. Raises ConfigError if it is not valid."""
    return load_config(None if row.config is None else row.resolve(row.config), row.overrides)


def configuration(task: Task) -> str:
    """Hash everything that the results depend on except the input files. Raises ConfigError for invalid settings."""
    row = asdict(replace(task.row, config=None, overrides=(), folder=""))
    settings, device = to_toml(settings_of(task.row)), torch.device(task.device).type
    return fingerprint([row, settings, device, task.plots, program_hash()], DIGITS)


def _input(task: Task) -> str:
    """Hash the files that the row reads, those with measurements and those that belong to them included."""
    row, settings = task.row, settings_of(task.row)
    found = [row.resolve(name) for name in (row.sequence, row.groundtruth, row.mask, row.camera) if name]
    found += filter(None, (settings.features.weights, settings.matching.weights))
    for option, name in given_files(settings.metric):
        if option == "depth":
            images = find_depth_images(*parse_depth_folder(name))
            found += [str(images.source), *map(str, images.paths)]
        else:
            found.append(name)
        if option == "imu":  # how its numbers are to be read may be in a file beside it
            found.append(str(Path(glob.escape(str(Path(name).parent)), "*.yaml")))
    return hash_files(found)


def open_row(row: Row) -> Sequence:
    """Open the sequence of a row with its camera and ground truth. Raises SequenceError for a live source."""
    if is_live(row.sequence) and not Path(row.resolve(row.sequence)).exists():
        raise SequenceError(f"{row.sequence}: a live source has no end and is not repeatable")
    camera = row.camera
    if camera is not None and Path(row.resolve(camera)).is_file():
        camera = row.resolve(camera)
    sequence = open_sequence(
        row.resolve(row.sequence),
        camera,
        fps=row.fps,
        limit=row.limit,
        stride=row.stride or 1,
        start=row.start or 0,
        stop=row.stop,
        resize_to=row.resize,
        mask=None if row.mask is None else row.resolve(row.mask),
    )
    if row.groundtruth is not None:
        sequence = WithGroundTruth(sequence, read_trajectory(row.resolve(row.groundtruth)))
    return sequence


def _run(task: Task, folder: Path) -> Columns:
    row, device = task.row, torch.device(task.device)
    config, sequence = settings_of(row), open_row(row)
    camera = ""
    sources = sources_of(given_options(config.metric, sequence.measurements))
    learned_config(mapping_config(config))  # raises now rather than after the online run
    start = time.process_time()
    if sequence.calibrated is not Calibrated.GIVEN:
        sequence, camera = find_camera(sequence, config, folder, device)
    config = with_stated_std(config, sequence)
    # What measures does so once, in the map that is kept.
    unmeasured = replace(config, metric=MetricConfig(own=False))
    slam = SLAM(sequence.camera.to(device), unmeasured)
    online = OnlineRun(slam, source(sequence, unmeasured, slam.camera), processes=1)
    finished = run_recording(online, sequence, sources=sources, device=device)
    if finished.interrupted:
        raise KeyboardInterrupt
    finished = replace(finished, config=replace(finished.config, metric=config.metric))
    seconds = time.process_time() - start
    metrics = compute_metrics(finished, sequence, camera_remark(finished, camera))
    times = {"cpu_s": seconds} | {name: metrics.pop(name) for name in TIMED}
    (folder / TIMES).write_text(json.dumps(times, indent=2) + "\n", encoding="utf-8")
    metrics |= source_of(row.resolve(row.sequence), row.fps, sequence)
    timeless = replace(finished, results=[replace(result, stage_ms={}) for result in finished.results])
    write_run(timeless, sequence, metrics, folder, plots=task.plots, viewer=task.plots)
    flat = {key: each for key, each in metrics.items() if each is None or isinstance(each, int | float | str)}
    return {
        "sequence": without_credentials(row.sequence),
        "status": NO_MAP if finished.failure else DONE,
        "error": finished.failure,
        **flat,
        **{f"rpe_{key}": value for key, value in metrics.get("rpe", {}).items()},
        "submaps": len(metrics["submaps"]),
        "skipped": len(metrics["skipped"]),
    }


@contextmanager
def _one_thread() -> Iterator[None]:
    """Restrict torch to one thread, since the order of sums depends on the number of threads."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
