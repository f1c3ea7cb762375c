"""The progress bars of a run: over its frames, then over the iterations of the final adjustment."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable
from types import TracebackType
from typing import Any

from tqdm import tqdm

from torchslam.cli.signals import Stopping
from torchslam.types import StepResult
from torchslam.utils.progress import stream

# No thread that looks after bars which wait for their turn: a second process could not be a copy of this one.
tqdm.monitor_interval = 0


class ProgressBar:
    """Frame, rate, state and points on one line of stderr, in a log on one every few seconds; warnings are printed
    above it.

    A signal takes effect after the frame, or the iteration, at hand, when the map is whole.

    frames: how many there are, None where nobody knows
    done:   frames that were processed before, by a run that this one goes on with
    """

    def __init__(
        self, frames: int | None, count_points: Callable[[], int], stopping: Stopping, done: int = 0
    ) -> None:
        self._count_points = count_points
        self._stopping = stopping
        self._bar = tqdm(
            total=frames,
            initial=done,
            unit=" frames",
            **stream(),
            bar_format="{n_fmt} frames, {rate_noinv_fmt}{postfix}"
            if frames is None
            else "{n_fmt}/{total_fmt} |{bar:24}| {rate_noinv_fmt}, {remaining} left{postfix}",
        )
        self._adjusting: tqdm | None = None
        self._warnings = warnings.catch_warnings()

    def update(self, result: StepResult) -> None:
        """Move on to the frame of a result. Raises KeyboardInterrupt where there is a wish to stop."""
        self._bar.set_postfix_str(f"{result.state.value}, {self._count_points()} points", refresh=False)
        self._bar.update(result.index + 1 - self._bar.n)
        self._stopping.check()

    def adjusting(self, iteration: int, iterations: int) -> None:
        """Move on to an iteration of the final adjustment. Raises KeyboardInterrupt where there is a wish to stop."""
        if self._adjusting is None:
            self._stopping.begin("the adjustment after this iteration")
            self._bar.close()
            self._adjusting = tqdm(
                total=iterations,
                **stream(),
                bar_format="adjusting |{bar:24}| iteration {n_fmt} of at most {total_fmt}, {elapsed}",
            )
        self._adjusting.total = iterations
        self._adjusting.update(iteration + 1 - self._adjusting.n)  # submaps begin anew
        self._stopping.check()

    def __enter__(self) -> ProgressBar:
        self._warnings.__enter__()
        warnings.simplefilter("always", UserWarning)
        warnings.showwarning = self._show
        self._stopping.begin("after this frame")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._warnings.__exit__(kind, error, trace)
        self._bar.close()
        if self._adjusting is not None:
            self._adjusting.close()

    def _show(self, message: Warning | str, *where: Any, **more: Any) -> None:
        tqdm.write(f"torchslam: warning: {message}", file=sys.stderr)
