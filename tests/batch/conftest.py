"""A list of short sequences with simulated features, and what a batch of them wrote."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import pytest

from torchslam.batch import Row, Task
from torchslam.batch.results_table import TIMES_CSV
from torchslam.batch.task import TIMES
from torchslam.cli.main import main

SETTINGS = (
    *("features.kind=simulated", "features.num_keypoints=120", "simulated.points_per_view=120"),
    "simulated.noise_px=0.5",  # else the search for a better camera goes on for long
    *("camera.readout_std=0", "initialization.min_matches=40"),
)
OPTIONS = ["--no-plots", *(part for setting in SETTINGS for part in ("--set", setting))]
ROOM = "synthetic:room?frames=10&blank=1"
LIST = f"""sequence,name,overrides
{ROOM},one,
{ROOM},two,seed=2
missing/folder,three,
{ROOM},four,features.num_keypoints=0
synthetic:standstill?frames=3&blank=1,five,
"""
STATUSES = ["done", "done", "error", "error", "no map"]


@pytest.fixture(scope="session")
def listed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A list with all that may come of a row."""
    path = tmp_path_factory.mktemp("list") / "list.csv"
    path.write_text(LIST)
    return path


@pytest.fixture(scope="session")
def whole(listed: Path) -> Path:
    """The folder of that batch, run in one go by this process."""
    output = listed.parent / "whole"
    assert batch(listed, output) == 4
    return output


def batch(listed: Path, output: Path, more: Sequence[str] = ()) -> int:
    return main(["batch", str(listed), "--output", str(output), *OPTIONS, *more])


def content(output: Path) -> dict[str, bytes]:
    """The files of a batch by their names, those with times apart."""
    files = (path for path in sorted(output.rglob("*")) if path.is_file())
    return {
        str(path.relative_to(output)): path.read_bytes()
        for path in files
        if path.name not in (TIMES, TIMES_CSV)
    }


def table(output: Path) -> list[dict[str, str]]:
    with (output / "table.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def task(output: Path, sequence: str = ROOM, **more: object) -> Task:
    row = Row("mine", sequence, overrides=SETTINGS, **more)  # type: ignore[arg-type]
    return Task(row, str(output), plots=False)
