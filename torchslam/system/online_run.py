"""Process the frames of a recording, one after the other, and adjust their maps at the end."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from typing import Protocol

import torch

from torchslam.data.sequence import EndOfSequence, Frames, Sequence
from torchslam.errors import FrameError, TorchslamError
from torchslam.geometry import Camera, SharedCamera
from torchslam.geometry.zoom import Zoom
from torchslam.loop_closing.loop_closer import LoopCloser
from torchslam.optim import Progress
from torchslam.parallel.workers import RunningSystem, with_workers
from torchslam.system.final_adjustment import FinalAdjustment
from torchslam.system.front_end import source
from torchslam.system.online_camera import OnlineCamera
from torchslam.system.run import Run, joined_zoom
from torchslam.system.session import Session
from torchslam.types import Frame, Reason, State, StepResult


class _System(RunningSystem, Protocol):
    """The part of `torchslam.system.slam.SLAM` that a run needs."""

    shared_camera: SharedCamera
    online_camera: OnlineCamera
    session: Session
    loop_closer: LoopCloser
    last_frame: tuple[int, float] | None
    zoom: Zoom | None

    def reset(self) -> None:
        """Forget all maps."""

    def step(self, frame: Frame) -> StepResult:
        """Process one frame."""

    def finalize(self) -> None:
        """End the session."""

    def adopt_camera(self, camera: Camera) -> None:
        """Save the maps with a camera that was found."""


@dataclass
class RunProgress:
    """How far a run has come.

    Attributes:
        next: index of the next frame.
        results: one result per processed frame.
        skipped: messages about the frames that could not be read.
    """

    next: int = 0
    results: list[StepResult] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)


class Observer:
    """Sees the progress of a run. A method that raises KeyboardInterrupt ends the run, which keeps what there is.

    Args:
        after_frame: called with the result of each frame.
    """

    def __init__(self, after_frame: Callable[[StepResult], None] | None = None) -> None:
        self._after_frame = after_frame

    def online(self, first: int) -> AbstractContextManager[object]:
        """Entered while frames are processed, from frame `first` on, and while their map is adjusted."""
        return nullcontext()

    def whole(self) -> AbstractContextManager[object]:
        """Entered while the map is checked, and while the recording is mapped as a whole."""
        return nullcontext()

    def frame(self, result: StepResult, is_last: bool) -> None:
        """Called after a frame; `is_last`: no frame follows for now."""
        if self._after_frame is not None:
            self._after_frame(result)

    def adjusting(self, iteration: int, most: int) -> None:
        """Called before an iteration of the final adjustment."""

    def stage(self, stage: str, done: int, most: int) -> None:
        """Called after a part of the check or of global mapping."""


class OnlineRun:
    """A run frame by frame, which may stop where tracking is lost and go on later.

    A frame that cannot be read, or that does not fit the camera or the order of time, is skipped with a warning and
    counted. An interrupt ends the run, or its final adjustment, and keeps what there is.

    Args:
        slam: the system.
        sequence: the frames.
        so_far: progress to go on from; it is updated after every frame.
        processes: number of processes, this one included; None: the best number. The result is the same.
        observer: sees the progress.

    Raises:
        TorchslamError: The system has processed frames that are missing in `so_far`.
    """

    def __init__(
        self,
        slam: _System,
        sequence: Sequence,
        so_far: RunProgress | None = None,
        processes: int | None = 1,
        observer: Observer | None = None,
    ) -> None:
        self.slam, self.processes = slam, processes
        self.sequence = source(sequence.unzoomed(slam.zoom), slam.config, slam.camera)
        self.so_far = RunProgress() if so_far is None else so_far
        self.observer = Observer() if observer is None else observer
        self._finished: Run | None = None
        if slam.last_frame is not None and not self.so_far.next:
            raise TorchslamError(
                "this SLAM has processed frames already: call reset() to begin anew, "
                "or save() its submaps and SLAM.load() them to go on there"
            )

    @property
    def is_finished(self) -> bool:
        """Whether all frames were processed, or the run was ended."""
        return self._finished is not None

    @property
    def begun(self) -> Run:
        """The run of the frames so far, unadjusted."""
        slam, so_far = self.slam, self.so_far
        sensor, maps = slam.shared_camera.model, tuple(slam.session.atlas)
        results, skipped = list(so_far.results), list(so_far.skipped)
        return Run(maps, sensor, slam.config, results, skipped, False, failure="", read_zoom=slam.zoom)

    def anew(self, zoom: Zoom) -> OnlineRun:
        """Return a run of the same frames from the beginning, with a zoom undone in their images."""
        self.slam.reset()
        self.slam.zoom, self.so_far.next = zoom, 0
        self.so_far.results.clear()
        self.so_far.skipped.clear()
        return OnlineRun(self.slam, self.sequence, self.so_far, self.processes, self.observer)

    def run(self, until_lost: bool = False) -> Run:
        """Process the frames that are left; with `until_lost` the run may stop before its end, unadjusted."""
        slam, so_far = self.slam, self.so_far
        with (
            self.observer.online(so_far.next),
            with_workers(self.sequence, slam, self.processes, so_far.next) as frames,
        ):
            try:
                are_all_processed = self._process(frames, until_lost)
            except KeyboardInterrupt:
                return self.end()
            if are_all_processed:
                return self.end(interrupted=False)
        return self.begun

    def _process(self, frames: Frames, until_lost: bool) -> bool:
        """Process the frames that are left, with `until_lost` up to one in which tracking was lost; were these all?"""
        so_far, length = self.so_far, self.sequence.known_length
        is_over = until_lost and any(result.state is State.LOST for result in so_far.results)
        for index in self.sequence.indices(so_far.next):
            if is_over:
                return False
            try:
                result = self.slam.step(frames[index])
            except EndOfSequence:
                break
            except FrameError as error:
                warnings.warn(f"skipped a frame: {error}", stacklevel=4)
                so_far.skipped.append(str(error))
                so_far.next = index + 1
                continue
            so_far.results.append(result)
            so_far.next = index + 1
            is_over = until_lost and (is_over or result.state is State.LOST)
            self.observer.frame(result, is_over or index + 1 == length)
        return True

    def end(self, interrupted: bool = True) -> Run:
        """Adjust the map of the frames so far, once; the others are not processed."""
        if self._finished is None:
            results, skipped = list(self.so_far.results), list(self.so_far.skipped)
            self._finished = finish(self.slam, results, skipped, interrupted, self.observer.adjusting)
        return self._finished


def finish(
    slam: _System,
    results: list[StepResult],
    skipped: list[str],
    interrupted: bool,
    adjusting: Progress | None = None,
) -> Run:
    """Adjust all maps if so configured, and return the run; `adjusting` is called before each iteration."""
    with torch.inference_mode():
        slam.finalize()
    final = FinalAdjustment(slam.shared_camera.model, slam.config, slam.online_camera.given, slam.zoom)
    try:
        if slam.session.mapping:
            final.adjust(slam.session.atlas, slam.session.number, adjusting)
    except KeyboardInterrupt:
        interrupted = True
    slam.adopt_camera(final.sensor.camera)
    return Run(
        tuple(slam.session.atlas),
        final.sensor,
        slam.config,
        results,
        skipped,
        interrupted,
        failure_message(slam, results, skipped),
        tuple(slam.loop_closer.loop_closures),
        slam.session.number,
        slam.session.count,
        final.given,
        final.calibration,
        tuple(slam.online_camera.changes),
        final.shutter,
        zoom=joined_zoom(slam.zoom, final.zoom),
        read_zoom=slam.zoom,
    )


def failure_message(slam: _System, results: list[StepResult], skipped: list[str]) -> str:
    """Message that says why no frame of the session has a pose; empty if some have one."""
    if len(slam.session.atlas) == 0:
        return no_map_message(results, skipped)
    if any(submap.posed_frames.count(slam.session.number) for submap in slam.session.atlas):
        return ""
    return f"none of {len(results)} frames was recognized in the map"


def no_map_message(results: list[StepResult], skipped: list[str]) -> str:
    """Message that says how many frames were tried, and the most frequent reason for which no map was initialized."""
    if not results:
        return (
            f"no frame could be read; {len(skipped)} were skipped, the first because {skipped[0]}"
            if skipped
            else "the sequence has no frames"
        )
    attempts = [
        result.reason
        for result in results
        if result.state is State.INITIALIZING and result.reason != Reason.NEW_REFERENCE
    ]
    if not attempts:
        return f"no map was initialized: {len(results)} frames are too few, two with parallax are needed"
    kind, _ = Counter(reason.split(":")[0] for reason in attempts).most_common(1)[0]
    last = next(reason for reason in reversed(attempts) if reason.split(":")[0] == kind)
    return f"no map was initialized in {len(results)} frames: {last}"
