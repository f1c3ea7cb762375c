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
from types import FrameType, TracebackType
from typing import Any, Self

from tqdm import tqdm

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
    """Signal handling of a run: the first signal makes `check` raise, the second one exits at once."""

    def __init__(self) -> None:
        self._signal: int | None = None
        self._is_wanted = False
        self._phase = ""

    @property
    def status(self) -> int:
        """Exit status for the last signal; 0 if there was none."""
        return 0 if self._signal is None else STATUS[signal.Signals(self._signal)]

    @property
    def is_wanted(self) -> bool:
        """True if `check` will raise."""
        return self._is_wanted

    def begin(self, phase: str) -> None:
        """Enter a phase and forget earlier signals; `phase` is shown to the user: when the run will stop."""
        self._phase, self._is_wanted = phase, False
        for number in SIGNALS:
            signal.signal(number, self._wish)

    def check(self) -> None:
        """Raise KeyboardInterrupt if a signal arrived in this phase."""
        if self._is_wanted:
            self._is_wanted = False
            raise KeyboardInterrupt

    def __enter__(self) -> StopSignals:
        self._before = {number: signal.getsignal(number) for number in SIGNALS}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _wish(self, number: int, frame: FrameType | None) -> None:
        self._signal, self._is_wanted = number, True
        for each in SIGNALS:
            signal.signal(each, self._end)
        tqdm.write(f"torchslam: stopping {self._phase}; again to stop at once", file=sys.stderr)

    def _end(self, number: int, frame: FrameType | None) -> None:
        raise SystemExit(STATUS[signal.Signals(number)])


# The monitor thread of tqdm would still run while the interpreter exits.
tqdm.monitor_interval = 0
# The default lock is shared with forks: one that is killed while it prints a warning would keep it.
tqdm.set_lock(threading.RLock())


class _Bar:
    """A progress line on stderr, with warnings above it while this is entered.

    A signal takes effect after the current step, when the map is consistent.

    Args:
        stop_signals: the signal handler.
        phase: shown to the user: when the run will stop.
    """

    def __init__(self, stop_signals: StopSignals, phase: str) -> None:
        self._stopping, self._phase = stop_signals, phase
        self._bar: tqdm | None = None
        self._warnings = shown_warnings()

    def _show(self, layout: str, total: int | None, **options: Any) -> None:
        """Show another bar."""
        self._close()
        self._bar = tqdm(total=total, bar_format=layout, **tqdm_options(), **options)

    def _advance(self, done: int, total: int | None) -> None:
        """Advance the bar to a step. Raises KeyboardInterrupt after a signal."""
        assert self._bar is not None
        self._bar.total = total
        self._bar.update(done - self._bar.n)
        self._stopping.check()

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.close()

    def __enter__(self) -> Self:
        self._warnings.__enter__()
        self._stopping.begin(self._phase)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._warnings.__exit__(kind, error, trace)
        self._close()


class ProgressBar(_Bar):
    """Progress line with frame, rate, state and map points, then with the iterations of the final adjustment.

    Args:
        frames: number of frames; None if unknown.
        count_points: returns the number of map points.
        stop_signals: the signal handler.
        done: number of frames that a resumed run had processed.
    """

    def __init__(
        self, frames: int | None, count_points: Callable[[], int], stop_signals: StopSignals, done: int = 0
    ) -> None:
        super().__init__(stop_signals, "after this frame")
        self._frames, self._count_points, self._is_adjusting = frames, count_points, False
        bar = "{n_fmt} frames, {rate_noinv_fmt}{postfix}"
        if frames is not None:
            bar = "{n_fmt}/{total_fmt} |{bar:24}| {rate_noinv_fmt}, {remaining} left{postfix}"
        self._show(bar, frames, initial=done, unit=" frames")

    def update(self, result: StepResult) -> None:
        """Advance to the frame of a result. Raises KeyboardInterrupt after a signal."""
        assert self._bar is not None
        self._bar.set_postfix_str(f"{result.state.value}, {self._count_points()} points", refresh=False)
        self._advance(result.index + 1, self._frames)

    def adjusting(self, iteration: int, iterations: int) -> None:
        """Advance to an iteration of the final adjustment. Raises KeyboardInterrupt after a signal."""
        if not self._is_adjusting:
            self._is_adjusting = True
            self._stopping.begin("the adjustment after this iteration")
            self._show("adjusting |{bar:24}| iteration {n_fmt} of at most {total_fmt}, {elapsed}", iterations)
        self._advance(iteration + 1, iterations)  # submaps begin anew


class StageBar(_Bar):
    """Progress line of stages that follow one another, with the time left of the present one."""

    def __init__(self, stop_signals: StopSignals) -> None:
        super().__init__(stop_signals, "and keeping the run as it is, after this step")
        self._stage = ""

    def update(self, stage: str, done: int, most: int) -> None:
        """Advance to a step of a stage. Raises KeyboardInterrupt after a signal."""
        if stage != self._stage:
            self._stage = stage
            self._show("{desc} |{bar:24}| {n_fmt}/{total_fmt}, {remaining} left", most, desc=stage)
        self._advance(done, most)
