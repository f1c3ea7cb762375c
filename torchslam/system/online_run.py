"""The frames of a recording, one after the other, and what a caller sees of a run."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext

from torchslam.data.sequence import Sequence
from torchslam.parallel.workers import with_workers
from torchslam.system.run import Run, RunProgress, finish, run_frames
from torchslam.system.slam import SLAM
from torchslam.types import State, StepResult


class Observer:
    """Sees the progress of a run. A method that raises KeyboardInterrupt ends the run, which keeps what there is."""

    def online(self, first: int) -> AbstractContextManager[object]:
        """Entered while frames are processed, from frame `first` on, and while their map is adjusted."""
        return nullcontext()

    def whole(self) -> AbstractContextManager[object]:
        """Entered while the map is checked, and while the recording is mapped as a whole."""
        return nullcontext()

    def frame(self, result: StepResult, is_last: bool) -> None:
        """Called after a frame; `is_last`: no frame follows for now."""

    def adjusting(self, iteration: int, most: int) -> None:
        """Called before an iteration of the final adjustment."""

    def stage(self, stage: str, done: int, most: int) -> None:
        """Called after a part of the check or of global mapping."""


class OnlineRun:
    """A run frame by frame, which may stop where tracking is lost and go on later.

    Args:
        slam: the system.
        sequence: the frames.
        so_far: progress to go on from; it is updated after every frame.
        processes: number of processes; None: the best number.
        observer: sees the progress.
    """

    def __init__(
        self,
        slam: SLAM,
        sequence: Sequence,
        so_far: RunProgress | None = None,
        processes: int | None = None,
        observer: Observer | None = None,
    ) -> None:
        self.slam, self.sequence, self.processes = slam, sequence, processes
        self.so_far = RunProgress() if so_far is None else so_far
        self.observer = Observer() if observer is None else observer
        self._finished: Run | None = None

    @property
    def is_finished(self) -> bool:
        """Whether all frames were processed, or the run was ended."""
        return self._finished is not None

    def run(self, until_lost: bool = False) -> Run:
        """Process the frames that are left; with `until_lost` the run may stop before its end, unadjusted."""
        slam, so_far, interrupted = self.slam, self.so_far, False

        def after_frame(result: StepResult) -> None:
            is_lost = until_lost and result.state is State.LOST
            self.observer.frame(result, is_lost or result.index + 1 == self.sequence.known_length)

        with (
            self.observer.online(so_far.next),
            with_workers(self.sequence, slam, self.processes, so_far.next) as frames,
        ):
            try:
                if not run_frames(slam, self.sequence, so_far, after_frame, frames, until_lost):
                    return Run(
                        tuple(slam.atlas),
                        slam.shared_camera.model,
                        slam.config,
                        so_far.results,
                        so_far.skipped,
                        False,
                        failure="",
                    )
            except KeyboardInterrupt:
                interrupted = True
            return self.end(interrupted)

    def end(self, interrupted: bool = True) -> Run:
        """Adjust the map of the frames so far, once; the others are not processed."""
        if self._finished is None:
            results, skipped = self.so_far.results, self.so_far.skipped
            self._finished = finish(self.slam, results, skipped, interrupted, self.observer.adjusting)
        return self._finished
