"""Docstrings in the style of the house, as the documentation shows them."""

from __future__ import annotations

from pathlib import Path

import pytest

griffe = pytest.importorskip("griffe", reason="the extra docs is not installed: make test-docs")

EXTENSION = Path(__file__).parents[2] / "docs" / "theme" / "docstrings.py"
SOURCE = '''
"""Things."""

from dataclasses import dataclass, field


@dataclass
class Thing:
    """A thing; see `thing`.

    T_cw:  (F, 4, 4); points_w: (P, 3)
    first, second: two numbers,
           in px^-2

    Its cost is theta* times rho* of x_1, [0, 1] or a < b.

        code = of(a_thing)
    """

    T_cw: int
    points_w: int
    first: int = 0
    second: list = field(default_factory=lambda: [1])


def thing(points: int, mask: int) -> int:
    """Make one.

    points: (N, 3), mask: (N,), all; none. Returns (N,), which
    goes on here. mask: is prose now.
    Raises ValueError for what is none.
    """


Kind = int
"""What it is.

"one":   the first
"other": the
         second
"""
'''


@pytest.fixture
def docstrings(tmp_path: Path) -> dict[str, str]:
    """The docstrings after the extension, by the names of what has them."""
    (tmp_path / "torchslam").mkdir()
    (tmp_path / "torchslam" / "__init__.py").write_text(SOURCE)
    extensions = griffe.load_extensions("dataclasses", str(EXTENSION))
    package = griffe.load(
        "torchslam", search_paths=[str(tmp_path)], extensions=extensions, try_relative_path=False
    )
    return {name: package[name].docstring.value for name in ("Thing", "thing", "Kind")}


def test_fields_become_attributes_with_all_of_their_text(docstrings: dict[str, str]) -> None:
    lines = docstrings["Thing"].splitlines()
    start = lines.index("Attributes:")
    assert lines[start + 1 : start + 5] == [
        "    T_cw: (F, 4, 4)",
        "    points_w: (P, 3)",
        "    first: two numbers, in px^-2",
        "    second: two numbers, in px^-2",
    ]


def test_prose_is_no_markup_and_code_is_code(docstrings: dict[str, str]) -> None:
    assert r"theta\* times rho\* of x_1, \[0, 1\] or a &lt; b." in docstrings["Thing"]
    assert "```python\ncode = of(a_thing)\n```" in docstrings["Thing"]


def test_names_become_links(docstrings: dict[str, str]) -> None:
    assert (
        '<autoref optional identifier="torchslam.thing"><code>thing</code></autoref>' in docstrings["Thing"]
    )


def test_what_is_returned_is_no_part_of_a_parameter(docstrings: dict[str, str]) -> None:
    text = docstrings["thing"]
    assert "Args:\n    points: (N, 3)\n    mask: (N,), all; none\n" in text
    assert "Returns (N,), which goes on here. mask: is prose now. Raises ValueError" in text


def test_values_of_a_name_become_a_list(docstrings: dict[str, str]) -> None:
    assert '- `"one"`: the first\n- `"other"`: the second' in docstrings["Kind"]
