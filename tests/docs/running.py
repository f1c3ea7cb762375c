"""What a page of the documentation says can be run: its fenced blocks, in order, in one folder.

`python` blocks share one namespace. In `console` blocks lines after `$ ` are commands; the lines below a command must
be in its output, in this order, where `...` stands for any text within a line and a line `...` for any lines. Blocks of
other languages are shown, not run.
"""

from __future__ import annotations

import contextlib
import io
import re
import shlex
import traceback
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from torchslam.cli import main

FENCE = re.compile(r"^```(\w+)[^\n]*\n(.*?)^```$", re.MULTILINE | re.DOTALL)


@dataclass(frozen=True)
class Block:
    """A fenced block of a page, and the line at which its text begins."""

    language: str
    text: str
    line: int


def blocks(page: Path) -> Iterator[Block]:
    """The blocks of a page that are run."""
    text = page.read_text(encoding="utf-8")
    for found in FENCE.finditer(text):
        if found[1] in ("python", "console"):
            yield Block(found[1], found[2], text[: found.start(2)].count("\n") + 1)


def run_page(page: Path) -> dict[str, object]:
    """Run all blocks of a page in the current folder. Raises AssertionError that names page and line."""
    namespace: dict[str, object] = {"__name__": "__main__"}
    for block in blocks(page):
        where = f"{page.name}:{block.line}"
        if block.language == "console":
            run_console(block, where)
            continue
        # As many empty lines before it as there are in the page: a traceback names the line of the page.
        source = "\n" * (block.line - 1) + block.text
        try:
            exec(compile(source, str(page), "exec"), namespace)
        except Exception as error:
            raise AssertionError(f"{where} failed:\n{traceback.format_exc()}") from error
    return namespace


def run_console(block: Block, where: str) -> None:
    """Run the commands of a block, all of `torchslam`, and compare what they print."""
    for part in re.split(r"^\$ ", block.text, flags=re.MULTILINE)[1:]:
        command, _, expected = part.replace("\\\n", " ").partition("\n")
        program, *arguments = shlex.split(command, comments=True)
        assert program == "torchslam", f"{where}: only torchslam is run here, not {program}"
        output = io.StringIO()
        with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
            status = main(arguments)
        assert status == 0, f"{where}: `{command}` ended with {status}:\n{output.getvalue()}"
        missing = first_missing(expected, output.getvalue())
        assert missing is None, f"{where}: `{command}` did not print `{missing}` but\n{output.getvalue()}"


def first_missing(expected: str, printed: str) -> str | None:
    """The first of the expected lines that is not among the printed ones, behind the line before it."""
    lines = iter(printed.splitlines())
    for wanted in filter(None, map(str.strip, expected.splitlines())):
        pattern = re.compile(".*".join(map(re.escape, re.split(r"\.\.\.", wanted))))
        if wanted != "..." and not any(pattern.fullmatch(line.strip()) for line in lines):
            return wanted
    return None
