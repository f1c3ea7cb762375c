"""The sources of `make docs`, as far as they can be checked without its tools."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
MADE = {"settings.md", "commands.md", "map_file.md"}
"""Pages that docs/theme/pages.py generates."""
LINK = re.compile(r"!?\[[^\]]*\]\(([^)#\s]+)(#[^)]*)?\)")
NAV = re.compile(r"^ +- .*?: ([\w/.-]+\.md)$", re.MULTILINE)
PAGES = [
    *(ROOT / "docs").rglob("*.md"),
    *(ROOT / f"{name}.md" for name in ("README", "CONTRIBUTING", "SECURITY")),
]


def target(page: Path, link: str) -> Path:
    """The file that a link leads to: experiments, CONTRIBUTING and CHANGELOG lie in the root next to docs/."""
    path = (page.parent / link).resolve()
    if path.exists() or not path.is_relative_to(ROOT / "docs"):
        return path
    return ROOT / path.relative_to(ROOT / "docs")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_resolve(page: Path) -> None:
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    links = [found[1] for found in LINK.finditer(text) if "://" not in found[1]]
    missing = [link for link in links if not target(page, link).exists() and Path(link).name not in MADE]
    assert not missing


def test_every_page_is_in_the_navigation() -> None:
    listed = set(NAV.findall((ROOT / "mkdocs.yml").read_text(encoding="utf-8")))
    here = {path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md")}
    studies = {path.relative_to(ROOT).as_posix() for path in (ROOT / "experiments").rglob("*.md")}
    there = here | studies | MADE | {"CONTRIBUTING.md", "CHANGELOG.md"}
    assert not there - listed, "pages that `nav` of mkdocs.yml does not list"
    assert not listed - there, "pages in `nav` of mkdocs.yml that there are not"


def test_pictures_are_small() -> None:
    """The animation of the README may have 1 MB, other pictures 200 kB."""
    limits = {".webp": 1_000_000}
    pictures = (ROOT / "docs" / "images").iterdir()
    assert not [path.name for path in pictures if path.stat().st_size > limits.get(path.suffix, 200_000)]
