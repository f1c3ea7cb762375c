"""Independent tasks that this process and workers share: each is done once, by whoever is free."""

from __future__ import annotations

import pickle
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Any

from torchslam.parallel.worker import Worker, pack_task, requests, send_result, try_call, unwrap

AHEAD = 2
"""Tasks that a worker is sent at a time, so that it need not wait while this process does one of its own."""


class SharedTasks:
    """Workers that help this process with tasks while this is entered.

    Tasks that a worker did not finish, because it was killed, are done here.

    Args:
        do: (*parts, *task) -> None does a task; a function of a module, since workers import it.
        parts: what all tasks have in common.
        processes: number of processes, this one included.
    """

    def __init__(self, do: Callable[..., None], parts: tuple[Any, ...], processes: int) -> None:
        self._do, self._parts, self._count = do, parts, processes - 1
        self._pending: dict[Worker, deque[tuple[Any, ...]]] = {}
        self._started: set[Worker] = set()  # have the parts

    def __enter__(self) -> SharedTasks:
        self._pending = {Worker(_work): deque() for _ in range(self._count)}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for worker in self._pending:
            worker.end()

    def run(self, tasks: Sequence[tuple[Any, ...]]) -> Iterator[None]:
        """Do all tasks; yields once after each.

        Raises what a task raises, here or in a worker.
        """
        waiting = deque(tasks)
        while waiting or any(self._pending.values()):
            for worker, pending in self._pending.items():
                while pending and (worker.has_result() or not waiting):
                    task = pending.popleft()
                    answer = unwrap(worker.receive())
                    if answer is None:
                        waiting.extendleft((*reversed(pending), task))
                        pending.clear()
                    else:
                        yield
                while waiting and len(pending) < AHEAD and self._send(worker, waiting[0]):
                    pending.append(waiting.popleft())
            if waiting:
                self._do(*self._parts, *waiting.popleft())
                yield

    def _send(self, worker: Worker, task: tuple[Any, ...]) -> bool:
        """Send a task to a worker; return whether it is there."""
        if (
            worker not in self._started
            and worker.is_there()
            and worker.send(pack_task(self._do, self._parts))
        ):
            self._started.add(worker)
        return worker in self._started and worker.send(pickle.dumps(task))


def _work(connection: Connection, do: Callable[..., None], parts: tuple[Any, ...]) -> None:
    """Do one task after the other."""

    def done(*task: Any) -> bool:
        do(*parts, *task)
        return True

    for task in requests(connection):
        send_result(connection, try_call("helps", done, *task))
