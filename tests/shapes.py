"""Run-time check of the shapes in signatures, switched on by `--jaxtyping-packages` in pyproject.toml.

The first calls of each function in each test are checked: all of them would take as long again as the tests.
"""

from __future__ import annotations

import contextlib
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
_with_tensors: set[tuple[str, str]] = set()
_not_checked: list[Callable[..., Any]] = []


def check(function: Callable[..., Any]) -> Callable[..., Any]:
    """Check the tensors that a function takes and returns; mypy checks everything else."""
    key = function.__module__, function.__qualname__
    annotations = function.__annotations__
    of_tensors = {name: hint for name, hint in annotations.items() if "Tensor" in str(hint)}
    if of_tensors:
        _with_tensors.add(key)
    checked = function
    # A function within another one is made again in each call of that.
    if of_tensors and _checks.get(key, 0) < CHECKS:
        function.__annotations__ = of_tensors
        with contextlib.suppress(
            BeartypeDecorHintException
        ):  # only a type checker can read it, such as a protocol
            checked = _check(function)
        # As they were, for those who read them.
        function.__annotations__ = checked.__annotations__ = annotations

    def counted(*args: Any, **kwargs: Any) -> Any:
        _checks[key] = _checks.get(key, 0) + 1
        if _checks[key] >= CHECKS or key not in _with_tensors:
            _stop(sys._getframe(1).f_locals.get("fn"), key)
        return checked(*args, **kwargs)

    return counted


def start_test() -> None:
    """Check every function again."""
    _checks.clear()
    for function in _not_checked:
        del function.__no_type_check__  # type: ignore[attr-defined]
    _not_checked.clear()


def _stop(function: Any, key: tuple[str, str]) -> None:
    """Let jaxtyping call a function without checks: in this test, or in all if it takes and returns no tensors.

    function: the one that jaxtyping calls next
    """
    is_found = inspect.isfunction(function) and (function.__module__, function.__qualname__) == key
    if is_found and "__no_type_check__" not in function.__dict__:
        function.__no_type_check__ = True
        if key in _with_tensors:
            _not_checked.append(function)
