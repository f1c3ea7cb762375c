"""Does the system detect its failures, recover, keep submaps apart, and close the right loops? See README.md."""

from __future__ import annotations

import shutil
from fnmatch import fnmatch
from pathlib import Path

import cv2
import torch

from experiments.common import add_engine, cached_run, check, parser_of, run_cases, table, write_between
from experiments.trials.gradient import report
from experiments.trials.outcome import HEADER, Outcome, cells, perform
from experiments.trials.trials import TRIALS, Trial
from torchslam.batch import DONE, Columns
from torchslam.batch.result_store import RUNS
from torchslam.batch.rows import short_name
from torchslam.errors import SequenceError
from torchslam.system.run import Run

HERE = Path(__file__).parent
README = HERE / "README.md"
GRADIENT = "gradient.md"
NOT_RUN = "not yet run"
LEFT_OUT = "left out"
"""Prefix of the message for a trial whose frames are not available."""


def chosen(patterns: list[str]) -> list[str]:
    """Select the trials that match a pattern, in their own order. Raises SystemExit if a pattern matches none."""
    for pattern in patterns:
        if not any(fnmatch(name, pattern) for name in TRIALS):
            raise SystemExit(f"{pattern}: no such trial; the trials are {', '.join(TRIALS)}")
    return [name for name in TRIALS if any(fnmatch(name, pattern) for pattern in patterns or ["*"])]


def rows_in(text: str) -> dict[str, list[str]]:
    """The rows of a Markdown table by their first cells."""
    lines = [line.strip("| \n") for line in text.splitlines() if line.startswith("| ")]
    rows = [[cell.strip() for cell in line.split(" | ")] for line in lines]
    return {row[0]: row for row in rows if len(row) == len(HEADER)}


def write(rows: dict[str, list[str]]) -> None:
    """Write the table of all trials, including those not run."""
    blank = [NOT_RUN, *[""] * (len(HEADER) - 2)]
    write_between(README, table(HEADER, [rows.get(name, [name, *blank]) for name in TRIALS]))


def attempt(case: Columns) -> Columns:
    """Run a trial unless its result exists; return its row as `cells`. It raises no Exception.

    case: `name` of the trial, `settings` applied after its own, `output` folder of the results
    """
    name, settings = case["name"], case["settings"]
    return cached_run(
        short_name(name),
        name,
        settings,
        lambda folder: _attempt(name, settings, folder),
        case["output"],
        HERE,
    ) | {"trial": name}


def _attempt(name: str, settings: list[str], folder: Path) -> Columns:
    trial = TRIALS[name]
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    try:
        outcome, run = perform(trial, settings)
    except SequenceError as error:
        raise SequenceError(f"{LEFT_OUT}: {error}") from error
    if trial.is_differentiated:
        follow_up(trial, outcome, run, folder / GRADIENT)
    return {"status": DONE, "cells": cells(name, outcome, trial.unit)}


def follow_up(trial: Trial, outcome: Outcome, run: Run, file: Path) -> None:
    """Write the report of the gradient."""
    assert outcome.loop_closures, "no loop was closed"
    file.write_text((HERE / GRADIENT).read_text(encoding="utf-8"), encoding="utf-8")
    report(
        run,
        trial.sequence(),
        file,
        [(closure.frame, closure.matched_frame) for closure in outcome.loop_closures],
    )


def main() -> None:
    parser = parser_of(__doc__, readme=True)
    parser.add_argument("names", nargs="*", help="trials; * and ? stand for any: 'loss/*', '*/shelf_bin'")
    parser.add_argument("--set", action="append", default=[], metavar="section.key=value")
    add_engine(parser, "trials")
    arguments = parser.parse_args()
    output = arguments.output.absolute()

    def on_progress(columns: Columns) -> None:
        if columns["status"] != DONE:
            print(f"{columns['trial']}: {columns['error']}", flush=True)
            return
        print(*columns["cells"], sep=" | ", flush=True)
        if not arguments.no_readme:
            gradient = output / RUNS / columns["name"] / GRADIENT
            if gradient.exists():
                shutil.copyfile(gradient, HERE / GRADIENT)
            write(rows_in(README.read_text(encoding="utf-8")) | {columns["trial"]: columns["cells"]})

    cases = [
        {"name": name, "settings": arguments.set, "output": str(output)} for name in chosen(arguments.names)
    ]
    found = run_cases(attempt, cases, arguments, on_progress)
    check(columns for columns in found if not columns.get("error", "").startswith(LEFT_OUT))


if __name__ == "__main__":
    main()
