"""What a frame takes, stage by stage: all of it, none of it twice; CPU time and memory with ended children."""

from __future__ import annotations

import subprocess
import sys
from types import SimpleNamespace

import pytest

from torchslam.utils import timing
from torchslam.utils.timing import Stopwatch, cpu_seconds, peak_memory_mb


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


# A process of its own: what ended children of the tests before took must not count.
COUNT = """
import subprocess, sys
from torchslam.utils.timing import cpu_seconds, peak_memory_mb
before_s, before_mb = cpu_seconds(), peak_memory_mb()
megabytes = round(before_mb + 100)
busy = f"import time\\nblock = bytearray({megabytes} * 10**6)\\nwhile time.process_time() < .5: pass"
busy += "\\nprint(time.process_time())"
own = subprocess.run([sys.executable, "-c", busy], check=True, capture_output=True, text=True).stdout
print(cpu_seconds() - before_s - float(own), peak_memory_mb() - megabytes)
"""

counted = pytest.mark.skipif(sys.platform == "win32", reason="not counted there")


@counted
def test_children_that_have_ended_count() -> None:
    done = subprocess.run([sys.executable, "-c", COUNT], check=True, capture_output=True, text=True)
    more_s, more_mb = map(float, done.stdout.split())
    assert 0 <= more_s < 4.5
    assert 0 <= more_mb < 100


@counted
@pytest.mark.parametrize(("system", "megabytes"), [("linux", 2.048), ("darwin", 0.002)])
def test_memory_is_counted_in_the_unit_of_the_system(
    system: str, megabytes: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    peaks = {0: 1000, -1: 2000}
    monkeypatch.setattr(sys, "platform", system)
    monkeypatch.setattr("resource.getrusage", lambda who: SimpleNamespace(ru_maxrss=peaks[who]))
    assert peak_memory_mb() == pytest.approx(megabytes)


def test_windows_counts_neither(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "win32")
    assert cpu_seconds() is None
    assert peak_memory_mb() is None
