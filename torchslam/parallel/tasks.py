"""Independent tasks that this process and workers share: each is done once, by whoever is free."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from functools import partial
from typing import Any

from torchslam.parallel.pool import WorkerLostError, WorkerPool

AHEAD = 2
"""Tasks that each worker is sent at a time, so that it need not wait while this process does one of its own."""


class SharedTasks(WorkerPool):
    """Workers that help this process with tasks while this is entered.

    Tasks that a worker did not finish, because it was killed, are done here.

    Args:
        do: (*parts, *task) -> None does a task; a function of a module, since workers import it.
        parts: what all tasks have in common.
        processes: number of processes, this one included.
    """

    def __init__(self, do: Callable[..., None], parts: tuple[Any, ...], processes: int) -> None:
        super().__init__(processes - 1, partial, do, *parts)
        self._do = partial(do, *parts)

    def run(self, tasks: Sequence[tuple[Any, ...]]) -> Iterator[None]:
        """Do all tasks; yields once after each.

        Raises what a task raises, here or in a worker.
        """
        waiting = deque(tasks)
        calls: dict[Future[bytes], tuple[Any, ...]] = {}
        while waiting or calls:
            while waiting and len(calls) < AHEAD * self.count:
                call = self.submit(*waiting[0])
                if call is None:
                    break
                calls[call] = waiting.popleft()
            if waiting:
                self._do(*waiting.popleft())
                yield
            else:
                wait(calls, return_when=FIRST_COMPLETED)
            for call in [each for each in calls if each.done()]:
                task = calls.pop(call)
                try:
                    self.result(call)
                except WorkerLostError:
                    waiting.append(task)
                else:
                    yield
