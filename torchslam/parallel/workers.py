"""The workers of a run; its result does not depend on their number.

Prefetch workers read frames and extract features ahead of their turn (`prefetch`); the bundle worker solves local
bundle adjustments while the next frames are tracked (`bundle_worker`).
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING

from torchslam.data.sequence import Sequence
from torchslam.parallel.bundle_worker import BundleWorker
from torchslam.parallel.prefetch import FeaturePrefetcher, LivePrefetcher
from torchslam.parallel.worker import starts_at_once
from torchslam.system.run import Frames

if TYPE_CHECKING:
    from torchslam.system.slam import SLAM

WORTH, WORTH_AT_ONCE = 100, 10
"""Frames of a run for which other processes are worth their start: one that has to import everything costs as much as
some 40 frames; a copy of this process starts at once."""


def processors() -> int:
    """Number of processors that this process may use."""
    known = getattr(os, "sched_getaffinity", None)  # not on every system
    return os.cpu_count() or 1 if known is None else len(known(0))


def best_number(sequence: Sequence, start: int) -> int:
    """Best number of processes for a sequence from frame `start` on."""
    length = sequence.known_length
    frames = WORTH if length is None else length - start
    if processors() == 1 or frames < (WORTH_AT_ONCE if starts_at_once() else WORTH):
        return 1
    return 3


@contextmanager
def with_workers(sequence: Sequence, slam: SLAM, processes: int | None, start: int = 0) -> Iterator[Frames]:
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
            print(f"torchslam: one process: the {slam.camera.params.device} does it all", file=sys.stderr)
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
    sequence: Sequence, slam: SLAM, processes: int, is_asked_for: bool
) -> FeaturePrefetcher | LivePrefetcher | None:
    """The prefetcher of a sequence; None if frames cannot or should not be prefetched."""
    alone = why_alone(sequence, slam)
    if processes == 1 or alone:
        if processes > 1 and is_asked_for:
            print(f"torchslam: frames are read here: {alone}", file=sys.stderr)
        return None
    if not len(sequence.timestamps):
        return LivePrefetcher(sequence, slam.camera, slam.config, slam.clock)
    return FeaturePrefetcher(sequence, slam.camera, slam.config, slam.clock, max(1, processes - 2))


def why_alone(sequence: Sequence, slam: SLAM) -> str:
    """Why the frames of a sequence cannot be prefetched; empty if they can."""
    if sequence.brings_features or slam.config.features.kind == "simulated":
        return "simulated features need no images"
    if slam.has_custom_components:
        return "a front end or matcher of your own is here alone"
    if slam.config.matching.matcher != "descriptors":
        return "the matcher may want images"
    return ""
