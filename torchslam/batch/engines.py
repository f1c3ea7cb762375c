"""Run a batch: distribute its rows over this process, the workers of Ray Data, or the jobs of an array (`--shard`)."""

from __future__ import annotations

import importlib
import json
import logging
import os
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from torchslam.batch.result_store import Columns, store_failure
from torchslam.batch.results_table import write_table
from torchslam.batch.task import Task, configuration, run_row
from torchslam.data.text_file import parse_count
from torchslam.errors import ConfigError

Work = Callable[[Columns], Columns]
ENGINES = ("in-process", "ray")
RETRIES = 2  # of a row whose worker died, for example for lack of memory; Ray would retry forever


@dataclass(frozen=True)
class Engine:
    """Where tasks run.

    Attributes:
        kind: One of `ENGINES`.
        workers: With Ray: maximum number at a time; None: the number of processors.
        address: With Ray: of a cluster (`auto`, `ray://HOST:10001`), whose nodes have this package and the files at the
            same paths; None: a temporary cluster of this machine.
        gpus: Needed by each worker.

    Raises:
        ConfigError: Unknown kind, or options of Ray without it.
    """

    kind: str = ENGINES[0]
    workers: int | None = None
    address: str | None = None
    gpus: int = 0

    def __post_init__(self) -> None:
        if self.kind not in ENGINES:
            raise ConfigError(f"--engine must be one of {', '.join(ENGINES)}, not {self.kind}")
        if self.kind != "ray" and (self.workers not in (None, 1) or self.address is not None):
            raise ConfigError("--workers and --address need --engine ray")

    def map_unordered(self, work: Work, rows: Iterable[Columns]) -> Iterator[tuple[int, Columns | None]]:
        """Yield the index of each row with its result as they finish; None if the process died or could not start.

        The work is a function of a module; rows and results must be JSON values. Raises ConfigError if Ray is not
        installed, or not found at the address.
        """
        # As text: Arrow would infer different types for blocks whose columns are None.
        items: list[Columns] = [{"number": n, "row": json.dumps(row)} for n, row in enumerate(rows)]
        if self.kind == "ray":
            yield from _map_with_ray(work, items, self.workers, self.address, self.gpus)
            return
        for item in items:
            yield item["number"], work(json.loads(item["row"]))


