"""What a page of the documentation says can be run: its fenced blocks, in order, in one folder.

`python` blocks share one namespace; one with a title is written to the file of that name instead. In `console` blocks
lines after `$ ` are commands; the lines below a command must be in its output, in this order, where `...` stands for
any text within a line and a line `...` for any lines. Blocks of other languages are shown, not run.
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

from torchslam.cli.main import main

FENCE = re.compile(r"^```(\w+)([^\n]*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
TITLE = re.compile(r'title="([\w./]+)"')
HERE = "PYTHONPATH=. "
"""Before a command that imports a file of the page: the folder is on the path of the tests anyway."""


@dataclass(frozen=True)
class Block:
    """A fenced block of a page, the line at which its text begins, and the file that it is, if it is one."""

    language: str
    text: str
    line: int
    title: str = ""


def blocks(page: Path) -> Iterator[Block]:
    """The blocks of a page that are run."""
    text = page.read_text(encoding="utf-8")
    for found in FENCE.finditer(text):
        if found[1] in ("python", "console"):
            title = TITLE.search(found[2])
            line = text[: found.start(3)].count("\n") + 1
            yield Block(found[1], found[3], line, title[1] if title else "")


def run_page(page: Path) -> dict[str, object]:
    """Run all blocks of a page in the current folder. Raises AssertionError that names page and line."""
    namespace: dict[str, object] = {"__name__": "__main__"}
    for block in blocks(page):
        where = f"{page.name}:{block.line}"
        if block.language == "console":
            run_console(block, where)
            continue
        if block.title:
            Path(block.title).write_text(block.text, encoding="utf-8")
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
        program, *arguments = shlex.split(command.removeprefix(HERE), comments=True)
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
