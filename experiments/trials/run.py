"""Does the system know when it is wrong, come back, keep worlds apart, and close the right loops? See README.md."""

from __future__ import annotations

import argparse
from fnmatch import fnmatch
from pathlib import Path

import cv2
import torch

from experiments.common import table, write_between
from experiments.trials.gradient import report
from experiments.trials.outcome import HEADER, Outcome, cells, perform
from experiments.trials.trials import TRIALS, Trial
from torchslam.errors import SequenceError
from torchslam.run import Run

HERE = Path(__file__).parent
README = HERE / "README.md"
NOT_RUN = "not yet run"


def chosen(patterns: list[str]) -> list[str]:
    """The trials that one of the patterns names, in their own order. Raises SystemExit for one that names none."""
    for pattern in patterns:
        if not any(fnmatch(name, pattern) for name in TRIALS):
            raise SystemExit(f"{pattern}: there is no such trial; there are {', '.join(TRIALS)}")
    return [name for name in TRIALS if any(fnmatch(name, pattern) for pattern in patterns or ["*"])]


def rows_in(text: str) -> dict[str, list[str]]:
    """The rows of a Markdown table by their first cells."""
    lines = [line.strip("| \n") for line in text.splitlines() if line.startswith("| ")]
    rows = [[cell.strip() for cell in line.split(" | ")] for line in lines]
    return {row[0]: row for row in rows if len(row) == len(HEADER)}


def write(rows: dict[str, list[str]]) -> None:
    """The table of all trials; those that were not run stand there too."""
    blank = [NOT_RUN, *[""] * (len(HEADER) - 2)]
    write_between(README, table(HEADER, [rows.get(name, [name, *blank]) for name in TRIALS]))


def follow_up(trial: Trial, outcome: Outcome, run: Run) -> None:
    """What is looked at beyond the row of the table."""
    if trial.is_differentiated:
        assert outcome.recalls, "no loop was closed"
        report(run, trial.sequence(), HERE / "gradient.md", [(r.frame, r.place) for r in outcome.recalls])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="trials; * and ? stand for any: 'loss/*', '*/shelf_bin'")
    parser.add_argument("--set", action="append", default=[], metavar="section.key=value")
    parser.add_argument("--no-readme", action="store_true", help="print only")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    for name in chosen(arguments.names):
        trial = TRIALS[name]
        try:
            outcome, run = perform(trial, arguments.set)
        except SequenceError as error:
            print(f"{name}: left out: {error}")
            continue
        row = cells(name, outcome, trial.unit)
        print(*row, sep=" | ", flush=True)
        if not arguments.no_readme:
            follow_up(trial, outcome, run)
            write(rows_in(README.read_text(encoding="utf-8")) | {name: row})


if __name__ == "__main__":
    main()
