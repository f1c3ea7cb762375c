from __future__ import annotations

import io
import sys

import pytest
from tqdm import tqdm

from torchslam.utils import console
from torchslam.utils.console import tqdm_options


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def shown(monkeypatch: pytest.MonkeyPatch, file: io.StringIO) -> str:
    monkeypatch.setattr(sys, "stderr", file)
    with tqdm(total=50, **tqdm_options()) as bar:
        for _ in range(50):
            bar.update()
    return file.getvalue()


def test_a_log_has_few_progress_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    text = shown(monkeypatch, io.StringIO())
    assert "\r" not in text
    first, last = text.splitlines()
    assert "0/50" in first
    assert "50/50" in last
    monkeypatch.setattr(console, "INTERVAL", 0.0)
    assert len(shown(monkeypatch, io.StringIO()).splitlines()) > 40


def test_a_terminal_has_a_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    assert "\r" in shown(monkeypatch, Terminal())
