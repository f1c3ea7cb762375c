"""How worker processes are started."""

from __future__ import annotations

import sys

import pytest

FORK = "fork" if sys.platform == "linux" else pytest.param("fork", marks=pytest.mark.slow)
SPAWN = pytest.param("spawn", marks=pytest.mark.slow) if sys.platform == "linux" else "spawn"
usual_start = pytest.mark.parametrize("start_method", [FORK, SPAWN], indirect=True)
"""For what happens after the start: `make test` starts workers as runs do on this platform; the other way is slow."""


@pytest.fixture(params=["fork", "spawn"])
def start_method(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Workers are started in this way."""
    if request.param == "fork" and sys.platform != "linux":
        pytest.skip("workers are forks on Linux alone")
    monkeypatch.setattr("torchslam.parallel.pool.can_fork", lambda: request.param == "fork")
    method: str = request.param
    return method
