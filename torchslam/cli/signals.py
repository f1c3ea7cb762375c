"""What Ctrl-C and SIGTERM do to a run: it comes to an end, with everything written that there is by then.

The second one ends it at once, whatever it is at, and nothing more is written: the map may be halfway through a change.
"""

from __future__ import annotations

import signal
import sys
from types import FrameType, TracebackType

from tqdm import tqdm

SIGNALS = (signal.SIGINT, signal.SIGTERM)
STATUS = {signal.SIGINT: 130, signal.SIGTERM: 143}  # 128 + the signal's number, as shells have it


class Stopping:
    """While it is entered, the first signal of a phase is a wish, which `check` grants; the second one ends at once."""

    def __init__(self) -> None:
        self._signal: int | None = None
        self._is_wanted = False
        self._phase = ""

    @property
    def status(self) -> int:
        """The exit status that tells of the last signal; 0 where there was none."""
        return 0 if self._signal is None else STATUS[signal.Signals(self._signal)]

    @property
    def is_wanted(self) -> bool:
        """Whether `check` would raise."""
        return self._is_wanted

    def begin(self, phase: str) -> None:
        """Enter a phase, in words: what is done before the wish is granted. What was wished before counts no more."""
        self._phase, self._is_wanted = phase, False
        for number in SIGNALS:
            signal.signal(number, self._wish)

    def check(self) -> None:
        """Raises KeyboardInterrupt once there is a wish to stop in this phase."""
        if self._is_wanted:
            self._is_wanted = False
            raise KeyboardInterrupt

    def __enter__(self) -> Stopping:
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
