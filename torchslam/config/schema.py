"""Self-validating configuration dataclasses, read from and written to TOML.

A setting declares its type, default and allowed values; the docstring of its class describes it. Constructors,
`dataclasses.replace`, TOML files and overrides all run the same validation. An unknown key is an error that suggests
the most similar known one.
"""

from __future__ import annotations

import difflib
import inspect
import json
import math
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, ClassVar, TypeVar, get_type_hints

from torchslam.errors import ConfigError
from torchslam.plugins import ALLOWED, is_code_of_others, is_known, registered
from torchslam.utils.console import is_unicode
from torchslam.utils.files import read_text

Value = TypeVar("Value", bool, int, float, str)
Section = TypeVar("Section", bound="Settings")
MAX_BYTES = 1 << 16
"""Size limit of a configuration file; all settings with their descriptions take a quarter of it."""
SHOWN = 200
"""Maximum number of characters of a value in a message."""
MAX_LINE = 1 << 12
"""Maximum line length: the time to parse a dotted key grows with the square of its parts."""


@dataclass(frozen=True)
class Allowed:
    """Allowed values of a setting; `str` describes them.

    Attributes:
        low, high: inclusive range of a number.
        above: exclusive lower bound of a number.
        choices: allowed strings; empty for any.
        also: special value outside of the range.
        group: entry-point group whose names are allowed as well, like PACKAGE:NAME.
    """

    low: float = 0
    high: float = math.inf
    above: float = -math.inf
    choices: tuple[str, ...] = ()
    also: float | None = None
    group: str = ""

    def __contains__(self, value: object) -> bool:
        if isinstance(value, bool):
            return True
        if isinstance(value, int | float):
            is_finite = isinstance(value, int) or math.isfinite(value)  # isfinite makes floats of integers
            is_inside = is_finite and self.low <= value <= self.high and value > self.above
            return is_inside or value == self.also
        if not self.choices or value in self.choices:
            return True
        return bool(self.group) and isinstance(value, str) and is_known(self.group, value)

    def __str__(self) -> str:
        if self.choices:
            known = [*self.choices, *(sorted(registered(self.group)) if self.group else ())]
            return f"one of {', '.join(known)}{', or PACKAGE:NAME' if self.group else ''}"
        start = f"at least {self.low}" if self.above < self.low else f"above {self.above}"
        also = "" if self.also is None else f"{self.also} or "
        return f"{also}{start} and {'finite' if self.high == math.inf else f'at most {self.high}'}"


def setting(default: Value, **allowed: Any) -> Value:
    """Declare a field of a Settings class with the attributes of `Allowed`; numbers are non-negative without `low`."""
    return field(default=default, metadata={"allowed": Allowed(**allowed)})


@dataclass(frozen=True)
class Settings:
    """Base class of configuration dataclasses with fields of type bool, int, float, str or Settings.

    The class argument `section` is its name in the configuration, for messages. Raises ConfigError for a value of the
    wrong type or not allowed. Integers are accepted as floats.
    """

    _prefix: ClassVar[str] = ""

    def __init_subclass__(cls, section: str = "", **rest: Any) -> None:
        super().__init_subclass__(**rest)
        cls._prefix = f"{section}." if section else ""

    def __post_init__(self) -> None:
        for name, (kind, allowed) in _declared(type(self)).items():
            value = _checked(self._prefix + name, getattr(self, name), kind, allowed)
            object.__setattr__(self, name, value)


def descriptions(kind: type[Settings]) -> dict[str, str]:
    """Return the description of each setting of a section by name, from the docstring of its class."""
    _, _, listed = inspect.cleandoc(kind.__doc__ or "").partition("Attributes:\n")
    found = re.findall(r"^    (\w+): (.*(?:\n     .*)*)", listed, re.MULTILINE)
    return {name: re.sub(r"\n +", " ", words) for name, words in found}


def choices(kind: type[Settings]) -> dict[str, tuple[str, ...]]:
    """Return the allowed strings of every setting that has a fixed set of them, by full name."""
    return {name: allowed.choices for name, allowed in _everything(kind) if allowed.choices}


def merge_settings(config: Section, path: Path | str | None = None, overrides: Iterable[str] = ()) -> Section:
    """Return the configuration changed by a TOML file, then by overrides of the form `section.key=value`.

    A file may not name a plugin as PACKAGE:NAME, unless an override names that setting as well: see `plugins`.

    Raises:
        ConfigError: for a missing or malformed file, an unknown key, a value that is not allowed, or code to import.
    """
    changes = [(_parse_override(override), f"--set {_short(override)}") for override in overrides]
    if path is not None:
        values = _read_toml(Path(path))
        config = _merge(config, values, str(path), type(config))
        _refuse_code(type(config), values, str(path), [change for change, _ in changes])
    for change, source in changes:
        config = _merge(config, change, source, type(config))
    return config


def check_override_in_file(kind: type[Settings], override: str, where: str) -> None:
    """Check that `section.key=value`, found in a file, names no code to import. Raises ConfigError.

    Whether it is a valid override is not checked.
    """
    try:
        values = _parse_override(override)
    except ConfigError:
        return
    _refuse_code(kind, values, where)


