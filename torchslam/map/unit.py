"""How well the unit of a map is known: the record that a map in meters carries with it, and into its file."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any, Self, get_args, get_origin, get_type_hints

MAX_TEXT = 1 << 12
"""Largest number of characters of a text in the record, and of entries in a list of it."""


def _is(value: object, kind: Any) -> bool:
    """Whether a value is of an annotated type: numbers are finite, texts and tuples, which may be lists, bounded."""
    if get_origin(kind) is tuple:
        if not isinstance(value, list | tuple) or len(value) > MAX_TEXT:
            return False
        kinds = get_args(kind)
        kinds = kinds[:1] * len(value) if kinds[-1] is Ellipsis else kinds
        return len(value) == len(kinds) and all(map(_is, value, kinds))
    if get_args(kind):  # a union
        return any(_is(value, each) for each in get_args(kind))
    if kind in (int, float):
        return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    return isinstance(value, kind) and (kind is not str or len(value) <= MAX_TEXT)


def _check(record: UnitSource | MetricUnit, *positive: str) -> None:
    """Raise ValueError for a field of another type, or that must be positive and is not."""
    for name, kind in get_type_hints(type(record)).items():
        value = getattr(record, name)
        if not _is(value, kind) or (name in positive and value <= 0):
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

    def __post_init__(self) -> None:
        _check(self, "meters_per_unit", "relative_std")
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

    def __post_init__(self) -> None:
        _check(self, "relative_std")
        if [len(row) for row in self.S_mw] != [4, 4, 4, 4]:
            raise ValueError("S_mw of the unit is no matrix of 4 x 4")

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
        sources = [vars(source).copy() for source in self.sources]
        about = {"sources": sources, "sentence": self.sentence, "remarks": list(self.remarks)}
        return vars(self) | about

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
