"""Run many sequences and write one table: in one process, as shards of a job array, or on Ray.

LIST is a text file with one path per line (`#` for comments), or a CSV file with the column `sequence` and any of
`name`, `camera`, `config`, `overrides` (section.key=value; ...), `groundtruth` (TUM format), `start`, `stop`, `stride`,
`fps`, `limit`, `resize` and `mask`. The options below apply to all rows without a value of their own. File names in
LIST are relative to its folder.

DIR receives: runs/NAME/ with the results of each sequence, as of `torchslam run`, but with the times in times.json;
errors/NAME.json for sequences that failed; table.csv, table.parquet (if pyarrow is installed) and times.csv.
Each sequence runs on one thread. Apart from the times, the results do not depend on the number of processes or on
interruptions. Existing results are reused if the settings, the version, and the names, sizes and modification times of
the input files are the same. Failed sequences are retried by the next call.

Several jobs can share DIR, each with its own `--shard`; the table contains the rows of all. In a job array:
  Slurm       sbatch --array=0-7 --wrap 'torchslam batch LIST -o DIR --shard auto'
  Kubernetes  completionMode: Indexed, args: [batch, LIST, -o, DIR, --shard, $(JOB_COMPLETION_INDEX)/8]
`--shard auto` reads SLURM_ARRAY_TASK_ID, _MIN, _MAX and _COUNT, or JOB_COMPLETION_INDEX and JOB_COMPLETIONS, which you
have to set. Without --shard these variables are ignored.

Exit status: 0 all sequences of this call are done ("no map" is a result), 4 some failed (the table has the errors),
2 the batch could not be run; 130 and 143 ended by Ctrl-C and by SIGTERM (the same command continues).
"""

from __future__ import annotations

import argparse
import itertools
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

from torchslam.batch import DONE, ERROR, Columns, Engine, Task, read_list, run_batch
from torchslam.batch.engines import ENGINES, parse_shard
from torchslam.batch.results_table import CSV, describe_statuses
from torchslam.cli import arguments
from torchslam.cli.progress import SIGNALS, STATUS
from torchslam.utils.console import say

ERRORS = 4
"""Exit status where some rows failed."""
READING = ("camera", "start", "stop", "stride", "fps", "limit", "resize", "mask")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `torchslam batch`."""
    parser.add_argument("list", type=Path, metavar="LIST", help="list of sequences: a text or CSV file")
    arguments.add_output(parser, "all results")
    parser.add_argument(
        "--overwrite",
        action="store_true",
        help="replace results of other settings, files or versions, which are errors otherwise",
    )
    parser.add_argument("--no-plots", action="store_true", help="write no plots and no view.html")
    spread = parser.add_argument_group("distribution")
    spread.add_argument(
        "--shard", metavar="I/N|auto", help="run every N-th row, starting with row I (from 0)"
    )
    spread.add_argument(
        "--engine",
        choices=ENGINES,
        default=ENGINES[0],
        help="ray: Ray Data, requires the extra `ray` (default: %(default)s)",
    )
    spread.add_argument(
        "--address",
        metavar="ADDRESS",
        help="address of a Ray cluster (auto, ray://HOST:10001) whose nodes have torchslam installed and see the files "
        "of LIST and DIR at the same paths; default: a local one for this call",
    )
    spread.add_argument(
        "--workers",
        type=arguments.at_least(1),
        metavar="N",
        help="number of concurrent Ray workers (default: one per processor)",
    )
    arguments.add_reading(parser)
    arguments.add_device(parser)
    arguments.add_config(parser)


def execute(options: argparse.Namespace) -> int:
    """Execute `torchslam batch`; returns the exit status."""
    rows = [row.with_defaults(_defaults(options)) for row in read_list(options.list)]
    arguments.config(options)  # report an invalid configuration once
    output, device = str(options.output.absolute()), options.device
    tasks = [Task(row, output, str(device), options.overwrite, not options.no_plots) for row in rows]
    engine = Engine(options.engine, options.workers, options.address, int(device.type == "cuda"))
    shard, number = parse_shard(options.shard or "0/1"), itertools.count(1)
    count = len(tasks[shard.index :: shard.count])

    def report(columns: Columns) -> None:
        say(f"{next(number)}/{count} {_describe(columns)}")

    with _ended_by_signals():
        found = run_batch(tasks, engine, shard, report)
    new = sum(columns["is_new"] for columns in found)
    print(f"{len(found)} sequences: {describe_statuses(found)}; {len(found) - new} of them already existed")
    print(f"table: {options.output / CSV}")
    return ERRORS if any(columns["status"] == ERROR for columns in found) else 0


def _defaults(options: argparse.Namespace) -> dict[str, Any]:
    """Return the options for all rows; file names are relative to the working directory."""
    said = {name: getattr(options, name) for name in READING}
    said["start"] = None if options.start == 0 else options.start
    said["stride"] = None if options.stride == 1 else options.stride
    said |= {"config": options.config, "overrides": tuple(arguments.overrides(options))}
    for name in ("camera", "mask", "config"):
        if said[name] is not None and Path(said[name]).exists():
            said[name] = str(Path(said[name]).absolute())
    return said


def _describe(columns: Columns) -> str:
    """The outcome of a sequence, for a line on stderr."""
    words = str(columns["status"])
    if columns["status"] == DONE:
        words = f"{columns['posed']} of {columns['frames']} frames posed"
        words += f", ATE {columns['ate_m']:.4f} m" if "ate_m" in columns else ""
    elif columns["error"]:
        words += f": {columns['error']}"
    return f"{columns['name']}: {words}" + ("" if columns["is_new"] else " (already existed)")


@contextmanager
def _ended_by_signals() -> Iterator[None]:
    """Context in which Ctrl-C and SIGTERM exit at once, deleting incomplete results and keeping complete ones."""

    def end(number: int, frame: FrameType | None) -> None:
        say("stopped; run the same command to continue")
        raise SystemExit(STATUS[signal.Signals(number)])

    before = {number: signal.signal(number, end) for number in SIGNALS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
