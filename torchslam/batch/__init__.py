"""Many sequences: each run once, in whatever process, with one table and the same bytes however many workers there are.

read_list(path) -> rows; run_batch(tasks, output, engine) -> columns; what a worker does is run_row(task) -> columns.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from torchslam.batch.engines import ENGINES, RETRIES, Engine, Shard, parse_shard
from torchslam.batch.result_store import DONE, ERROR, NO_MAP, OPEN, Columns, store_failure
from torchslam.batch.rows import Row, named, read_list
from torchslam.batch.table import write_table
from torchslam.batch.task import Task, configuration, run_row

__all__ = [
    "DONE",
    "ENGINES",
    "ERROR",
    "NO_MAP",
    "OPEN",
    "Columns",
    "Engine",
    "Row",
    "Shard",
    "Task",
    "named",
    "parse_shard",
    "read_list",
    "run_batch",
    "run_row",
    "write_table",
]
LOST = (
    f"the process that ran it died, {RETRIES + 1} times, or could not begin: "
    "too little memory, or no torchslam where it ran"
)


def run_batch(
    tasks: Sequence[Task],
    engine: Engine | None = None,
    shard: Shard | None = None,
    on_progress: Callable[[Columns], None] = lambda columns: None,
) -> list[Columns]:
    """Run those of the tasks that are of the shard and not done yet, and write the table of all of them.

    tasks: with the same `output`; told: the columns of each task of the shard when it is done
    Returns the columns of the shard's tasks in the order of the tasks, `is_new` whether they were run now.
    Raises ConfigError for an engine that is not there, OSError where the table cannot be written.
    """
    engine, shard = engine or Engine(), shard or Shard()
    mine = tasks[shard.index :: shard.count]
    found: dict[int, Columns] = {}
    for number, columns in engine.each(run_row, [task.as_dict() for task in mine]):
        found[number] = _lost(mine[number]) if columns is None else columns
        on_progress(found[number])
    if tasks:
        write_table(tasks, Path(tasks[0].output))
    return [found[number] for number in range(len(mine))]


def _lost(task: Task) -> Columns:
    known = {"name": task.row.name, "configuration": configuration(task)}
    return store_failure(Path(task.output), known, LOST)
