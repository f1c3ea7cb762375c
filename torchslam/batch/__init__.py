"""Run many sequences with one table of results; the bytes do not depend on the number of workers.

read_list(path) -> rows; run_batch(tasks, engine) -> columns; each worker calls run_row(task) -> columns.
"""

from torchslam.batch.engines import Engine, Shard, run_batch
from torchslam.batch.result_store import DONE, ERROR, NO_MAP, OPEN, Columns
from torchslam.batch.rows import Row, assign_names, read_list
from torchslam.batch.task import Task, run_row

__all__ = [
    "DONE",
    "ERROR",
    "NO_MAP",
    "OPEN",
    "Columns",
    "Engine",
    "Row",
    "Shard",
    "Task",
    "assign_names",
    "read_list",
    "run_batch",
    "run_row",
]