def _map_with_ray(
    work: Work, items: list[Columns], workers: int | None, address: str | None, gpus: int
) -> Iterator[tuple[int, Columns | None]]:
    """Run `Engine.map_unordered` as Ray tasks of one row and one processor each."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # otherwise it reports each cluster to its makers
    try:
        ray, data = importlib.import_module("ray"), importlib.import_module("ray.data")
    except ImportError as error:
        raise ConfigError(f"--engine ray needs pip install 'torchslam[ray]': {error}") from None
    _start(ray, workers, address)
    try:
        context = data.DataContext.get_current()
        context.enable_progress_bars, context.max_errored_blocks = False, -1
        left = set(range(len(items)))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # max_retries is deprecated in Ray 2.64, without a replacement
            done = data.from_items(items, override_num_blocks=len(items)).map(
                partial(_done, work),
                num_cpus=1,
                num_gpus=gpus or None,
                max_retries=RETRIES,
                compute=data.TaskPoolStrategy(size=workers),
            )
        for item in done.iter_rows():
            left.discard(item["number"])
            yield item["number"], json.loads(item["row"])
        for number in sorted(left):
            yield number, None
    finally:
        ray.shutdown()


def _done(work: Work, item: Columns) -> Columns:
    return {"number": item["number"], "row": json.dumps(work(json.loads(item["row"])))}


def _start(ray: Any, workers: int | None, address: str | None) -> None:
    logging.getLogger("ray.data").setLevel(logging.ERROR)  # reports why a worker died or did not start
    options: Columns = {"log_to_driver": False, "logging_level": logging.ERROR, "address": address or "local"}
    if address is None:
        # A small store of objects: images do not pass through it.
        options |= {"num_cpus": workers, "include_dashboard": False, "object_store_memory": 100 << 20}
    try:
        ray.init(**options)
    except Exception as error:  # Ray raises various types
        line = " ".join(str(error).split())[:500]
        where = f"no Ray cluster at {address}" if address else "the Ray cluster of this machine did not start"
        raise ConfigError(f"--engine ray: {where}: {type(error).__name__}: {line}") from error


@dataclass(frozen=True)
class Shard:
    """Part `index`, from 0, of `count`: every `count`-th row from row `index` on. Raises ConfigError out of range."""

    index: int = 0
    count: int = 1

    def __post_init__(self) -> None:
        count = self.count
        if not 0 <= self.index < count:
            raise ConfigError(
                f"--shard {self.index}/{count}: shards count from 0/{count} to {count - 1}/{count}"
            )


def parse_shard(text: str, environment: Mapping[str, str] = os.environ) -> Shard:
    """Parse `i/n` with i from 0 to n - 1, or `auto`, the index of a Slurm array or a Kubernetes indexed job.

    Raises ConfigError for anything else, or if the environment lacks the index.
    """
    if text == "auto":
        return _of_system(environment)
    index, count = map(parse_count, text.partition("/")[::2])
    if index is None or not count:
        raise ConfigError(f"--shard {text[:100]}: expected i/n, the first of three is 0/3; or auto")
    return Shard(index, count)


def _of_system(environment: Mapping[str, str]) -> Shard:
    """Return the shard of SLURM_ARRAY_TASK_ID in its array, or of JOB_COMPLETION_INDEX in JOB_COMPLETIONS."""

    def number(name: str) -> int:
        found = parse_count(environment.get(name, ""))
        if found is None:
            raise ConfigError(f"--shard auto: {name} is not set to a number")
        return found

    if "SLURM_ARRAY_TASK_ID" in environment:
        first, last = number("SLURM_ARRAY_TASK_MIN"), number("SLURM_ARRAY_TASK_MAX")
        count, mine = number("SLURM_ARRAY_TASK_COUNT"), number("SLURM_ARRAY_TASK_ID")
        step = 1 if count == 1 else (last - first) // (count - 1)
        if first + step * (count - 1) != last or not step or (mine - first) % step:
            raise ConfigError(f"--shard auto: the {count} tasks from {first} to {last} are not evenly spaced")
        return Shard((mine - first) // step, count)
    if "JOB_COMPLETION_INDEX" in environment:
        # Kubernetes does not set the number of completions itself.
        return Shard(number("JOB_COMPLETION_INDEX"), number("JOB_COMPLETIONS"))
    raise ConfigError(
        "--shard auto: neither SLURM_ARRAY_TASK_ID nor JOB_COMPLETION_INDEX is set: not a job of an array"
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
        engine: Where they run; in this process if None.
        shard: Which of them run here; all if None.
        on_progress: Receives the columns of each finished task of the shard.

    Returns:
        The columns of the shard's tasks in the order of the tasks; `is_new`: whether they were run now.

    Raises ConfigError if the engine is not available.
    """
    engine, shard = engine or Engine(), shard or Shard()
    mine = tasks[shard.index :: shard.count]
    found: dict[int, Columns] = {}
    for number, columns in engine.map_unordered(run_row, [task.as_dict() for task in mine]):
        if columns is None:
            known = {"name": mine[number].row.name, "configuration": configuration(mine[number])}
            why = (
                f"its process died {RETRIES + 1} times, or could not start: not enough memory, or torchslam is not "
                "installed where it ran"
            )
            columns = store_failure(Path(mine[number].output), known, why)
        found[number] = columns
        on_progress(columns)
    if tasks:
        write_table(tasks, Path(tasks[0].output))
    return [found[number] for number in range(len(mine))]
