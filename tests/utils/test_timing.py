"""What a frame takes, stage by stage: all of it, none of it twice."""

from __future__ import annotations

import pytest

from torchslam.utils import timing
from torchslam.utils.timing import Stopwatch


@pytest.fixture
def wait(monkeypatch: pytest.MonkeyPatch):
    """Lets milliseconds pass."""
    now = [0.0]
    monkeypatch.setattr(timing.time, "perf_counter", lambda: now[0])

    def passes(milliseconds: float) -> None:
        now[0] += milliseconds / 1e3

    return passes


def test_the_remainder_is_the_time_of_no_inner_stage(wait) -> None:
    clock = Stopwatch()
    with clock("features"):
        wait(5)
    with clock.rest("rest"):
        wait(1)
        with clock("tracking"):
            wait(6)
        wait(2)
        with clock("features"):
            wait(3)
    wait(100)  # between two frames
    assert clock.take() == pytest.approx({"features": 8, "tracking": 6, "rest": 3, "total": 17})
    assert clock.take() == {"total": 0}


def test_a_failing_stage_is_timed(wait) -> None:
    clock = Stopwatch()

    def fail() -> None:
        with clock.rest("rest"):
            wait(1)
            with clock("tracking"):
                wait(2)
                raise RuntimeError("too bad")

    with pytest.raises(RuntimeError, match="too bad"):
        fail()
    assert clock.take() == pytest.approx({"tracking": 2, "rest": 1, "total": 3})
