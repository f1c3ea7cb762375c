"""The progress bar of a run, and what Ctrl-C does while it is shown."""

from __future__ import annotations

import signal
import sys
import warnings
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import Any

from tqdm import tqdm

from torchslam.values import StepResult


class ProgressBar:
    """Frame, rate, state and points on one line of stderr; warnings are printed above it.

    Ctrl-C takes effect after the frame at hand, when the map is whole; the second one at once.
    """

    def __init__(self, frames: int, count_points: Callable[[], int]) -> None:
        self._count_points = count_points
        self._bar = tqdm(
            total=frames,
            unit=" frames",
            file=sys.stderr,
            dynamic_ncols=True,
            bar_format="{n_fmt}/{total_fmt} |{bar:24}| {rate_noinv_fmt}, {remaining} left{postfix}",
        )
        self._warnings = warnings.catch_warnings()
        self._is_stopping = False

    def update(self, result: StepResult) -> None:
        """Move on to the frame of a result. Raises KeyboardInterrupt when Ctrl-C was pressed during it."""
        self._bar.set_postfix_str(f"{result.state.value}, {self._count_points()} points", refresh=False)
        self._bar.update(result.index + 1 - self._bar.n)
        if self._is_stopping:
            raise KeyboardInterrupt

    def __enter__(self) -> ProgressBar:
        self._warnings.__enter__()
        warnings.simplefilter("always", UserWarning)
        warnings.showwarning = self._show
        self._handler = signal.signal(signal.SIGINT, self._stop)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        signal.signal(signal.SIGINT, self._handler)
        self._warnings.__exit__(kind, error, trace)
        self._bar.close()

    def _stop(self, number: int, frame: FrameType | None) -> None:
        self._is_stopping = True
        signal.signal(signal.SIGINT, signal.default_int_handler)
        tqdm.write("torchslam: stopping after this frame; again to stop at once", file=sys.stderr)

    def _show(self, message: Warning | str, *where: Any, **more: Any) -> None:
        tqdm.write(f"torchslam: warning: {message}", file=sys.stderr)
