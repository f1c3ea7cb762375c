"""CPU time and memory of this process and of the children that have ended."""

from __future__ import annotations

import subprocess
import sys
from types import SimpleNamespace

import pytest

from torchslam.utils.timing import cpu_seconds, peak_memory_mb

BUSY = "import time\nblock = bytearray({megabytes} * 10**6)\nwhile time.process_time() < {seconds}: pass"

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="not counted there")


def test_children_that_have_ended_count() -> None:
    before_s, before_mb = cpu_seconds(), peak_memory_mb()
    assert before_s is not None
    assert before_mb is not None
    megabytes = round(before_mb + 100)
    subprocess.run([sys.executable, "-c", BUSY.format(megabytes=megabytes, seconds=0.5)], check=True)
    after_s, after_mb = cpu_seconds(), peak_memory_mb()
    assert after_s is not None
    assert after_mb is not None
    assert 0.5 <= after_s - before_s < 5
    assert megabytes <= after_mb < megabytes + 100


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
