"""One row of a batch, from its settings to its folder of results: what an engine calls, in whatever process."""

from __future__ import annotations

import json
import time
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch

from torchslam.batch.result_store import (
    DONE,
    NO_MAP,
    Columns,
    hash_content,
    hash_files,
    hash_json,
    program_hash,
    run_or_reuse,
)
from torchslam.batch.rows import Row
from torchslam.calibration.find_camera import RADIAL, find_camera
from torchslam.config import Config, load_config, to_toml
from torchslam.data import Sequence, open_sequence
from torchslam.data.camera_argument import unknown_camera
from torchslam.data.formats.trajectory_file import read_trajectory
from torchslam.data.given_truth import WithTruth
from torchslam.data.opening import full_name
from torchslam.data.readers.registry import live
from torchslam.data.sequence import Calibrated
from torchslam.errors import SequenceError
from torchslam.io.metrics import compute_metrics
from torchslam.io.write_run import write_run
from torchslam.system.run import Run
from torchslam.system.slam import SLAM

TIMES = "times.json"
TIMED = ("fps", "ms_median", "ms_p95", "stage_ms")
"""Of the figures: those that are never twice the same. They are in `times.json` alone, with `cpu_s`: seconds of the
processor for the run, with reading of images and finding of the camera, evaluation and writing apart."""


@dataclass(frozen=True)
class Task:
    """A row with what is the same for all rows of a batch.

    output:   folder of the batch; overwrite: results in it that are of something else
    device:   where to compute, as torch names it
    pictures: draw plots and write view.html
    """

    row: Row
    output: str
    device: str = "cpu"
    overwrite: bool = False
    pictures: bool = True

    def as_dict(self) -> dict[str, Any]:
        """What JSON can say and `run_row` takes."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Task:
        """The task that `as_dict` gave, also after a way through JSON."""
        row = dict(values["row"])
        return cls(**{**values, "row": Row(**{**row, "overrides": tuple(row["overrides"])})})


def run_row(task: Mapping[str, Any]) -> Columns:
    """Run a sequence, evaluate it and write its results, unless they are there; returns its row of the table.

    task: a `Task` as a dictionary. The same task gives the same bytes, `times.json` apart, in any process and after any
    other task: it runs on one thread and keeps no state. It raises no Exception, see `run_or_reuse`.
    """
    todo = Task.from_dict(task)
    with _one_thread(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # frames that cannot be read are counted, and named in metrics.json
        return run_or_reuse(
            Path(todo.output),
            todo.row.name,
            lambda: {"configuration": configuration(todo), "input": _input(todo)},
            lambda folder: _run(todo, folder),
            todo.overwrite,
        )


def settings_of(row: Row) -> Config:
    """The configuration of a row. Raises ConfigError."""
    return load_config(None if row.config is None else row.path(row.config), row.overrides)


def configuration(task: Task) -> str:
    """A hash of all that decides about the results, the content of the files apart. Raises ConfigError."""
    row = asdict(replace(task.row, config=None, overrides=(), folder=""))
    return hash_json(
        {
            "row": row,
            "settings": to_toml(settings_of(task.row)),
            "device": torch.device(task.device).type,
            "pictures": task.pictures,
            "program": program_hash(),
        }
    )


def _input(task: Task) -> str:
    """A hash of the files that the row reads."""
    row, settings = task.row, settings_of(task.row)
    names = [row.sequence, row.groundtruth, row.mask, row.camera]
    files = hash_files([row.path(name) for name in names if name])
    weights = [settings.features.weights, settings.matching.weights]
    return hash_json({"files": files, "weights": [hash_content(name) for name in weights if name]})


def open_row(row: Row) -> Sequence:
    """The sequence of a row, with the camera and the ground truth that it names.

    Raises SequenceError, CalibrationError or TrajectoryError.
    """
    if live.matches(row.sequence) and not Path(row.path(row.sequence)).exists():
        raise SequenceError(f"{row.sequence}: a live source has no end, and is not the same again")
    camera = row.camera
    if camera is not None and Path(row.path(camera)).is_file():
        camera = row.path(camera)
    sequence = open_sequence(
        row.path(row.sequence),
        camera,
        fps=row.fps,
        limit=row.limit,
        stride=row.stride or 1,
        start=row.start or 0,
        stop=row.stop,
        resize_to=row.resize,
        mask=None if row.mask is None else row.path(row.mask),
    )
    if row.groundtruth is not None:
        sequence = WithTruth(sequence, read_trajectory(row.path(row.groundtruth)))
    return sequence


def _run(task: Task, folder: Path) -> Columns:
    row, device = task.row, torch.device(task.device)
    config, sequence = settings_of(row), open_row(row)
    camera = ""
    start = time.process_time()
    if sequence.calibrated is Calibrated.MISSING:
        sequence = sequence.with_camera(unknown_camera(sequence.size), Calibrated.GUESSED)
    if sequence.calibrated is Calibrated.GUESSED:
        sequence, camera = find_camera(sequence, config, folder, device, RADIAL)
    finished = SLAM(sequence.camera.to(device), config).run(sequence)
    seconds = time.process_time() - start
    if finished.interrupted:
        raise KeyboardInterrupt
    figures = compute_metrics(finished, sequence, camera)
    times = {"cpu_s": seconds} | {name: figures.pop(name) for name in TIMED}
    (folder / TIMES).write_text(json.dumps(times, indent=2) + "\n", encoding="utf-8")
    figures |= {"source": full_name(row.path(row.sequence)), "source_fps": row.fps}
    write_run(_without_times(finished), sequence, figures, folder, plots=task.pictures, viewer=task.pictures)
    return {
        "sequence": row.sequence,
        "status": NO_MAP if finished.failure else DONE,
        "error": finished.failure,
        **_columns(figures),
    }


def _without_times(finished: Run) -> Run:
    return replace(finished, results=[replace(result, stage_ms={}) for result in finished.results])


def _columns(figures: Mapping[str, Any]) -> Columns:
    """The figures of a table: numbers and words."""
    flat = {
        key: value for key, value in figures.items() if value is None or isinstance(value, int | float | str)
    }
    flat |= {f"rpe_{key}": value for key, value in figures.get("rpe", {}).items()}
    return {**flat, "submaps": len(figures["submaps"]), "skipped": len(figures["skipped"])}


@contextmanager
def _one_thread() -> Iterator[None]:
    """Inside, torch computes on one thread: sums of several come in another order."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
