"""YAML, XML and JSON files of keys and numbers, as nested dicts and lists of text, and look-ups in them.

OpenCV's dialect of YAML (`%YAML:1.0`, `!!opencv-matrix`, `key:value`) is read as well; tags are skipped.
"""

from __future__ import annotations

import contextlib
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from torchslam.data.text_file import parse_floats, read_text
from torchslam.errors import CalibrationError
from torchslam.utils.files import JSON_BYTES, parse_json

Tree = dict[str, Any]
"""Keys to text, lists or trees."""
MAX_BYTES = 1 << 18  # largest file that is read, but of JSON; those of calibration programs have kilobytes
MAX_DEPTH = 20  # levels of nesting that are read, which bounds the recursion
MAX_YAML = 1 << 17
"""Characters of YAML, which takes seconds; calibrations with all their image points are smaller."""
MAX_ALIASES = 20  # references to other parts of a file; those of references take exponential time
NOTHING = ("", "none", "null", "~")


def read_tree(path: Path) -> Tree | None:
    """Read a file of keys, by its first character or its suffix; None for a text that is none of these.

    Raises CalibrationError naming the file.
    """
    suffix = path.suffix.lower()  # a transforms.json has all frames in it
    text = read_text(path, CalibrationError, JSON_BYTES if suffix == ".json" else MAX_BYTES)
    start = text.lstrip()
    try:
        if start.startswith("{"):
            tree = parse_json(text)
        elif start.startswith("<"):
            if "<!ENTITY" in text:
                raise ValueError("entities are not read")
            tree = _from_element(ET.fromstring(text), 0)
        elif suffix in (".yaml", ".yml") or start.startswith("%YAML"):
            tree = parse_yaml(text)
        else:
            return None
    except ET.ParseError as cause:
        raise CalibrationError(f"{path}: not valid XML: {cause}") from cause
    except ValueError as cause:
        raise CalibrationError(f"{path}: {'not valid JSON: ' * start.startswith('{')}{cause}") from cause
    return tree if isinstance(tree, dict) else {}


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
    # OpenCV writes keys without a space before the value.
    spaced = re.sub(r"(?m)^( *(?:- +)?[A-Za-z_][\w.]*):(?=[^\s/:])", r"\1: ", "\n".join(lines))
    try:
        return Loader(spaced).get_data() or {}
    except yaml.YAMLError as cause:
        mark = getattr(cause, "problem_mark", None)
        where = "" if mark is None else f"line {mark.line + 1}: "
        raise ValueError(f"not valid YAML: {where}{getattr(cause, 'problem', None) or cause}") from cause


def _check_depth(depth: int) -> None:
    if depth > MAX_DEPTH:
        raise ValueError(f"nested deeper than {MAX_DEPTH}")


def mappings(tree: Tree, above: tuple[Tree, ...] = ()) -> Iterator[tuple[Tree, ...]]:
    """Yield every mapping, with those that it is in, in the order of the file."""
    chain = (*above, tree)
    yield chain
    for value in tree.values():
        if isinstance(value, dict) and len(chain) < MAX_DEPTH:
            yield from mappings(value, chain)


def read_keys(path: Path) -> Iterator[Keys]:
    """Yield the keys of each mapping in a file, from the outermost one inward. Raises CalibrationError without any."""
    tree = read_tree(path)
    if not tree:
        raise CalibrationError(f"{path}: no keys in it; a YAML, XML or JSON file is needed")
    for chain in mappings(tree):
        yield Keys(chain[-1], str(path))


