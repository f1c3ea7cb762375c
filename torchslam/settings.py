"""What a configuration is made of: frozen dataclasses that check themselves, read from TOML and written back.

A setting is declared with its type, its default and what it allows; whatever builds a section - a constructor,
`dataclasses.replace`, a TOML file, an override - goes through the same check. An unknown key in a file is an error
that names the nearest known one.
"""

from __future__ import annotations

import difflib
import json
import math
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, ClassVar, TypeVar, get_type_hints

from torchslam.errors import ConfigError

Value = TypeVar("Value", bool, int, float, str)
Section = TypeVar("Section", bound="Settings")


@dataclass(frozen=True)
class Allowed:
    """What a setting may be, beside its type; `str` says it in words.

    low, high: the range of a number, both ends in it
    above:     a lower end that is not in the range
    choices:   of a string; empty for any
    """

    low: float = 0
    high: float = math.inf
    above: float = -math.inf
    choices: tuple[str, ...] = ()

    def __contains__(self, value: object) -> bool:
        if isinstance(value, bool):
            return True
        if isinstance(value, int | float):
            return math.isfinite(value) and self.low <= value <= self.high and value > self.above
        return not self.choices or value in self.choices

    def __str__(self) -> str:
        if self.choices:
            return f"one of {', '.join(self.choices)}"
        start = f"at least {self.low}" if self.above < self.low else f"above {self.above}"
        return f"{start} and {'finite' if self.high == math.inf else f'at most {self.high}'}"


def setting(
    default: Value,
    *,
    low: float = 0,
    high: float = math.inf,
    above: float = -math.inf,
    choices: tuple[str, ...] = (),
    grows: bool = False,
) -> Value:
    """A field of a Settings class with what it allows, as in `Allowed`: without `low`, no negative number.

    grows: whether it is a length in the image, for `enlarged`
    """
    return field(default=default, metadata={"allowed": Allowed(low, high, above, choices), "grows": grows})


@dataclass(frozen=True)
class Settings:
    """Base of the frozen dataclasses of a configuration: bool, int, float and str, and further sections.

    The argument `section` of the class is its place in the configuration, for messages; none for the outermost one.
    Raises ConfigError for a value of the wrong type or not allowed. An integer serves as a float.
    """

    _prefix: ClassVar[str] = ""

    def __init_subclass__(cls, section: str = "", **rest: Any) -> None:
        super().__init_subclass__(**rest)
        cls._prefix = f"{section}." if section else ""

    def __post_init__(self) -> None:
        for name, (kind, allowed) in _declared(type(self)).items():
            value = _checked(self._prefix + name, getattr(self, name), kind, allowed)
            object.__setattr__(self, name, value)


def choices(kind: type[Settings]) -> dict[str, tuple[str, ...]]:
    """The choices of every setting that has some, by its full name."""
    return {name: allowed.choices for name, allowed in _everything(kind) if allowed.choices}


def merged(config: Section, path: Path | str | None = None, overrides: Iterable[str] = ()) -> Section:
    """The configuration changed by a TOML file, changed by overrides of the form `section.key=value`.

    Raises ConfigError for a missing or malformed file, an unknown key, or a value of the wrong type or not allowed.
    """
    if path is not None:
        config = _merge(config, _read_toml(Path(path)), str(path), type(config))
    for override in overrides:
        config = _merge(config, _parse_override(override), f"--set {override}", type(config))
    return config


def enlarged(config: Section, factor: float) -> Section:
    """The configuration with every setting that `grows` multiplied by a factor."""
    changes: dict[str, Any] = {}
    for name in _declared(type(config)):
        value = getattr(config, name)
        if isinstance(value, Settings):
            changes[name] = enlarged(value, factor)
    changes |= {f.name: factor * getattr(config, f.name) for f in fields(config) if f.metadata.get("grows")}
    return replace(config, **changes)


