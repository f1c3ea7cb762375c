"""The page about modes says and shows what the program does."""

from __future__ import annotations

import re
from pathlib import Path

from experiments.report.modes import PICTURE, draw_modes
from torchslam.system.modes import TRANSITIONS, Mode

PAGE = (Path(__file__).parents[2] / "docs" / "tracking_modes.md").read_text(encoding="utf-8")
NAMES = [mode.name for mode in Mode]


def rows(title: str) -> list[list[str]]:
    """The cells of a table, without its title and the line below."""
    lines = PAGE.partition(f"{title}\n")[2].split("\n\n")[0].splitlines()
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[1:]]


def ids(svg: str) -> list[str]:
    """The modes and transitions of a picture."""
    return sorted(re.findall(r'id="([A-Z_]+(?:-[A-Z_]+)?)"', svg))


def test_the_table_lists_the_transitions() -> None:
    wanted = [
        [str(number), f"`{before.name}`", f"`{after.name}`", why]
        for number, ((before, after), why) in enumerate(TRANSITIONS.items(), start=1)
    ]
    assert rows("| number | from | to | with this frame |") == wanted


def test_the_picture_shows_the_modes_and_the_transitions() -> None:
    wanted = [*NAMES, *(f"{before.name}-{after.name}" for before, after in TRANSITIONS)]
    assert ids(PICTURE.read_text(encoding="utf-8")) == sorted(wanted)
    assert f"(images/{PICTURE.name})" in PAGE


def test_the_picture_is_drawn_anew_with_the_same_modes_and_transitions(tmp_path: Path) -> None:
    drawn, again = tmp_path / "one.svg", tmp_path / "two.svg"
    draw_modes(drawn)
    draw_modes(again)
    assert drawn.read_bytes() == again.read_bytes()
    assert ids(drawn.read_text(encoding="utf-8")) == ids(PICTURE.read_text(encoding="utf-8"))
