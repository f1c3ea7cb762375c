"""Commands that pages only show, as they need data of yours: options, modules, targets and names in them do exist."""

from __future__ import annotations

import contextlib
import io
import re
import shlex
from collections.abc import Iterator
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest

from torchslam.cli.main import COMMANDS, build_parser

ROOT = Path(__file__).parents[2]
PAGES = [
    *(ROOT / "docs").rglob("*.md"),
    *(ROOT / "experiments").rglob("*.md"),
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
]
BEFORE = r"^ *(?:\$ )?(?:[A-Z_]+=\S+ )*"
OWN = re.compile(rf"{BEFORE}torchslam +({'|'.join(COMMANDS)}) (.*)$", re.MULTILINE)
MODULE = re.compile(r"python -m ((?:torchslam|experiments|examples|tests)[\w.]*)")
TARGET = re.compile(rf"(?:{BEFORE}|`)make ([a-z-]+)", re.MULTILINE)
PART = re.compile(r"--(?:features|matcher) ((?:torchslam|examples)[\w.]*):(\w+)")


def shown(text: str) -> Iterator[list[str]]:
    """The arguments of each command of ours, one a line, without what the shell does with its output."""
    for found in OWN.finditer(text.replace("\\\n", " ")):
        words = shlex.split(found[2].partition(">")[0], comments=True)
        yield [found[1], *("x" if word == "..." else word for word in words)]


def why_not(arguments: list[str]) -> str:
    """What the command line has against them; nothing where it takes them."""
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            build_parser(arguments[0]).parse_args(arguments)
    except SystemExit:
        return f"{shlex.join(arguments)}: {said.getvalue().splitlines()[-1]}"
    return ""


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_documented_commands_parse(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    wrong = list(filter(None, map(why_not, shown(text))))
    wrong += [f"python -m {name}" for name in MODULE.findall(text) if find_spec(name) is None]
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    wrong += [f"make {name}" for name in TARGET.findall(text) if name not in targets]
    parts = PART.findall(text)
    wrong += [f"{home}:{name}" for home, name in parts if not hasattr(import_module(home), name)]
    assert not wrong
