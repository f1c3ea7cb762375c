"""YAML, XML and JSON files of keys and numbers, as nested dicts and lists of text.

OpenCV's dialect of YAML (`%YAML:1.0`, `!!opencv-matrix`, `key:value`) is read as well; tags are skipped.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from typing import Any

from torchslam.utils.files import parse_json

Tree = dict[str, Any]
"""Keys to text, lists or trees."""
MAX_DEPTH = 20
"""Levels of nesting that are read, which bounds the recursion."""
MAX_YAML = 1 << 17
"""Characters of YAML, which takes seconds; calibrations with all their image points are smaller."""
MAX_ALIASES = 20
"""References to other parts of a file; those of references take exponential time."""
TIGHT_KEY = re.compile(r"^( *(?:- +)?[A-Za-z_][\w.]*):(?=[^\s/:])", re.MULTILINE)
"""A key without a space before its value, as OpenCV writes it."""


def read_tree(text: str, suffix: str) -> Tree | None:
    """Read the text of a file, by its first character or its suffix; None if it is none of these.

    Raises ValueError with the reason.
    """
    start = text.lstrip()
    if start.startswith("{"):
        tree = parse_json(text)
    elif start.startswith("<"):
        tree = _parse_xml(text)
    elif suffix.lower() in (".yaml", ".yml") or start.startswith("%YAML"):
        tree = parse_yaml(text)
    else:
        return None
    return tree if isinstance(tree, dict) else {}


def _parse_xml(text: str) -> Any:
    if "<!ENTITY" in text:
        raise ValueError("entities are not read")
    try:
        root = ET.fromstring(text)
    except ET.ParseError as cause:
        raise ValueError(f"not valid XML: {cause}") from cause
    return _from_element(root, 0)


def _from_element(element: ET.Element, depth: int) -> Any:
    _check_depth(depth)
    if len(element) == 0:
        return (element.text or "").strip().strip('"')
    tree: Tree = {}
    for child in element:
        tree.setdefault(child.tag, _from_element(child, depth + 1))
    return tree


def parse_yaml(text: str) -> Any:
    """Parse the first document, with all scalars as text. Raises ValueError naming the line, or for a size or depth."""
    if len(text) > MAX_YAML:
        raise ValueError(f"{len(text)} characters, more than the {MAX_YAML} of a YAML file that is read")
    import yaml  # here, so that nothing else waits for it

    class Loader(yaml.BaseLoader):
        """Bounds the depth, and the number of aliases, which may refer to each other."""

        depth = aliases = 0

        def compose_node(self, parent: Any, index: Any) -> Any:
            self.aliases += self.check_event(yaml.AliasEvent)
            self.depth += 1
            _check_depth(self.depth - 1)
            if self.aliases > MAX_ALIASES:
                raise ValueError(f"more than {MAX_ALIASES} aliases")
            node = super().compose_node(parent, index)
            self.depth -= 1
            return node

    lines = ("" if line.startswith("%") else line.expandtabs() for line in text.splitlines())
    try:
        return Loader(TIGHT_KEY.sub(r"\1: ", "\n".join(lines))).get_data() or {}
    except yaml.YAMLError as cause:
        mark = getattr(cause, "problem_mark", None)
        where = "" if mark is None else f"line {mark.line + 1}: "
        raise ValueError(f"not valid YAML: {where}{getattr(cause, 'problem', None) or cause}") from cause


def merged(items: list[Any]) -> Any:
    """The keys of several mappings as one; other items as they are."""
    if not items or not all(isinstance(item, dict) for item in items):
        return items
    return {key: value for item in reversed(items) for key, value in item.items()}


def _check_depth(depth: int) -> None:
    if depth > MAX_DEPTH:
        raise ValueError(f"nested deeper than {MAX_DEPTH}")
