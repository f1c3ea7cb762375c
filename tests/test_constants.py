"""Numbers that decide something have a name, and a word about what they are."""

from __future__ import annotations

import ast
import io
import re
import tokenize
from pathlib import Path

import torchslam

PACKAGE = Path(torchslam.__file__).parent
NAME = re.compile("_?[A-Z][A-Z0-9_]*")


def unexplained(source: str) -> list[str]:
    """The module constants with a number in their value that have neither a comment nor a docstring.

    A comment stands in a line of the constant or in the one above, a docstring in the one below.
    """
    lines, body = source.splitlines(), ast.parse(source).body
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    commented = {token.start[0] for token in tokens if token.type == tokenize.COMMENT}
    found = []
    for statement, below in zip(body, [*body[1:], None], strict=True):
        if not isinstance(statement, ast.Assign | ast.AnnAssign) or statement.value is None:
            continue
        targets = statement.targets if isinstance(statement, ast.Assign) else [statement.target]
        names = [node.id for target in targets for node in ast.walk(target) if isinstance(node, ast.Name)]
        if not names or not all(map(NAME.fullmatch, names)) or not _has_number(statement.value):
            continue
        first, last = statement.lineno, statement.end_lineno or statement.lineno
        has_comment = not commented.isdisjoint(range(first, last + 1))
        has_comment |= first - 1 in commented and lines[first - 2].startswith("#")
        if not has_comment and not _is_docstring(below):
            found.append(f"{first}: {', '.join(names)}")
    return found


def _has_number(value: ast.expr) -> bool:
    constants = [node.value for node in ast.walk(value) if isinstance(node, ast.Constant)]
    return any(type(constant) in (int, float) for constant in constants)


def _is_docstring(statement: ast.stmt | None) -> bool:
    return (
        isinstance(statement, ast.Expr)
        and isinstance(statement.value, ast.Constant)
        and isinstance(statement.value.value, str)
    )


def test_every_number_with_a_name_has_a_reason() -> None:
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        name = path.relative_to(PACKAGE)
        if bare := unexplained(path.read_text(encoding="utf-8")):
            found[str(name)] = bare
    assert not found