def _refuse_code(
    kind: type[Settings], values: Mapping[str, Any], where: str, changes: Iterable[Mapping[str, Any]] = ()
) -> None:
    """Raise ConfigError for a value that imports code, unless one of the later changes replaces it."""
    for name, allowed in _everything(kind):
        value = _value(values, name)
        if not allowed.group or not isinstance(value, str) or not is_code_of_others(allowed.group, value):
            continue
        if all(_value(change, name) is None for change in changes):
            package = value.partition(":")[0]
            raise ConfigError(
                f"{where}: {name} = {_shown(value)} imports code, which a file may not do unasked: "
                f"name it on the command line (--set {name}={_short(value)}), "
                f"or allow the package with {ALLOWED}={_short(package)}"
            )


def _value(values: Mapping[str, Any], name: str) -> Any:
    """Return the value of `section.key` in a table of tables; None without one."""
    found: Any = values
    for part in name.split("."):
        found = found.get(part) if isinstance(found, Mapping) else None
    return found


def to_toml(config: Settings, commented: bool = False) -> str:
    """Return the configuration as TOML with all values; `commented`: with description, range and default of each."""
    lines, inner = list[str](), list[str]()
    about = descriptions(type(config)) if commented else {}
    for declared in fields(config):
        value = getattr(config, declared.name)
        if isinstance(value, Settings):
            words = (type(value).__doc__ or "").strip().splitlines()[:1] if commented else []
            # A dataclass without a docstring has its signature in place of one.
            title = [f"# {line.strip()}" for line in words if "(" not in line]
            inner += ["", *title, f"[{declared.name}]", to_toml(value, commented).rstrip("\n")]
            continue
        if commented:
            allowed = declared.metadata.get("allowed", Allowed())
            is_free = isinstance(value, bool) or (isinstance(value, str) and not allowed.choices)
            limits = "" if is_free else f"{allowed}; "
            lines.append(f"# {about.get(declared.name, '')}")
            lines.append(f"#   {limits}default {_toml_value(declared.default)}")
        lines.append(f"{declared.name} = {_toml_value(value)}")
    return "\n".join(lines + inner) + "\n"


def _declared(kind: type[Settings]) -> dict[str, tuple[type, Allowed]]:
    """Return type and constraint of each setting, by name."""
    hints = get_type_hints(kind)
    return {f.name: (hints[f.name], f.metadata.get("allowed", Allowed())) for f in fields(kind)}


def _everything(kind: type[Settings]) -> Iterator[tuple[str, Allowed]]:
    """Yield full name and constraint of each setting and section, sections before their content."""
    for name, (inner, allowed) in _declared(kind).items():
        yield kind._prefix + name, allowed
        if issubclass(inner, Settings):
            yield from _everything(inner)


def _checked(name: str, value: Any, kind: type, allowed: Allowed) -> Any:
    """Return the value, converted from int to float if required. Raises ConfigError."""
    number = value
    if kind is float and isinstance(value, int | float) and not isinstance(value, bool):
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
    if type(number) is not kind:
        raise ConfigError(f"{name} must be of type {kind.__name__}, not {_shown(value)}")
    if number not in allowed:
        raise ConfigError(f"{name} must be {allowed}, not {_shown(value)}")
    if kind is str and not is_unicode(value):
        raise ConfigError(f"{name} must be text that can be written as UTF-8, not {value!r}")
    return number


def _shown(value: object) -> str:
    try:
        return _short(repr(value))
    except (ValueError, RecursionError):  # an integer of thousands of digits, tables in tables
        return f"this {type(value).__name__}"


def _short(text: str) -> str:
    return text if len(text) <= SHOWN else text[:SHOWN] + "..."


def _toml_value(value: object) -> str:
    # JSON leaves this character as it is, TOML forbids it.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        text = read_text(path, MAX_BYTES, "a configuration")
        _check_lines(text, str(path), "a line of ")
        return tomllib.loads(text)
    except FileNotFoundError:
        raise ConfigError(f"configuration file {path} does not exist") from None
    except OSError as error:
        raise ConfigError(f"configuration file {path} cannot be read: {error.strerror}") from None
    except (ValueError, RecursionError) as error:  # of syntax, encoding, a number with thousands of digits
        raise ConfigError(f"{path} is not valid TOML: {error}") from None


def _check_lines(text: str, where: str, what: str = "") -> None:
    longest = max(map(len, text.splitlines()), default=0)
    if longest > MAX_LINE:
        raise ConfigError(f"{where}: {what}{longest} characters, more than the {MAX_LINE} that are read")


def _parse_override(text: str) -> dict[str, Any]:
    key, separator, value = text.partition("=")
    if not separator or not key.strip():
        raise ConfigError(
            f"--set {_shown(text)}: write it as section.key=value, for example --set features.num_keypoints=2000"
        )
    _check_lines(text, f"--set {_short(text)}")
    parsed: Any
    try:
        parsed = tomllib.loads(f"value = {value}")["value"]
    except (ValueError, RecursionError):
        parsed = value.strip()  # a bare word is a string
    section, _, name = key.strip().rpartition(".")
    return {section: {name: parsed}} if section else {name: parsed}


def _merge(config: Section, values: Mapping[str, Any], source: str, root: type[Settings]) -> Section:
    """Return the section with some values changed; `root` is the outermost one, for suggestions."""
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
    ending = [each for each in known if each.endswith(f".{name}")]
    nearest = difflib.get_close_matches(name, known, n=1, cutoff=0.5) or ending
    return f"; did you mean {nearest[0]!r}?" if nearest else f"; known are {', '.join(known)}"
