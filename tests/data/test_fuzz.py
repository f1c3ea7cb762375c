"""Whatever a file holds, a reader returns something valid or raises its own error, in bounded time and memory.

`make fuzz` tries thirty times as many inputs, each in a process with limits.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.fuzz.inputs import clear, numbers, outcome
from tests.fuzz.readers import readers


@pytest.mark.parametrize("name", readers())
def test_wrong_inputs_are_read_or_refused(tmp_path: Path, name: str) -> None:
    """Every thirtieth one of `python -m tests.fuzz`; `--only NAME:NUMBER` tries a single one."""
    reader = readers()[name]
    for number in numbers(reader.inputs, 1_000):
        found = outcome(reader, number, tmp_path)
        assert found.verdict in ("read", "refused"), f"{name}:{number}: {found.verdict}: {found.what}"
    clear(tmp_path)
