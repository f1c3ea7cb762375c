"""Local bundle adjustment in a worker process, while this one tracks the next frames; the result is the same.

`mapping.local_bundle` selects the window and applies the result; this process only solves it.
"""

from __future__ import annotations

import pickle
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import torch

from torchslam.geometry import Camera
from torchslam.mapping.local_bundle import BundleResult, PendingResult, solve_local
from torchslam.optim import BundleProblem, Marginals
from torchslam.parallel.worker import WithWorker, pack_task, requests, send_result, try_call, unwrap

SENT = ("T_cw", "points_w", "frame_index", "point_index", "pixels", "weights", "fixed_frames")
"""The fields of a problem that differ between problems of one run."""


class BundleWorker(WithWorker):
    """A `mapping.local_bundle.Solver` that uses a worker, which runs while this is entered.

    Problems are solved in this process until the worker has started, and after it was killed.
    """

    def __init__(self, camera: Camera) -> None:
        super().__init__(_work)
        self._camera = camera
        self._has_task = False
        self._number = 0  # of the last problem that was sent

    def __call__(self, problem: BundleProblem, iterations: int, covariances: bool) -> PendingResult:
        number = self._send(problem, iterations, covariances)

        def answer() -> BundleResult:
            found = None if number is None else self._receive(number)
            return solve_local(problem, iterations, covariances) if found is None else found

        return answer

    def _send(self, problem: BundleProblem, iterations: int, covariances: bool) -> int | None:
        """Send a problem; return its number, or None without a worker."""
        if not self._worker.is_there():
            return None
        if not self._has_task:
            self._has_task = self._worker.send(pack_task(self._camera))
        self._number += 1
        arrays = {name: getattr(problem, name).numpy() for name in SENT}
        message = pickle.dumps((self._number, arrays, iterations, covariances))
        return self._number if self._worker.send(message) else None

    def _receive(self, number: int) -> BundleResult | None:
        """Wait for the result of a problem, and skip those of dropped ones; None without a worker."""
        while (answer := self._worker.receive()) is not None:
            answered, found = answer
            if answered == number:
                return _adjusted(unwrap(found))
        return None


def _adjusted(arrays: list[np.ndarray]) -> BundleResult:
    """What `_arrays` packed."""
    T_cw, points_w, *covariances = (torch.from_numpy(each) for each in arrays)
    return BundleResult(T_cw, points_w, Marginals(*covariances) if covariances else None)


def _arrays(adjusted: BundleResult) -> list[np.ndarray]:
    """For the way between processes: tensors are slow to pickle."""
    return [each.numpy() for each in (adjusted.T_cw, adjusted.points_w, *(adjusted.marginals or ()))]


def _work(connection: Connection, camera: Camera) -> None:
    """Solve one numbered problem after the other."""

    def solve(arrays: dict[str, np.ndarray], iterations: int, covariances: bool) -> list[np.ndarray]:
        columns: dict[str, Any] = {name: torch.from_numpy(each) for name, each in arrays.items()}
        return _arrays(solve_local(BundleProblem(camera=camera, **columns), iterations, covariances))

    for number, *problem in requests(connection):
        send_result(connection, (number, try_call("adjusts", solve, *problem)))
