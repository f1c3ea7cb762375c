"""The same bytes by Ray Data with one and two workers, and a worker that dies; a local cluster each time."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.batch.conftest import batch, content
from tests.batch.workers import answer
from torchslam.batch import Engine

pytest.importorskip("ray", reason="the extra `ray` is not installed")
pytestmark = pytest.mark.slow


@pytest.mark.parametrize("workers", [1, 2])
def test_same_bytes_with_one_worker_or_two(whole: Path, listed: Path, tmp_path: Path, workers: int) -> None:
    more = ["--engine", "ray", "--workers", str(workers)]
    assert batch(listed, tmp_path, more) == 4
    assert content(tmp_path) == content(whole)


def test_a_dying_worker_fails_only_its_row() -> None:
    found = dict(Engine("ray", workers=1).map_unordered(answer, [{"number": number} for number in range(3)]))
    expected = {number: {"twice": 2 * number, "nothing": None} for number in (0, 2)}
    assert found == {**expected, 1: None}
