"""Progress bars of a run, and its interruption by Ctrl-C and SIGTERM.

The first signal ends the run after the current frame or iteration, with the results so far. The second one ends it at
once and writes nothing, since the map may be in the middle of a change.
"""

from __future__ import annotations

import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from tqdm import tqdm

from torchslam.system.online_run import Observer
from torchslam.types import StepResult
from torchslam.utils.console import tqdm_options

SIGNALS = (signal.SIGINT, signal.SIGTERM)
STATUS = {signal.SIGINT: 130, signal.SIGTERM: 143}  # 128 + the signal's number, as shells have it


@contextmanager
def shown_warnings() -> Iterator[None]:
    """Show warnings as lines, above the progress bars."""

    def show(message: Warning | str, *where: Any, **more: Any) -> None:
        tqdm.write(f"torchslam: warning: {message}", file=sys.stderr)

    with warnings.catch_warnings():
        warnings.simplefilter("always", UserWarning)
        warnings.showwarning = show
        yield


class StopSignals:
    """Signal handling of a run: the first signal makes `check` raise, the second one exits at once.

    Attributes:
        status: exit status for the last signal; 0 if there was none.
        is_wanted: whether `check` will raise.
    """

    def __init__(self) -> None:
        self.status = 0
        self.is_wanted = False
        self._phase = ""

    def begin(self, phase: str) -> None:
        """Enter a phase and forget earlier signals; `phase` is shown to the user: when the run will stop."""
        self._phase, self.is_wanted = phase, False
        for number in SIGNALS:
            signal.signal(number, self._wish)

    def check(self) -> None:
        """Raise KeyboardInterrupt if a signal arrived in this phase."""
        if self.is_wanted:
            self.is_wanted = False
            raise KeyboardInterrupt

    def __enter__(self) -> StopSignals:
        self._before = {number: signal.getsignal(number) for number in SIGNALS}
        return self

    def __exit__(self, *error: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _wish(self, number: int, frame: FrameType | None) -> None:
        self.status, self.is_wanted = STATUS[signal.Signals(number)], True
        for each in SIGNALS:
            signal.signal(each, self._end)
        tqdm.write(f"torchslam: stopping {self._phase}; again to stop at once", file=sys.stderr)

    def _end(self, number: int, frame: FrameType | None) -> None:
        raise SystemExit(STATUS[signal.Signals(number)])


# The monitor thread of tqdm would still run while the interpreter exits.
tqdm.monitor_interval = 0
# The default lock is shared with forks: one that is killed while it prints a warning would keep it.
tqdm.set_lock(threading.RLock())


class ProgressBars(Observer):
    """Progress lines of a run on stderr, with warnings above them: frames, the final adjustment, stages of mapping.

    A signal takes effect after the current step, when the map is consistent: the method raises KeyboardInterrupt.

    Args:
        stop_signals: the signal handler.
        frames: number of frames; None if unknown.
        count_points: returns the number of map points.
        after_frame: called with a frame's result and whether it is the last one, before it is shown.
    """

    def __init__(
        self,
        stop_signals: StopSignals,
        frames: int | None,
        count_points: Callable[[], int],
        after_frame: Callable[[StepResult, bool], None],
    ) -> None:
        self._stopping, self._frames, self._count_points = stop_signals, frames, count_points
        self._with_frame = after_frame
        self._bar, self._shown = tqdm(disable=True), ""

    @contextmanager
    def online(self, first: int) -> Iterator[None]:
        """Show a bar with frame, rate, state and map points."""
        bar = "{n_fmt} frames, {rate_noinv_fmt}{postfix}"
        if self._frames is not None:
            bar = "{n_fmt}/{total_fmt} |{bar:24}| {rate_noinv_fmt}, {remaining} left{postfix}"
        with self._stopping_when("after this frame"):
            self._show("frames", bar, self._frames, initial=first, unit=" frames")
            yield

    @contextmanager
    def whole(self) -> Iterator[None]:
        """Show a bar of each stage, with the time left."""
        with self._stopping_when("and keeping the run as it is, after this step"):
            yield

    def frame(self, result: StepResult, is_last: bool) -> None:
        """Advance to a frame."""
        self._with_frame(result, is_last)
        self._bar.set_postfix_str(f"{result.state.value}, {self._count_points()} points", refresh=False)
        self._advance(result.index + 1, self._frames)

    def adjusting(self, iteration: int, most: int) -> None:
        """Advance to an iteration of the final adjustment."""
        if self._shown != "adjusting":
            self._stopping.begin("the adjustment after this iteration")
            bar = "adjusting |{bar:24}| iteration {n_fmt} of at most {total_fmt}, {elapsed}"
            self._show("adjusting", bar, most)
        self._advance(iteration + 1, most)  # submaps begin anew

    def stage(self, stage: str, done: int, most: int) -> None:
        """Advance to a step of a stage."""
        if stage != self._shown:
            self._show(stage, "{desc} |{bar:24}| {n_fmt}/{total_fmt}, {remaining} left", most, desc=stage)
        self._advance(done, most)

    @contextmanager
    def _stopping_when(self, phase: str) -> Iterator[None]:
        with shown_warnings():
            self._stopping.begin(phase)
            try:
                yield
            finally:
                self._bar.close()
                self._shown = ""

    def _show(self, what: str, layout: str, total: int | None, **options: Any) -> None:
        self._bar.close()
        self._bar, self._shown = tqdm(total=total, bar_format=layout, **tqdm_options(), **options), what

    def _advance(self, done: int, total: int | None) -> None:
        self._bar.total = total
        self._bar.update(done - self._bar.n)
        self._stopping.check()
