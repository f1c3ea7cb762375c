"""As much of YAML as calibration files use: `key: value`, lists in brackets or of dashes, OpenCV's matrices."""

from __future__ import annotations

import re

from torchslam.data.formats.text_file import parse_floats
from torchslam.errors import CalibrationError


def yaml_value(text: str, key: str) -> str | None:
    """What stands behind the first `key:` as words; of a matrix its `data`; None where the key is missing."""
    found = re.search(rf"^([ \t]*(?:- )?){re.escape(key)}[ \t]*:", text, re.MULTILINE)
    if found is None:
        return None
    rest = text[found.end() :]
    line, _, below = rest.partition("\n")
    line = re.split(r"(?:^|\s)#", line, maxsplit=1)[0].strip()
    if line.startswith("["):
        return _bracketed(rest.lstrip(" \t"))
    if line and not line.startswith("!!"):
        return line.strip("\"'")
    block = _block(below, len(found[1]))
    data = yaml_value(block, "data")
    return (
        " ".join(re.findall(r"^[ \t]*-[ \t]*([^\s:]+)[ \t]*$", block, re.MULTILINE)) if data is None else data
    )


def yaml_numbers(text: str, keys: tuple[str, ...], where: str) -> list[float] | None:
    """The numbers of the first of the keys that is there. Raises CalibrationError at `where` for anything else."""
    for key in keys:
        value = yaml_value(text, key)
        if value is not None:
            return parse_floats(value, f"{where}: {key}", CalibrationError)
    return None


def _bracketed(text: str) -> str:
    """The words of a list in brackets, which may hold lists, over as many lines as it takes."""
    depth, words = 0, []
    for part in re.findall(r"\[|\]|#[^\n]*|[^\[\]#]+", text):
        depth += (part == "[") - (part == "]")
        if depth == 0:
            break
        if part not in "[]" and not part.startswith("#"):
            words.append(part)
    return " ".join(words)


def _block(text: str, indent: int) -> str:
    """The lines up to one that is not further in than `indent`; dashes may stand where their key does."""
    lines = []
    for line in text.splitlines():
        inner = len(line) - len(line.lstrip())
        if line.strip() and (inner < indent or (inner == indent and not line.lstrip().startswith("-"))):
            break
        lines.append(line)
    return "\n".join(lines)
