"""The part of a batch that one of several jobs does: `--shard i/n`, or what the system that started the jobs says."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass

from torchslam.data.formats.text_file import parse_count
from torchslam.errors import ConfigError

AUTO = "auto"


@dataclass(frozen=True)
class Shard:
    """Part `index`, from 0, of `count`: every `count`-th row from row `index` on."""

    index: int = 0
    count: int = 1

    def __post_init__(self) -> None:
        if not 0 <= self.index < self.count:
            last = f"{self.count - 1}/{self.count}"
            raise ConfigError(
                f"--shard {self.index}/{self.count}: shards count from 0/{self.count} to {last}"
            )


def parse_shard(text: str, environment: Mapping[str, str] = os.environ) -> Shard:
    """`i/n` with i from 0 to n - 1; `auto`: of a Slurm array or a Kubernetes indexed job.

    Raises ConfigError for anything else, and where the environment does not say it.
    """
    if text == AUTO:
        return _of_system(environment)
    index, _, count = text.partition("/")
    numbers = parse_count(index), parse_count(count)
    if numbers[0] is None or not numbers[1]:
        raise ConfigError(f"--shard {text[:100]}: write it as i/n, the first of three is 0/3; or auto")
    return Shard(numbers[0], numbers[1])


def _of_system(environment: Mapping[str, str]) -> Shard:
    """SLURM_ARRAY_TASK_ID, whatever numbers the array has; or JOB_COMPLETION_INDEX, of JOB_COMPLETIONS."""

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
        # Kubernetes does not tell a container how many there are.
        return Shard(number("JOB_COMPLETION_INDEX"), number("JOB_COMPLETIONS"))
    raise ConfigError(
        "--shard auto: neither SLURM_ARRAY_TASK_ID nor JOB_COMPLETION_INDEX is set: this is no job of an array"
    )
