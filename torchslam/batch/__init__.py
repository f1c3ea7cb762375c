"""Run many sequences with one table of results; the bytes do not depend on the number of workers.

read_list(path) -> rows; run_batch(tasks, engine) -> columns; each worker calls run_row(task) -> columns.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from torchslam.batch.engines import ENGINES, RETRIES, Engine, Shard, parse_shard
from torchslam.batch.result_store import DONE, ERROR, NO_MAP, OPEN, Columns, store_failure
from torchslam.batch.results_table import write_table
from torchslam.batch.rows import Row, assign_names, read_list
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
    "assign_names",
    "parse_shard",
    "read_list",
    "run_batch",
    "run_row",
    "write_table",
]
LOST = (
    f"its process died {RETRIES + 1} times, or could not start: "
    "not enough memory, or torchslam is not installed where it ran"
)


def run_batch(
    tasks: Sequence[Task],
    engine: Engine | None = None,
    shard: Shard | None = None,
    on_progress: Callable[[Columns], None] = lambda columns: None,
) -> list[Columns]:
    """Run the unfinished tasks of a shard, and write the table of all tasks.

    Args:
        tasks: All with the same `output`.
        engine: In this process if None.
        shard: All tasks if None.
        on_progress: Receives the columns of each finished task of the shard.

    Returns:
        The columns of the shard's tasks in the order of the tasks; `is_new` says whether they were run now.

    Raises:
        ConfigError: The engine is not available.
        OSError: The table cannot be written.
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
