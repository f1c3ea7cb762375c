"""Equality and hash of dataclasses with tensors."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from torch import Tensor


class ByValue:
    """Base of dataclasses with `eq=False`: equal are objects of one class whose fields are equal, and so is their hash.

    Tensors are equal by shape and numbers, whatever their dtype and device; NaN equals nothing, as everywhere.
    """

    def __eq__(self, other: object) -> bool:
        return self is other or (type(self) is type(other) and _of_fields(self) == _of_fields(other))

    def __hash__(self) -> int:
        return hash((type(self), _of_fields(self)))


def _of_fields(value: Any) -> tuple[Any, ...]:
    return tuple(_comparable(getattr(value, field.name)) for field in fields(value) if field.compare)


def _comparable(value: Any) -> Any:
    if isinstance(value, Tensor):
        return tuple(value.shape), tuple(value.detach().flatten().tolist())
    return tuple(map(_comparable, value)) if isinstance(value, list | tuple) else value
