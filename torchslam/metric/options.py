"""The options by which metric sources are given, on the command line and in a configuration.

An option `--gps FILE` is the setting `metric.gps` as well. This module imports neither torch nor a source before one is
made, so that the help of the command line appears at once.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING

from torchslam.config import MetricConfig
from torchslam.errors import ConfigError

if TYPE_CHECKING:
    from torchslam.metric.source import MetricSource

SEPARATOR = ";"
"""A word between the times that an option is given, in a setting: `marker = "aruco-4x4:0.1 ; aruco-5x5:0.2"`."""

FILES = frozenset({"FILE", "FOLDER[:SCALE]", "CAMERA"})
"""Words of options that may be names of files."""
AUTO = "auto"
"""A word in place of a file: the file of the dataset, as in `--depth auto`."""

Given = Mapping[str, tuple[tuple[str, ...], ...]]
"""By the name of an option: its words, for each time that it was given. Options that were not given are missing."""


@dataclass(frozen=True)
class Option:
    """An option of the command line, `--name`, and the setting `metric.name`, whose description is its help.

    Attributes:
        name: of the setting; the option has hyphens for underscores.
        words: what each of its words is, as the help shows it.
    """

    name: str
    words: tuple[str, ...]

    @property
    def flag(self) -> str:
        """The option as it is written on the command line."""
        return "--" + self.name.replace("_", "-")


@dataclass(frozen=True)
class SourceKind:
    """A kind of source.

    Attributes:
        options: the first one makes a source, the others are its details.
        make: `module:function`, which makes the sources of `Given`; called if the first option is given. The module is
            below `torchslam.metric`.
        on_request: what a dataset brings of this kind counts only where the user writes `AUTO`.
    """

    options: tuple[Option, ...]
    make: str
    on_request: bool = False


KINDS: tuple[SourceKind, ...] = (
    SourceKind((Option("marker", ("FAMILY:METERS",)),), "markers.source:from_options"),
    SourceKind((Option("distance", ("FRAME:X,Y", "FRAME:X,Y", "METERS")),), "distances:from_options"),
    SourceKind((Option("camera_height", ("METERS",)),), "camera_height:from_options"),
    SourceKind((Option("gps", ("FILE",)), Option("gps_clock", ("CLOCK",))), "positions:from_options"),
    SourceKind(
        (Option("speed", ("FILE",)), Option("speed_clock", ("CLOCK",))), "odometry:speeds_from_options"
    ),
    SourceKind(
        (Option("odometry", ("FILE",)), Option("odometry_clock", ("CLOCK",))), "odometry:from_options"
    ),
    SourceKind((Option("imu", ("FILE",)), Option("imu_camera", ("FILE",))), "inertial:from_options"),
    SourceKind(
        (Option("depth", ("FOLDER[:SCALE]",)), Option("depth_camera", ("CAMERA",))),
        "sensor_depth:from_options",
        on_request=True,
    ),
)
"""All kinds, in the order in which they measure: markers, which also improve the poses, come first."""


def given_options(config: MetricConfig, brought: Mapping[str, str] | None = None) -> Given:
    """The options that a configuration sets, and those that a dataset brings along.

    Args:
        config: the settings.
        brought: settings by name, as `Sequence.measurements`; those of a kind that the configuration sets itself do not
            count. If `config.own` is False, only those count whose setting is `AUTO`.

    Raises:
        ConfigError: an option has another number of words than it needs, the option that it belongs to is missing, or
            nothing is there for `AUTO`.
    """
    given: dict[str, tuple[tuple[str, ...], ...]] = {}
    brought = brought if brought is not None else {}
    for kind in KINDS:
        own = {option.name: _text(getattr(config, option.name)) for option in kind.options}
        first, *details = kind.options
        is_asked = own[first.name] == AUTO
        if is_asked and first.name not in brought:
            raise ConfigError(f"{first.flag} {AUTO}: the recording contains none; give the file or folder")
        is_taken = is_asked or (not own[first.name] and config.own and not kind.on_request)
        if is_taken and first.name in brought:
            own[first.name] = ""
            own = {name: text or brought.get(name, "") for name, text in own.items()}
        alone = [option.flag for option in details if own[option.name] and not own[first.name]]
        if alone:
            raise ConfigError(f"{alone[0]} requires {first.flag}")
        given |= {
            option.name: _times(option, own[option.name]) for option in kind.options if own[option.name]
        }
    return given


def given_files(config: MetricConfig) -> list[tuple[str, str]]:
    """The names of options that a configuration sets, each with a word that may be the name of a file.

    Raises ConfigError if an option has another number of words than it needs.
    """
    found = []
    for option in (option for kind in KINDS for option in kind.options):
        text = _text(getattr(config, option.name))
        for words in _times(option, text) if text and text != AUTO else ():
            found += [(option.name, w) for w, what in zip(words, option.words, strict=True) if what in FILES]
    return found


def setting_of(times: Iterable[Iterable[str]]) -> str:
    """The text of a setting, from the words of each time that its option was given."""
    return f" {SEPARATOR} ".join(shlex.join(words) for words in times)


def _text(value: str | float) -> str:
    """A setting as text; empty if it is not set."""
    return value.strip() if isinstance(value, str) else (repr(value) if value else "")


def _times(option: Option, text: str) -> tuple[tuple[str, ...], ...]:
    """The words of each time that an option is given."""
    try:
        words = shlex.split(text)
    except ValueError as error:
        raise ConfigError(f"metric.{option.name}: {text!r}: {error}") from None
    times: list[list[str]] = [[]]
    for word in words:
        if word == SEPARATOR:
            times.append([])
        else:
            times[-1].append(word)
    for each in times:
        if len(each) != len(option.words):
            raise ConfigError(
                f"metric.{option.name} (or {option.flag}) needs {' '.join(option.words)}, not {' '.join(each)!r}"
            )
    return tuple(map(tuple, times))


def sources_of(given: Given) -> list[MetricSource]:
    """Make all sources that are given. Raises TorchslamError if an option or a file that it names is wrong."""
    made = []
    for kind in KINDS:
        if kind.options[0].name in given:
            module, name = kind.make.split(":")
            made += getattr(import_module(f"torchslam.metric.{module}"), name)(given)
    return made
