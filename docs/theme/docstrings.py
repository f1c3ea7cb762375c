"""Docstrings of this project as Markdown: a Griffe extension for mkdocstrings.

The sources list fields as `name:   what it is`, with indented continuations, and write formulas and shapes as they are.
Here fields become sections of parameters and attributes, with their types, indented lines become code, names in
backticks become links, and what Markdown would take for markup is escaped.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import griffe

NAMES = r"\*{0,2}[A-Za-z_]\w*(?:, \*{0,2}[A-Za-z_]\w*)*"
FIELD = re.compile(rf"^({NAMES}):\s+(\S.*)$")
QUOTED = re.compile(r'^("[^"]*"(?:, "[^"]*")*):\s+(\S.*)$')
CODE_SPAN = re.compile(r"(`[^`]+`)")
IDENTIFIER = re.compile(r"^`([A-Za-z_][\w.]*)(\(\))?`$")
PRONOUNS = {"Returns", "Raises", "Source", "Sources"}
"""Words that begin a sentence with a colon, and are no field."""


@dataclass
class Block:
    """Lines of a docstring that belong together: prose, code, or fields as pairs of names and text.

    joined: whether no empty line parts it from the block before
    """

    kind: str
    joined: bool = False
    lines: list[str] = field(default_factory=list)
    pairs: list[tuple[str, str]] = field(default_factory=list)


class HouseDocstrings(griffe.Extension):
    """Rewrites every docstring once the whole package is known, so that names can be resolved."""

    def __init__(self) -> None:
        self._index: dict[str, str] = {}

    def on_package(self, *, pkg: griffe.Module, **kwargs: Any) -> None:
        self._index = {obj.name: obj.path for obj in _public(pkg)}
        for obj in list(_everything(pkg)):
            for parameter in getattr(obj, "parameters", ()):
                if str(parameter.default).startswith("(lambda"):  # the factory of a field
                    parameter.default = "..."
            if obj.docstring is not None:
                obj.docstring.value = self._markdown(obj, obj.docstring.value)

    def _markdown(self, obj: griffe.Object, text: str) -> str:
        parameters, attributes = _parameters(obj), _attributes(obj)
        parts = []
        for block in _blocks(text, parameters | attributes):
            if block.kind == "code":
                parts.append("```python\n" + "\n".join(_dedented(block.lines)) + "\n```")
            elif block.kind == "prose":
                parts.append(_escaped(" ".join(block.lines), self._linker(obj, parameters)))
            elif block.kind == "table":
                parts.append("\n".join(block.lines))
            elif block.kind == "list":
                parts.append("\n".join(_escaped(line, self._linker(obj, parameters)) for line in block.lines))
            else:
                parts.append(self._fields(obj, block.pairs, parameters, attributes))
        return "\n\n".join(parts)

    def _fields(
        self, obj: griffe.Object, pairs: list[tuple[str, str]], parameters: set[str], attributes: set[str]
    ) -> str:
        """Sections of parameters and attributes as the Google style has them; a list of what is neither."""
        link = self._linker(obj, parameters)
        sections: dict[str, list[str]] = {"Args": [], "Attributes": [], "": []}
        for names, text in pairs:
            described = _escaped(text.removesuffix(";"), link)
            for name in names.split(", ") if not names.startswith('"') else [names]:
                bare = name.lstrip("*")
                title = "Args" if bare in parameters else "Attributes" if bare in attributes else ""
                sections[title].append(f"    {name}: {described}" if title else f"- `{name}`: {described}")
        titled = [
            f"{title}:\n" * bool(title) + "\n".join(lines) for title, lines in sections.items() if lines
        ]
        return "\n\n".join(titled)

    def _linker(self, obj: griffe.Object, own: set[str]) -> Any:
        def link(span: str) -> str:
            found = IDENTIFIER.match(span)
            if found is None or found[1] in own:
                return span
            path = self._path(obj, found[1])
            return (
                span
                if path is None
                else f'<autoref optional identifier="{path}"><code>{span[1:-1]}</code></autoref>'
            )

        return link

    def _path(self, obj: griffe.Object, name: str) -> str | None:
        """Where a name of a docstring leads to, as far as it can be told."""
        first, *rest = name.split(".")
        try:
            path = obj.resolve(first)
        except (griffe.NameResolutionError, griffe.BuiltinModuleError):
            path = self._index.get(first)
        if path is None or not path.startswith("torchslam"):
            return None
        return ".".join([self._index.get(path.rsplit(".", 1)[-1], path), *rest])


def _public(pkg: griffe.Module) -> Iterator[griffe.Object]:
    for obj in _everything(pkg):
        is_global = (obj.is_class or obj.is_function) and obj.parent is not None and obj.parent.is_module
        if is_global and not obj.name.startswith("_"):
            yield obj


def _everything(obj: griffe.Object) -> Iterator[griffe.Object]:
    yield obj
    for member in obj.members.values():
        if not member.is_alias:
            yield from _everything(member)  # type: ignore[arg-type]


def _parameters(obj: griffe.Object) -> set[str]:
    if obj.is_class:
        if "dataclass" in obj.labels:
            return set()  # its fields are attributes
        constructor = obj.members.get("__init__")
        return _parameters(constructor) if constructor is not None and constructor.is_function else set()
    if not obj.is_function:
        return set()
    return {parameter.name for parameter in obj.parameters} - {"self", "cls"}  # type: ignore[union-attr]


def _attributes(obj: griffe.Object) -> set[str]:
    if not obj.is_class:
        return set()
    return {name for name, member in obj.members.items() if not member.is_alias and member.is_attribute}


def _blocks(text: str, known: set[str]) -> list[Block]:
    """The paragraphs, fields and pieces of code of a docstring."""
    blocks: list[Block] = []
    blank = True
    for line in text.splitlines():
        last = blocks[-1] if blocks else Block("")
        if not line.strip():
            blank = True
            if last.kind == "code":
                last.lines.append("")
            continue
        indented = line.startswith("    ") or (
            line.startswith(" ") and last.kind in ("fields", "code", "list")
        )
        pairs = [] if indented else _pairs(line.strip(), known, last.kind == "fields" and not blank)
        if indented and last.kind == "fields" and not blank:
            names, so_far = last.pairs.pop()
            last.pairs += _split(names, f"{so_far} {line.strip()}", known)
        elif indented and (last.kind == "code" or blank):
            _open(blocks, "code", last.kind == "code").lines.append(line)
        elif pairs:
            _open(blocks, "fields", last.kind == "fields").pairs.extend(pairs)
        elif line.startswith("|"):
            _open(blocks, "table", last.kind == "table").lines.append(line)
        elif line.startswith("- "):
            _open(blocks, "list", last.kind == "list").lines.append(line)
        elif last.kind == "list" and indented:
            last.lines[-1] += " " + line.strip()
        else:
            _open(blocks, "prose", last.kind == "prose" and not blank, not blank).lines.append(line.strip())
        blank = False
    return _parted(blocks, known)


def _parted(blocks: list[Block], known: set[str]) -> list[Block]:
    """Fields end with their first sentence where the line goes on with others, such as what is returned."""
    parted: list[Block] = []
    for block in blocks:
        last = parted[-1] if parted else Block("")
        goes_on = block.kind == "prose" and block.joined and last.kind == "fields"
        if goes_on and not block.lines[0][0].isupper():
            names, text = last.pairs[-1]
            whole = " ".join([text, *block.lines])
            end = re.search(r"[.:](?= [A-Z])", whole)
            rest = "" if end is None else whole[end.end() :].strip()
            of_all = [pair for pair in last.pairs if pair[1] != text]
            last.pairs = [*of_all, (names, whole[: end.start()] if end and rest else whole)]
            last.pairs[-1:] = _split(*last.pairs[-1], known | set(names.split(", ")))
            block.lines = [rest]
            if not rest:
                continue
        elif block.kind == last.kind == "prose" and block.joined:
            last.lines += block.lines
            continue
        parted.append(block)
        if block.kind == "fields":
            names, text = block.pairs[-1]
            field_text, returned, rest = text.partition(". Returns ")
            if returned:
                block.pairs[-1] = (names, field_text)
                parted.append(Block("prose", True, ["Returns " + rest]))
    return parted


def _open(blocks: list[Block], kind: str, goes_on: bool, joined: bool = False) -> Block:
    if not goes_on:
        blocks.append(Block(kind, joined))
    return blocks[-1]


def _pairs(line: str, known: set[str], among_fields: bool) -> list[tuple[str, str]]:
    """The fields of a line: none where it is prose."""
    found = QUOTED.match(line)
    if found:
        return [(found[1], found[2])]
    found = FIELD.match(line)
    if found is None or found[1] in PRONOUNS:
        return []
    names = {name.lstrip("*") for name in found[1].split(", ")}
    aligned = re.match(rf"^{NAMES}:\s\s+", line) is not None
    if not (names <= known or aligned or among_fields):
        return []
    return _split(found[1], found[2], known | names)


def _split(names: str, text: str, known: set[str]) -> list[tuple[str, str]]:
    """Fields that share a line: `a: (3,); b, c: (4, 4)`, or `a: (3,), b: (4, 4)`."""
    first, *rest = re.split(rf"(; |, (?={NAMES}: ))", text)
    pairs = [(names, first)]
    for mark, part in zip(rest[::2], rest[1::2], strict=True):
        found = FIELD.match(part)
        if found is not None and {name.lstrip("*") for name in found[1].split(", ")} <= known:
            pairs.append((found[1], found[2]))
        else:
            pairs[-1] = (pairs[-1][0], pairs[-1][1] + mark + part)
    return pairs


def _dedented(lines: list[str]) -> list[str]:
    margin = min(len(line) - len(line.lstrip()) for line in lines if line.strip())
    text = [line[margin:] for line in lines]
    while not text[-1]:
        text.pop()
    return text


def _escaped(text: str, link: Any) -> str:
    """Prose with links in place of names, and without anything that Markdown would take for markup."""
    parts = []
    for part in CODE_SPAN.split(text):
        if CODE_SPAN.fullmatch(part):
            parts.append(link(part))
            continue
        part = re.sub(r"([\\*\[\]])", r"\\\1", part)
        part = part.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
        parts.append(re.sub(r"(?<!\w)_|_(?!\w)", r"\\_", part))
    return "".join(parts)
