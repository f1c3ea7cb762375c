"""Run-time check of the shapes in signatures, switched on by `--jaxtyping-packages` in pyproject.toml."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from beartype import BeartypeConf, beartype
from beartype.roar import BeartypeDecorHintException

_check = beartype(conf=BeartypeConf(is_pep484_tower=True))  # an int is a float


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
    return checked
