"""Files of keys: YAML as programs and people write it."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path
from typing import Any

import hypothesis.strategies as st
import pytest
from hypothesis import given

from torchslam.data.formats.key_files import MAX_YAML, parse_yaml, read_tree

NAMES = st.sampled_from(["a", "b_c", "D", "Camera.fx", "k1", "data"])
SCALARS = st.one_of(st.integers(-1000, 1000), st.floats(-1e3, 1e3), st.sampled_from(["abc", "x y"]))
TREES = st.dictionaries(
    NAMES,
    st.recursive(
        SCALARS,
        lambda inner: st.one_of(
            st.lists(inner, min_size=1, max_size=4), st.dictionaries(NAMES, inner, min_size=1, max_size=3)
        ),
        max_leaves=12,
    ),
    min_size=1,
    max_size=4,
)


def numbers(tree: Any) -> Any:
    """The same with all that is a number as a number."""
    if isinstance(tree, dict):
        return {key: numbers(value) for key, value in tree.items()}
    if isinstance(tree, list):
        return [numbers(value) for value in tree]
    try:
        return float(tree)
    except ValueError:
        return tree


@given(TREES, st.sampled_from([None, True, False]), st.sampled_from([40, 80, 1000]))
def test_what_pyyaml_writes(tree: dict[str, Any], flow: bool | None, width: int) -> None:
    yaml = pytest.importorskip("yaml")
    assert numbers(parse_yaml(yaml.dump(tree, default_flow_style=flow, width=width))) == numbers(tree)


@pytest.mark.parametrize(
    ("text", "tree"),
    [
        ("a: 1   # one\n# b: 2\n\nc: 'x, y'\n", {"a": "1", "c": "x, y"}),
        ("a:\n  - b: 1\n    c: 2\n  -\n    - 3\n", {"a": [{"b": "1", "c": "2"}, ["3"]]}),
        ("a: {b: [1, 2], c: {d: 3}}\n", {"a": {"b": ["1", "2"], "c": {"d": "3"}}}),
        ("a: [fx: 1, fy: 2]\n", {"a": [{"fx": "1"}, {"fy": "2"}]}),
        ("a: &x !!opencv-matrix\n  rows: 1\nb: !!python/tuple [1]\n", {"a": {"rows": "1"}, "b": ["1"]}),
        ("a: some words\n  that go on\nb: 1\n", {"a": "some words that go on", "b": "1"}),
        ("%YAML:1.0\n---\nCamera.fx:500\n", {"Camera.fx": "500"}),
        ("a: &x [1]\nb: *x\n", {"a": ["1"], "b": ["1"]}),
        ("", {}),
    ],
)
def test_yaml(text: str, tree: dict[str, Any]) -> None:
    assert parse_yaml(text) == tree


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: 1\nb: [1, 2\n", "line 2: expected"),
        ("%YAML:1.0\na: 1\nb: 2: 3\n", "line 3: mapping values are not allowed here"),
        ("a" * (MAX_YAML + 1), "characters, more than"),
        ("a: &a [1]\n" + "b: *a\n" * 21, "more than 20 aliases"),
        ("[" * 30, "nested deeper than 20"),
    ],
)
def test_wrong_yaml(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parse_yaml(text)


@pytest.mark.parametrize(
    ("text", "tree"),
    [
        ("<r><a> 1 2\n3 </a><b><c>4</c></b></r>", {"a": "1 2\n3", "b": {"c": "4"}}),
        ('{"a": [1]}', {"a": [1]}),
        ("1 2 3 4", None),
    ],
)
def test_files_by_their_content(tmp_path: Path, text: str, tree: dict[str, Any] | None) -> None:
    (tmp_path / "keys.txt").write_text(text)
    assert read_tree(tmp_path / "keys.txt") == tree


@pytest.mark.parametrize(
    "text",
    [
        *("a" + " " * 250_000 + "b", "[" * 250_000, "[\n" * 120_000, "- " * 120_000, "a: b\n" * 25_000),
        *("- \n" * 40_000, "a:\n" * 40_000, ":" * 250_000, '"' * 250_000, "{a: " * 60_000),
        "a: [\n" + "1,\n" * 40_000,
        "".join(" " * depth + "a:\n" for depth in range(600)),
    ],
)
def test_every_text_ends_soon(text: str) -> None:
    start = time.process_time()
    with contextlib.suppress(ValueError):
        parse_yaml(text[:MAX_YAML])
    assert time.process_time() - start < 10  # as of every reader; it takes up to 4
