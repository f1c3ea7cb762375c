"""The panel without a browser: which run it shows."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.app.conftest import wait_until
from tests.app.test_jobs import runs
from torchslam.app.jobs import DEMO, Runs, State

viser = pytest.importorskip("viser", reason="the page needs viser: pip install 'torchslam[app]'")
__all__ = ["runs"]


@pytest.fixture
def viewer() -> Iterator[Any]:
    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    yield server
    server.stop()


def texts(viewer: Any) -> str:
    """What the texts of the panel contain."""
    handles = viewer.gui._container_handle_from_uuid["root"]._children.values()
    return "\n".join(each.content for each in handles if hasattr(each, "content"))


def test_a_run_that_goes_on_stays_shown_when_another_one_is_added(runs: Runs, viewer: Any) -> None:
    from torchslam.app.panel import Panel
    from torchslam.app.reading import ReadingProcess

    reader = ReadingProcess()
    panel = Panel(viewer, runs, reader)
    try:
        first = runs.add("first.mp4", DEMO)
        panel.begin(first)
        wait_until(lambda: "first.mp4</b>: running" in texts(viewer), 20)
        panel.begin(runs.add("second.mp4", DEMO))
        wait_until(lambda: "second.mp4: queued" in texts(viewer), 20)
        assert "first.mp4</b>: running" in texts(viewer)
        runs.stop(first)
        wait_until(lambda: "first.mp4</b>: stopped" in texts(viewer), 20)
        wait_until(lambda: "second.mp4: running" in texts(viewer), 20)
    finally:
        panel.close()
        for name in runs.names():
            runs.stop(name)
        wait_until(lambda: all(runs.state(name) is not State.RUNNING for name in runs.names()))
        reader.close()
