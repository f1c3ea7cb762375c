"""The page of studies that said no: its figures stand in the pages that it links to, and its commands exist."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[2] / "docs" / "studies.md"
ROOT = PAGE.parents[1]
FIGURES = slice(2, 4)  # of the cells: figure and reason
NUMBER = re.compile(r"\d+(?:\.\d+)?")


def rows() -> list[list[str]]:
    lines = [line for line in PAGE.read_text(encoding="utf-8").splitlines() if line.startswith("| ")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return [row for row in cells if row[0] != "question"]


@pytest.mark.parametrize("cells", rows(), ids=lambda cells: cells[0][:40])
def test_every_figure_stands_in_the_page_of_its_study(cells: list[str]) -> None:
    (link,) = re.findall(r"\]\(([^)]+)\)", cells[4])
    study = set(NUMBER.findall((ROOT / link).read_text(encoding="utf-8")))
    numbers = {number for cell in cells[FIGURES] for number in NUMBER.findall(cell)}
    assert numbers
    assert numbers <= study, f"not in {link}: {sorted(numbers - study)}"


def test_a_study_that_is_run_again_says_how() -> None:
    known = ("`python -m ", "the same; ", "revision ", "a script of its own; ")
    assert [cells[0] for cells in rows() if not cells[4].startswith(known)] == []
    assert len(rows()) >= 14