class Keys:
    """The keys of a mapping, which are found in any case and with any punctuation.

    Methods take keys in lower case, without anything but letters and digits, of which the first one that is there
    counts. `source` names the file in messages.
    """

    def __init__(self, tree: Tree, source: str) -> None:
        self._values: dict[str, tuple[str, Any]] = {}
        for key, value in tree.items():
            self._values.setdefault(normal(key), (key, value))
        self.source = source
        self._used: set[str] = set()

    def __contains__(self, keys: tuple[str, ...]) -> bool:
        return any(key in self._values for key in keys)

    def with_values(self, values: Tree) -> Keys:
        """The keys with other values; what either was asked for is used in both."""
        others = {
            name: value for key, (name, value) in self._values.items() if key not in set(map(normal, values))
        }
        keys = Keys(values | others, self.source)
        keys._used = self._used
        return keys

    def value(self, *keys: str) -> Any:
        """The value of a key; None without it."""
        return self._found(keys)[1]

    def text(self, key: str) -> str:
        """The text of a key in lower case; empty without it, and for anything else."""
        value = self.value(key)
        return value.strip().lower() if isinstance(value, str) else ""

    def flag(self, key: str) -> bool:
        """Return whether the value of a key is true or a number other than 0."""
        word = str(self.value(key)).strip().lower()
        return word not in (*NOTHING, "0", "0.0", "0.", "false", "no", "off")

    def inner(self, *keys: str) -> Keys | None:
        """The keys of a mapping or a list of mappings; None for anything else, also for a matrix with its `data`."""
        name, value = self._found(keys)
        if isinstance(value, list) and value and all(isinstance(item, dict) for item in value):
            value = {key: inner for item in reversed(value) for key, inner in item.items()}
        is_mapping = isinstance(value, dict) and "data" not in value
        return Keys(value, f"{self.source}: {name}") if is_mapping else None

    def numbers(self, *keys: str) -> list[float]:
        """The numbers of a key; empty without it. Raises CalibrationError for anything else."""
        name, value = self._found(keys)
        return _numbers(value, f"{self.source}: {name}")

    def number(self, *keys: str) -> float | None:
        """The first number of a key, or of a list. Raises CalibrationError for anything else, such as `517,3`."""
        name, value = self._found(keys)
        numbers = _numbers(value, f"{self.source}: {name}")
        if isinstance(value, str) and len(numbers) > 1:
            raise CalibrationError(
                f"{self.source}: {name}: `{value[:40]}` is not one number; write a decimal point"
            )
        return next(iter(numbers), None)

    def matrices(self, count: int) -> list[str]:
        """The keys, as they are written, of this many numbers."""
        names = []
        for key, (name, _) in list(self._values.items()):
            with contextlib.suppress(CalibrationError):
                names += [name] * (len(self.numbers(key)) == count)
        return names

    def unused(self, pattern: re.Pattern[str]) -> str | None:
        """The first key, as it is written, that fits a pattern, was not asked for and is neither empty nor zeros."""
        for key, (name, value) in self._values.items():
            if key not in self._used and pattern.search(key):
                with contextlib.suppress(CalibrationError):
                    if not any(_numbers(value, "")):
                        continue
                return name
        return None

    def _found(self, keys: tuple[str, ...]) -> tuple[str, Any]:
        """The first of the keys that is there, as it is written, with its value."""
        key = next((key for key in keys if key in self._values), None)
        if key is None:
            return "", None
        self._used.add(key)
        return self._values[key]


def normal(key: str) -> str:
    """Return a key in lower case, without anything but letters and digits."""
    return re.sub(r"[^a-z0-9]", "", str(key).lower())


def _numbers(value: Any, where: str, depth: int = 0) -> list[float]:
    """The numbers of text, of lists in lists, or of a matrix's `data`."""
    if isinstance(value, dict) and "data" in value:
        value = value["data"]
    if isinstance(value, list) and depth < MAX_DEPTH:
        return [number for item in value for number in _numbers(item, where, depth + 1)]
    if value is None or (isinstance(value, str) and value.lower() in NOTHING):
        return []
    if isinstance(value, bool | dict | list):
        raise CalibrationError(f"{where}: expected numbers, got {str(value)[:40]}")
    if isinstance(value, int | float):
        if not abs(value) < 1e12:  # JSON numbers may have any number of digits; NaN
            raise CalibrationError(f"{where}: {str(value)[:40]} is not finite")
        return [float(value)]
    return parse_floats(value, where, CalibrationError)
