"""Progress bars of a run, and its interruption by Ctrl-C and SIGTERM.

The first signal ends the run after the current frame or iteration, with the results so far. The second one ends it at
once and writes nothing, since the map may be in the middle of a change.
"""

from __future__ import annotations

import signal
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType
from typing import Any

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
        """Enter a phase and forget earlier signals; `phase` tells the user when the run will stop."""
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


class ProgressBar:
    """Progress line on stderr with frame, rate, state and map points; warnings are printed above it.

    A signal takes effect after the current frame or iteration, when the map is consistent.

    Args:
        frames: number of frames; None if unknown.
        count_points: returns the number of map points.
        stopping: the signal handler.
        done: number of frames that a resumed run had processed.
    """

    def __init__(
        self, frames: int | None, count_points: Callable[[], int], stop_signals: StopSignals, done: int = 0
    ) -> None:
        self._count_points = count_points
        self._stopping = stop_signals
        self._bar = tqdm(
            total=frames,
            initial=done,
            unit=" frames",
            **tqdm_options(),
            bar_format="{n_fmt} frames, {rate_noinv_fmt}{postfix}"
            if frames is None
            else "{n_fmt}/{total_fmt} |{bar:24}| {rate_noinv_fmt}, {remaining} left{postfix}",
        )
        self._adjusting: tqdm | None = None
        self._warnings = shown_warnings()

    def update(self, result: StepResult) -> None:
        """Advance to the frame of a result. Raises KeyboardInterrupt after a signal."""
        self._bar.set_postfix_str(f"{result.state.value}, {self._count_points()} points", refresh=False)
        self._bar.update(result.index + 1 - self._bar.n)
        self._stopping.check()

    def adjusting(self, iteration: int, iterations: int) -> None:
        """Advance to an iteration of the final adjustment. Raises KeyboardInterrupt after a signal."""
        if self._adjusting is None:
            self._stopping.begin("the adjustment after this iteration")
            self._bar.close()
            self._adjusting = tqdm(
                total=iterations,
                **tqdm_options(),
                bar_format="adjusting |{bar:24}| iteration {n_fmt} of at most {total_fmt}, {elapsed}",
            )
        self._adjusting.total = iterations
        self._adjusting.update(iteration + 1 - self._adjusting.n)  # submaps begin anew
        self._stopping.check()

    def __enter__(self) -> ProgressBar:
        self._warnings.__enter__()
        self._stopping.begin("after this frame")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._warnings.__exit__(kind, error, trace)
        self._bar.close()
        if self._adjusting is not None:
            self._adjusting.close()


class StageBar:
    """Progress line on stderr of stages that follow one another, with the time left of the present one.

    Args:
        stop_signals: the signal handler.
    """

    def __init__(self, stop_signals: StopSignals) -> None:
        self._stopping = stop_signals
        self._warnings = shown_warnings()
        self._stage = ""
        self._bar: tqdm | None = None

    def update(self, stage: str, done: int, most: int) -> None:
        """Advance to a step of a stage. Raises KeyboardInterrupt after a signal."""
        if stage != self._stage or self._bar is None:
            self._close()
            self._stage = stage
            self._bar = tqdm(
                total=most,
                desc=stage,
                **tqdm_options(),
                bar_format="{desc} |{bar:24}| {n_fmt}/{total_fmt}, {remaining} left",
            )
        self._bar.total = most
        self._bar.update(done - self._bar.n)
        self._stopping.check()

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None

    def __enter__(self) -> StageBar:
        self._warnings.__enter__()
        self._stopping.begin("and keeping the run as it is, after this step")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._warnings.__exit__(kind, error, trace)
        self._close()
