"""How well the unit of a map is known: the record that a map in meters carries with it, and into its file."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any, ClassVar, Self

MAX_TEXT = 1 << 12
"""Largest number of characters of a text in the record, and of entries in a list of it."""


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _is_positive(value: object) -> bool:
    return _is_number(value) and float(value) > 0  # type: ignore[arg-type]


def _is_text(value: object) -> bool:
    return isinstance(value, str) and len(value) <= MAX_TEXT


def _are_texts(value: object) -> bool:
    return isinstance(value, list | tuple) and len(value) <= MAX_TEXT and all(map(_is_text, value))


def _are_numbers(value: object, count: int) -> bool:
    return isinstance(value, list | tuple) and len(value) == count and all(map(_is_number, value))


def _check(record: object, checks: dict[str, Any]) -> None:
    """Raise ValueError for a field of another kind."""
    for name, is_right in checks.items():
        value = getattr(record, name)
        if not is_right(value):
            raise ValueError(f"{name} of the unit is {repr(value)[:100]}")


@dataclass(frozen=True)
class UnitSource:
    """One measurement of the unit.

    Attributes:
        source: what measured, in words.
        meters_per_unit: length of a map unit, meters.
        relative_std: its relative standard error.
        count, unit: how many of what, such as 12 "markers".
        apart: relative standard deviation of the single measurements; None where unknown.
        rejected: one line for each single one that contradicts the others.
        notes: other remarks for the user, one line each.
    """

    source: str
    meters_per_unit: float
    relative_std: float
    count: int
    unit: str
    apart: float | None
    rejected: tuple[str, ...]
    notes: tuple[str, ...] = ()

    _CHECKS: ClassVar[dict[str, Any]] = {
        "source": _is_text,
        "meters_per_unit": _is_positive,
        "relative_std": _is_positive,
        "count": _is_number,
        "unit": _is_text,
        "apart": lambda value: value is None or _is_number(value),
        "rejected": _are_texts,
        "notes": _are_texts,
    }

    def __post_init__(self) -> None:
        _check(self, self._CHECKS)
        for name in ("rejected", "notes"):
            object.__setattr__(self, name, tuple(getattr(self, name)))


@dataclass(frozen=True)
class MetricUnit:
    """A map whose unit is a meter.

    Attributes:
        relative_std: relative standard error of all lengths.
        sources: the measurements, which are in the unit that the map had before.
        contradictions: one line for each two measurements that differ by more than their errors allow.
        S_mw: rows of the (4, 4) similarity from the world before to that of the map.
        up_std: standard error of the vertical, radians, where z of the world is up; None: the vertical is unknown.
        origin: latitude and longitude in degrees and altitude in meters (WGS84) of the world's origin, whose x is
            east and y is north; None: it is nowhere on earth.
    """

    relative_std: float
    sources: tuple[UnitSource, ...]
    contradictions: tuple[str, ...]
    S_mw: tuple[tuple[float, ...], ...]
    up_std: float | None = None
    origin: tuple[float, float, float] | None = None

    _CHECKS: ClassVar[dict[str, Any]] = {
        "relative_std": _is_positive,
        "sources": lambda value: len(value) <= MAX_TEXT,
        "contradictions": _are_texts,
        "S_mw": lambda value: len(value) == 4 and all(_are_numbers(row, 4) for row in value),
        "up_std": lambda value: value is None or _is_number(value),
        "origin": lambda value: value is None or _are_numbers(value, 3),
    }

    def __post_init__(self) -> None:
        _check(self, self._CHECKS)

    @property
    def is_level(self) -> bool:
        """Whether z of the world is known to be up."""
        return self.up_std is not None

    @property
    def sentence(self) -> str:
        """The unit in a line for the user."""
        counted = [
            f"{source.count} {source.unit}" + ("" if source.apart is None else f", {source.apart:.1%} apart")
            for source in self.sources
        ]
        digits = max(3, 1 - math.floor(math.log10(self.relative_std)))
        return f"scale {1:.{digits}f} ± {self.relative_std:.{digits}f} ({'; '.join(counted)})"

    @property
    def remarks(self) -> tuple[str, ...]:
        """What the user must know beyond the sentence: contradictions, and single measurements that were rejected."""
        return (
            *self.contradictions,
            *(line for source in self.sources for line in (*source.rejected, *source.notes)),
        )

    def as_dict(self) -> dict[str, Any]:
        """The record for JSON."""
        own = {each.name: getattr(self, each.name) for each in fields(self)}
        return own | {
            "sources": [
                {each.name: getattr(source, each.name) for each in fields(source)} for source in self.sources
            ],
            "sentence": self.sentence,
            "remarks": list(self.remarks),
        }

    @classmethod
    def from_dict(cls, record: dict[str, Any]) -> Self:
        """What `as_dict` returned, also by way of JSON. Raises ValueError, TypeError or KeyError for another."""
        own = {each.name: record[each.name] for each in fields(cls)}
        own["contradictions"] = tuple(own["contradictions"])
        own["origin"] = None if own["origin"] is None else tuple(own["origin"])
        own["S_mw"] = tuple(map(tuple, own["S_mw"]))
        own["sources"] = tuple(
            UnitSource(**{each.name: source[each.name] for each in fields(UnitSource)})
            for source in own["sources"]
        )
        return cls(**own)
