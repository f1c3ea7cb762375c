"""YAML, XML and JSON files of keys and numbers, as nested dicts and lists of text.

YAML is read as programs write it: OpenCV's dialect (`%YAML:1.0`, `!!opencv-matrix`), ROS, Kalibr, PyYAML's block lists,
and by hand; tags and anchors are skipped. Strings over several lines are joined.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from typing import Any, NamedTuple

from torchslam.utils.files import parse_json

Tree = dict[str, Any]
"""Keys to text, lists or trees."""
MAX_DEPTH = 20
"""Levels of nesting that are read, which bounds the recursion."""
KEY = re.compile(r"""("[^"]*"|'[^']*'|[^\s:"'\[\]{},][^:\[\]{}]*):((?:[ ].*|[^/\s].*)?)""")
TAGS = re.compile(r"^(?:[!&]\S*(?:\s+|$))+")
FLOW = re.compile(r""""(?:[^"\\]|\\.)*"|'[^']*'|[\[\]{},]|[^\[\]{},"']+|["']""")
COMMENT = re.compile(r"(?:^|\s)#")


def read_tree(text: str, suffix: str) -> Tree | None:
    """Read the text of a file, by its first character or its suffix; None if it is none of these.

    Raises ValueError, which says what is wrong.
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


class Line(NamedTuple):
    """A line of YAML, with its brackets closed."""

    indent: int
    text: str


def parse_yaml(text: str) -> Any:
    """Parse the first document. Raises ValueError where it is nested too deep."""
    lines = _logical_lines(text)
    return _Blocks(lines).value(0, 0) if lines else {}


def _logical_lines(text: str) -> list[Line]:
    """The lines without comments; a bracket that is left open takes what follows."""
    lines: list[Line] = []
    words: list[str] = []
    indent = open_brackets = 0
    for raw in text.splitlines():
        line = COMMENT.split(raw.expandtabs(), maxsplit=1)[0].rstrip()
        content = line.lstrip()
        if not content or content.startswith(("%", "---", "...")):
            continue
        indent = indent if words else len(line) - len(content)
        words.append(content)
        unquoted = re.sub(r""""[^"]*"|'[^']*'""", "", content)
        opened = sum(map(unquoted.count, "[{")) - sum(map(unquoted.count, "]}"))
        open_brackets = max(open_brackets + opened, 0)
        if open_brackets == 0:
            lines.append(Line(indent, " ".join(words)))
            words = []
    return [*lines, Line(indent, " ".join(words))] if words else lines


class _Blocks:
    """Reads lines from the first to the last, by their indents."""

    def __init__(self, lines: list[Line]) -> None:
        self._lines = lines
        self._at = 0

    def value(self, indent: int, depth: int) -> Any:
        """The block of lines from here that are at least so far in."""
        _check_depth(depth)
        line = self._line(indent)
        if line is None:
            return ""
        if _is_item(line.text):
            return self._items(line.indent, depth)
        if KEY.fullmatch(line.text):
            return self._keys(line.indent, depth)
        self._at += 1
        return self._scalar(line.text, line.indent - 1, depth)

    def _line(self, indent: int) -> Line | None:
        """The line here, unless it is less far in."""
        line = self._lines[self._at] if self._at < len(self._lines) else None
        return line if line is not None and line.indent >= indent else None

    def _items(self, indent: int, depth: int) -> list[Any]:
        items = []
        while (line := self._line(indent)) and line.indent == indent and _is_item(line.text):
            rest = line.text[1:].lstrip()
            if rest:  # what follows the dash is a block of its own, as far in as it stands
                inner = indent + len(line.text) - len(rest)
                self._lines[self._at] = Line(inner, rest)
                items.append(self.value(inner, depth + 1))
            else:
                self._at += 1
                items.append(self.value(indent + 1, depth + 1))
            self._skip_deeper(indent)
        return items

    def _keys(self, indent: int, depth: int) -> Tree:
        tree: Tree = {}
        while (line := self._line(indent)) and line.indent == indent:
            found = KEY.fullmatch(line.text)
            self._at += 1
            if found is None:
                continue
            rest = TAGS.sub("", found[2].strip())
            if rest:
                value = self._scalar(rest, indent, depth)
            else:
                below = self._line(indent)
                is_list = below is not None and _is_item(
                    below.text
                )  # whose dashes may stand where the key does
                value = self.value(indent if is_list else indent + 1, depth + 1)
            tree.setdefault(found[1].strip("\"' "), value)
            self._skip_deeper(indent)
        return tree

    def _scalar(self, text: str, indent: int, depth: int) -> Any:
        """A value on its line, with the lines further in that continue it."""
        words = [text]
        while (line := self._line(indent + 1)) is not None:
            words.append(line.text)
            self._at += 1
        whole = " ".join(words)
        if whole[:1] in "[{":
            return _parse_flow(whole, depth)
        return whole.strip("\"'")

    def _skip_deeper(self, indent: int) -> None:
        while self._line(indent + 1) is not None:
            self._at += 1


def _is_item(text: str) -> bool:
    return text == "-" or text.startswith("- ")


def _parse_flow(text: str, depth: int) -> Any:
    """A list or mapping in brackets; one that is not closed ends with the text."""
    stack: list[tuple[str, list[Any]]] = [("", [])]
    words: list[str] = []

    def end_item() -> None:
        word = "".join(words).strip()
        words.clear()
        if word:
            found = KEY.fullmatch(word)
            item = {found[1].strip("\"' "): found[2].strip("\"' ")} if found else word.strip("\"'")
            stack[-1][1].append(item)

    def end_bracket() -> None:
        end_item()
        if len(stack) > 1:
            key, items = stack.pop()
            value = merged(items) if text_of[len(stack)] == "{" else items
            stack[-1][1].append({key: value} if key else value)

    text_of = {0: ""}  # the bracket that opened each level
    for token in FLOW.findall(text):
        if token in "[{":
            _check_depth(depth + len(stack))
            text_of[len(stack)] = token
            stack.append(("".join(words).strip().removesuffix(":").strip("\"' "), []))
            words.clear()
        elif token in ("]", "}"):
            end_bracket()
        elif token == ",":
            end_item()
        else:
            words.append(token)
    while len(stack) > 1:
        end_bracket()
    end_item()
    return stack[0][1][0] if stack[0][1] else ""


def merged(items: list[Any]) -> Any:
    """The keys of several mappings as one; other items as they are."""
    if not items or not all(isinstance(item, dict) for item in items):
        return items
    return {key: value for item in reversed(items) for key, value in item.items()}


def _check_depth(depth: int) -> None:
    if depth > MAX_DEPTH:
        raise ValueError(f"nested deeper than {MAX_DEPTH}")
