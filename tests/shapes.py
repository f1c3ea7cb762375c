"""Run-time check of the shapes in signatures, switched on by `--jaxtyping-packages` in pyproject.toml."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from beartype import BeartypeConf, beartype
from beartype.roar import BeartypeDecorHintException

# Hints that only a type checker can read, such as protocols, are left to mypy.
_check = beartype(conf=BeartypeConf(is_pep484_tower=True))  # an int is a float


def check(function: Callable[..., Any]) -> Callable[..., Any]:
    """Check the arguments and the result of a function against its annotations, where they can be checked."""
    try:
        return _check(function)
    except BeartypeDecorHintException:
        return function
