"""The workers of a run; its result does not depend on their number.

Prefetch workers read frames and extract features ahead of their turn (`prefetch`); the bundle worker solves local
bundle adjustments while the next frames are tracked. `mapping.local_bundle` selects their windows and applies the
results.
"""

from __future__ import annotations

import os
import pickle
import statistics
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch

from torchslam.config import Config
from torchslam.data.sequence import Sequence
from torchslam.geometry import Camera
from torchslam.mapping.local_bundle import BundleResult, PendingResult, solve_local
from torchslam.mapping.mapper import Mapper
from torchslam.optim import BundleProblem, Marginals
from torchslam.parallel.prefetch import FeaturePrefetcher, LivePrefetcher
from torchslam.parallel.worker import (
    WithWorker,
    pack_task,
    requests,
    send_result,
    starts_at_once,
    try_call,
    unwrap,
)
from torchslam.system.run import Frames
from torchslam.utils.timing import Stopwatch

WORTH, WORTH_AT_ONCE = 100, 10
"""Frames of a run for which other processes are worth their start: one that has to import everything costs as much as
some 40 frames; a copy of this process starts at once."""
LEAST_FREE = 2
"""Processors that must be free for three processes, which wait for each other: where one waits for its turn, all do."""
LOAD = Path("/proc/loadavg")  # on Linux
SAMPLES, SAMPLING_S = 5, 0.01
"""Looks at the load, and seconds between them: a median does not count what wakes up for a moment."""
SENT = ("T_cw", "points_w", "frame_index", "point_index", "pixels", "weights", "fixed_frames")
"""The fields of a problem that differ between problems of one run."""


class _System(Protocol):
    """The part of `torchslam.system.slam.SLAM` that workers need."""

    camera: Camera
    config: Config
    clock: Stopwatch
    mapper: Mapper
    has_custom_components: bool

    @property
    def mapping(self) -> bool:
        """True if the run changes the map, False if frames are only localized."""

    def warm_up(self) -> None:
        """Initialize ORB and PyTorch."""

    def precompute_undistortion(self) -> None:
        """Compute the undistortion table of the camera."""


def processors() -> int:
    """Number of processors that this process may use."""
    known = getattr(os, "sched_getaffinity", None)  # not on every system
    return os.cpu_count() or 1 if known is None else len(known(0))


def busy_elsewhere() -> int:
    """Number of other threads on this machine that compute now, as the median of some samples; 0 if it is unknown."""
    samples = []
    for _ in range(SAMPLES):
        try:
            running = LOAD.read_text().split()[3].partition("/")[0]
        except OSError:  # not on every system
            return 0
        samples.append(int(running) - 1)  # without this one
        time.sleep(SAMPLING_S)
    return max(0, int(statistics.median(samples)))


def best_number(sequence: Sequence, start: int) -> int:
    """Best number of processes for a sequence from frame `start` on, beside what else the machine does now."""
    length = sequence.known_length
    frames = WORTH if length is None else length - start
    if processors() - busy_elsewhere() < LEAST_FREE or frames < (
        WORTH_AT_ONCE if starts_at_once() else WORTH
    ):
        return 1
    return 3


@contextmanager
def with_workers(
    sequence: Sequence, slam: _System, processes: int | None, start: int = 0
) -> Iterator[Frames]:
    """The frames of a sequence from `start` on, for a run that uses workers while this is entered.

    Args:
        processes: number of processes, this one included; None: chosen automatically. With 2 there is a
            prefetch worker, or a bundle worker if frames cannot be prefetched; with more there is one bundle
            worker, and the others prefetch
    """
    wanted = best_number(sequence, start) if processes is None else processes
    slam.warm_up()
    if slam.camera.params.device.type != "cpu":
        if processes is not None and processes > 1:
            print(
                f"torchslam: one process is used, since the camera is on {slam.camera.params.device}",
                file=sys.stderr,
            )
        wanted = 1
    with ExitStack() as others:
        frames: Frames = sequence
        ahead = reader(sequence, slam, wanted, is_asked_for=processes is not None)
        if ahead is not None:
            others.enter_context(ahead)
            frames = ahead
        if slam.mapping and wanted > (1 if ahead is None else 2):
            worker = others.enter_context(BundleWorker(slam.camera))
            others.enter_context(slam.mapper.adjustment.solved_by(worker))
        if isinstance(ahead, FeaturePrefetcher):
            ahead.begin(start)
        slam.precompute_undistortion()  # while the workers read
        yield frames


def reader(
    sequence: Sequence, slam: _System, processes: int, is_asked_for: bool
) -> FeaturePrefetcher | LivePrefetcher | None:
    """The prefetcher of a sequence; None if frames cannot or should not be prefetched."""
    obstacle = prefetch_obstacle(sequence, slam)
    if processes == 1 or obstacle:
        if processes > 1 and is_asked_for:
            print(f"torchslam: frames are read in the main process: {obstacle}", file=sys.stderr)
        return None
    if sequence.is_live:
        return LivePrefetcher(sequence, slam.camera, slam.config, slam.clock)
    return FeaturePrefetcher(sequence, slam.camera, slam.config, slam.clock, max(1, processes - 2))


def prefetch_obstacle(sequence: Sequence, slam: _System) -> str:
    """Message that says why the frames of a sequence cannot be prefetched; empty if they can."""
    if sequence.brings_features or slam.config.features.kind == "simulated":
        return "simulated features need no images"
    if slam.has_custom_components:
        return "a custom front end or matcher is known only there"
    if slam.config.matching.matcher != "descriptors":
        return "the matcher may need images"
    return ""


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
    """Unpack the result of `_arrays`."""
    T_cw, points_w, *covariances = (torch.from_numpy(each) for each in arrays)
    return BundleResult(T_cw, points_w, Marginals(*covariances) if covariances else None)


def _arrays(adjusted: BundleResult) -> list[np.ndarray]:
    """Pack a result as arrays, since tensors are slow to pickle."""
    return [each.numpy() for each in (adjusted.T_cw, adjusted.points_w, *(adjusted.marginals or ()))]


def _work(connection: Connection, camera: Camera) -> None:
    """Solve one numbered problem after the other."""

    def solve(arrays: dict[str, np.ndarray], iterations: int, covariances: bool) -> list[np.ndarray]:
        columns: dict[str, Any] = {name: torch.from_numpy(each) for name, each in arrays.items()}
        return _arrays(solve_local(BundleProblem(camera=camera, **columns), iterations, covariances))

    for number, *problem in requests(connection):
        send_result(connection, (number, try_call("adjusts", solve, *problem)))
