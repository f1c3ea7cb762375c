"""The workers of a run; its result does not depend on their number.

Prefetch workers read frames and extract features ahead of their turn (`prefetch`); the bundle worker solves local
bundle adjustments while the next frames are tracked. `mapping.local_bundle` selects their windows and applies the
results.
"""

from __future__ import annotations

import operator
import os
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from torchslam.config import Config
from torchslam.data.sequence import Frames, Sequence
from torchslam.geometry import Camera
from torchslam.mapping.local_bundle import Solver
from torchslam.mapping.mapper import Mapper
from torchslam.parallel.pool import WorkerPool, can_fork
from torchslam.parallel.prefetch import NICENESS, Extractor, FeaturePrefetcher, LivePrefetcher
from torchslam.utils.console import say
from torchslam.utils.forks import close_decoders
from torchslam.utils.timing import Stopwatch

WORTH, WORTH_FORKED = 100, 20
"""Frames of a run for which other processes are worth their start, as new interpreters and as forks. The imports of two
new interpreters cost 5 s of processor time, as much as 40 frames of kitti07; two forks cost 0.02 s. With forks, runs of
20, 50 and 160 frames took no more processor time than with one process; shorter ones were not tried.
"""
LEAST_FREE = 2
"""Processors that must be free for three processes, which wait for each other: where one waits for its turn, all do."""
LOAD = Path("/proc/loadavg")  # on Linux
SAMPLES, SAMPLING_S = 5, 0.01
"""Looks at the load, and seconds between them: a median does not count what wakes up for a moment."""


class _Estimator(Protocol):
    def solved_by(self, solver: Solver) -> AbstractContextManager[None]: ...


class RunningSystem(Protocol):
    """The part of `torchslam.system.slam.SLAM` that workers need."""

    camera: Camera
    config: Config
    clock: Stopwatch
    mapper: Mapper
    has_custom_components: bool
    make_extractor: Callable[[], Extractor]

    @property
    def online_camera(self) -> _Estimator: ...

    @property
    def mapping(self) -> bool: ...

    def warm_up(self) -> None: ...

    def precompute_undistortion(self) -> None: ...


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
    if frames < (WORTH_FORKED if can_fork() else WORTH):
        return 1
    return 3 if processors() - busy_elsewhere() >= LEAST_FREE else 1


@contextmanager
def with_workers(
    sequence: Sequence, slam: RunningSystem, processes: int | None, start: int = 0
) -> Iterator[Frames]:
    """The frames of a sequence from `start` on, for a run that uses workers while this is entered.

    Args:
        processes: number of processes, this one included; None: chosen automatically. With 2 there is a
            prefetch worker, or a bundle worker if frames cannot be prefetched; with more there is one bundle
            worker, the others prefetch, and one more process, which is mostly idle, estimates the sensor
    """
    if processes != 1:
        close_decoders()  # so that workers may be forks
    wanted = best_number(sequence, start) if processes is None else processes
    slam.warm_up()
    if slam.camera.params.device.type != "cpu":
        if processes is not None and processes > 1:
            say(f"one process is used, since the camera is on {slam.camera.params.device}")
        wanted = 1
    with ExitStack() as others:
        ahead = reader(sequence, slam, wanted, is_asked_for=processes is not None)
        if ahead is not None:
            others.enter_context(ahead)
        frames: Frames = sequence if ahead is None else ahead
        if slam.mapping and wanted > (1 if ahead is None else 2):
            # One for each: a local adjustment, which is due in two frames, would wait for an estimate of the sensor.
            adjusting, estimating = map(others.enter_context, (SolverWorker(), SolverWorker(NICENESS)))
            others.enter_context(slam.mapper.adjustment.solved_by(adjusting))
            others.enter_context(slam.online_camera.solved_by(estimating))
        slam.precompute_undistortion()  # while the workers start
        yield frames


def reader(
    sequence: Sequence, slam: RunningSystem, processes: int, is_asked_for: bool
) -> FeaturePrefetcher | LivePrefetcher | None:
    """The prefetcher of a sequence; None if frames cannot or should not be prefetched."""
    obstacle = prefetch_obstacle(sequence, slam)
    if processes == 1 or obstacle:
        if processes > 1 and is_asked_for:
            say(f"frames are read in the main process: {obstacle}")
        return None
    if sequence.is_live:
        return LivePrefetcher(sequence, slam.make_extractor, slam.clock)
    return FeaturePrefetcher(sequence, slam.make_extractor, slam.clock, max(1, processes - 2))


def prefetch_obstacle(sequence: Sequence, slam: RunningSystem) -> str:
    """The reason why the frames of a sequence cannot be prefetched; empty if they can."""
    if sequence.brings_features or slam.config.features.kind == "simulated":
        return "simulated features need no images"
    if slam.has_custom_components:
        return "a custom feature extractor or matcher is known only there"
    if slam.config.matching.matcher != "descriptors":
        return "the matcher may need images"
    return ""


class SolverWorker(WorkerPool):
    """A `mapping.local_bundle.Solver` that uses a worker, which runs while this is entered.

    Functions are called in this process until the worker has started, and after it was killed.
    """

    def __init__(self, niceness: int = 0) -> None:
        super().__init__(1, partial, operator.call, niceness=niceness)

    def __call__(self, function: Callable[..., Any], *arguments: Any) -> Callable[[], Any]:
        call = self.submit(function, *arguments)
        return partial(self.result_or, call, partial(function, *arguments))
