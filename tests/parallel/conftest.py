"""How worker processes are started."""

from __future__ import annotations

import sys

import pytest


@pytest.fixture(params=["fork", "spawn"])
def start_method(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Workers are started in this way."""
    if request.param == "fork" and sys.platform != "linux":
        pytest.skip("workers are forks on Linux alone")
    monkeypatch.setattr("torchslam.parallel.pool.can_fork", lambda: request.param == "fork")
    method: str = request.param
    return method