def to_toml(config: Settings) -> str:
    """The configuration as TOML, every value written out."""
    values = {name: getattr(config, name) for name in _declared(type(config))}
    sections = {name: value for name, value in values.items() if isinstance(value, Settings)}
    lines = [f"{name} = {_toml_value(value)}" for name, value in values.items() if name not in sections]
    for name, section in sections.items():
        lines += ["", f"[{name}]", to_toml(section).rstrip("\n")]
    return "\n".join(lines) + "\n"


def _declared(kind: type[Settings]) -> dict[str, tuple[type, Allowed]]:
    """Type and constraint of each setting, by name."""
    hints = get_type_hints(kind)
    return {f.name: (hints[f.name], f.metadata.get("allowed", Allowed())) for f in fields(kind)}


def _everything(kind: type[Settings]) -> Iterator[tuple[str, Allowed]]:
    """Full name and constraint of each setting, and of each section before what is in it."""
    for name, (inner, allowed) in _declared(kind).items():
        yield kind._prefix + name, allowed
        if issubclass(inner, Settings):
            yield from _everything(inner)


def _checked(name: str, value: Any, kind: type, allowed: Allowed) -> Any:
    """The value, an integer as a float where a float is wanted. Raises ConfigError."""
    number = value
    if kind is float and isinstance(value, int | float) and not isinstance(value, bool):
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
    if type(number) is not kind:
        raise ConfigError(f"{name} must be of type {kind.__name__}, not {value!r}")
    if number not in allowed:
        raise ConfigError(f"{name} must be {allowed}, not {value!r}")
    if kind is str and not _is_unicode(value):
        raise ConfigError(f"{name} must be text that can be written as UTF-8, not {value!r}")
    return number


def _is_unicode(text: str) -> bool:
    """Whether there are no lone surrogates, as of a file name in another encoding."""
    return not any("\ud800" <= character <= "\udfff" for character in text)


def _toml_value(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace(
            "\x7f", "\\u007f"
        )  # the one JSON leaves and TOML forbids
    return repr(value)


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ConfigError(f"configuration file {path} does not exist") from None
    except OSError as error:
        raise ConfigError(f"configuration file {path} cannot be read: {error.strerror}") from None
    except ValueError as error:  # of the syntax, the encoding, or a number with thousands of digits
        raise ConfigError(f"{path} is not valid TOML: {error}") from None


def _parse_override(text: str) -> dict[str, Any]:
    key, separator, value = text.partition("=")
    if not separator or not key.strip():
        raise ConfigError(
            f"--set {text!r}: write it as section.key=value, for example --set features.num_keypoints=2000"
        )
    parsed: Any
    try:
        parsed = tomllib.loads(f"value = {value}")["value"]
    except ValueError:
        parsed = value.strip()  # a bare word is a string
    for part in reversed(key.strip().split(".")):
        parsed = {part: parsed}
    return parsed


def _merge(config: Section, values: Mapping[str, Any], source: str, root: type[Settings]) -> Section:
    """The section with some values changed; `root`, the outermost one, is for suggestions."""
    changes: dict[str, Any] = {}
    for key, value in values.items():
        name = config._prefix + key
        if key not in _declared(type(config)):
            raise ConfigError(f"{source}: unknown key {name!r}{_suggestion(name, root)}")
        current = getattr(config, key)
        if isinstance(current, Settings):
            if not isinstance(value, Mapping):
                raise ConfigError(f"{source}: {name} is a section, write {name}.key = value")
            value = _merge(current, value, source, root)
        changes[key] = value
    try:
        return replace(config, **changes)
    except ConfigError as error:
        raise ConfigError(f"{source}: {error}") from None


def _suggestion(name: str, root: type[Settings]) -> str:
    known = [known for known, _ in _everything(root)]
    nearest = (
        difflib.get_close_matches(name, known, n=1, cutoff=0.5)
        or [k for k in known if k.endswith("." + name)][:1]
    )
    return f"; did you mean {nearest[0]!r}?" if nearest else f"; known are {', '.join(known)}"
