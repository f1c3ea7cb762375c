"""The page of closed studies: its figures stand in the pages that it links to, and each row says how to run it."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[2] / "docs" / "studies.md"
FIGURES = slice(2, 4)  # of the cells: figures and reason
NUMBER = re.compile(r"\d+(?:\.\d+)?")
REVISION = re.compile(r"\b(?=\w*\d)[0-9a-f]{7,8}\b")


def rows() -> list[list[str]]:
    lines = [line for line in PAGE.read_text(encoding="utf-8").splitlines() if line.startswith("| ")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return [row for row in cells if row[0] != "question"]


LINKED = [row for row in rows() if "](" in row[4] and "81bc88b6" not in row[4]]


@pytest.mark.parametrize("cells", LINKED, ids=lambda cells: cells[0][:40])
def test_every_figure_stands_in_the_page_of_its_study(cells: list[str]) -> None:
    (link,) = re.findall(r"\]\(([^)]+)\)", cells[4])
    study = set(NUMBER.findall((PAGE.parents[1] / link).read_text(encoding="utf-8")))
    numbers = {number for cell in cells[FIGURES] for number in NUMBER.findall(cell)}
    assert numbers
    assert numbers <= study, f"not in {link}: {sorted(numbers - study)}"


def test_a_row_has_figures_and_says_how_to_run_the_study() -> None:
    for row in rows():
        assert NUMBER.search(row[2]), row[0]
        can_run = row[4].startswith(("`python -m ", "the same", "a script that was not kept; "))
        assert can_run or REVISION.search(row[4]), row[0]
