"""Run-time check of the shapes in signatures, switched on by `--jaxtyping-packages` in pyproject.toml.

The first calls of each function in each test are checked: all of them would take as long again as the tests.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable
from typing import Any

from beartype import BeartypeConf, beartype
from beartype.roar import BeartypeDecorHintException

CHECKS = 8
"""Checks of a function in a test, two for each call: of what it takes, and with what it returns."""

_check = beartype(conf=BeartypeConf(is_pep484_tower=True))  # an int is a float
_checks: dict[tuple[str, str], int] = {}
_not_checked: list[Callable[..., Any]] = []


def check(function: Callable[..., Any]) -> Callable[..., Any]:
    """Check the tensors that a function takes and returns; mypy checks everything else."""
    annotations = function.__annotations__
    function.__annotations__ = {name: hint for name, hint in annotations.items() if "Tensor" in str(hint)}
    try:
        checked = _check(function)
    except BeartypeDecorHintException:  # a hint that only a type checker can read, such as a protocol
        checked = function
    # As they were, for those who read them.
    function.__annotations__ = checked.__annotations__ = annotations
    key = function.__module__, function.__qualname__

    def counted(*args: Any, **kwargs: Any) -> Any:
        _checks[key] = _checks.get(key, 0) + 1
        if _checks[key] == CHECKS:
            _stop(*key)
        return checked(*args, **kwargs)

    return counted


def start_test() -> None:
    """Check every function again."""
    _checks.clear()
    for function in _not_checked:
        del function.__no_type_check__  # type: ignore[attr-defined]
    _not_checked.clear()


def _stop(module: str, name: str) -> None:
    """Let jaxtyping call a function without checks; one within a function cannot be found, and stays checked."""
    found: Any = sys.modules.get(module)
    for part in name.split("."):
        found = inspect.getattr_static(found, part, None)
    found = found.fget if isinstance(found, property) else getattr(found, "__func__", found)
    function = inspect.unwrap(found) if callable(found) else None
    if inspect.isfunction(function) and (function.__module__, function.__qualname__) == (module, name):
        function.__no_type_check__ = True  # type: ignore[attr-defined]
        _not_checked.append(function)
