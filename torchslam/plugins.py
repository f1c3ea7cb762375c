"""Plugins by name: PACKAGE:NAME, or a name that an installed package registered as an entry point.

    [project.entry-points."torchslam.front_ends"]
    mine = "my_package.features:MyFeatures"

Then use `--features mine`, or `--features my_package.features:MyFeatures` without registration. A class is instantiated
with those of the configured arguments that it takes (num_keypoints, weights); any other callable is used as it is.
Importing a plugin runs its code. So only the command line and Python may name PACKAGE:NAME; a file of settings or a
list of a batch, which may be somebody else's, may do so for the packages in the environment variable
TORCHSLAM_PLUGINS, separated by commas.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from inspect import Parameter, signature
from typing import Any

from torchslam.errors import ConfigError

FEATURE_EXTRACTORS = "torchslam.front_ends"
MATCHERS = "torchslam.matchers"
MOTION_MODELS = "torchslam.motion_models"
KORNIA, KORNIA_FEATURES = "kornia:", "kornia.feature:"
"""kornia:DISK is kornia.feature.DISK."""
ALLOWED = "TORCHSLAM_PLUGINS"
"""Environment variable: packages that files may name, separated by commas."""


@cache
def registered(group: str) -> dict[str, EntryPoint]:
    """Return the entry points of installed packages, by name."""
    return {point.name: point for point in entry_points(group=group)}


def is_known(group: str, name: str) -> bool:
    """Test whether a name can be that of a plugin: registered, or of the form PACKAGE:NAME."""
    package, colon, attribute = name.partition(":")
    return bool(colon and package and attribute) or name in registered(group)


def is_code_of_others(group: str, name: str) -> bool:
    """Test whether a name imports a package that files may not ask for: neither registered nor in TORCHSLAM_PLUGINS."""
    package, colon, attribute = name.partition(":")
    if name.startswith(KORNIA) and "." not in attribute:  # torchslam itself imports kornia.feature
        return False
    allowed = os.environ.get(ALLOWED, "").split(",")
    return bool(colon) and name not in registered(group) and package not in (each.strip() for each in allowed)


def instantiate(kind: type, **arguments: object) -> Any:
    """Instantiate a class with those of the arguments that it takes and that are not None."""
    given = {name: value for name, value in arguments.items() if value is not None}
    parameters = signature(kind).parameters
    if not any(parameter.kind is Parameter.VAR_KEYWORD for parameter in parameters.values()):
        given = {name: value for name, value in given.items() if name in parameters}
    return kind(**given)


def load(
    group: str, name: str, make: Callable[..., Any] = instantiate, **arguments: object
) -> Callable[..., Any]:
    """Load the plugin of a name in a group of entry points; `make` instantiates a class with the arguments.

    Raises:
        ConfigError: The package or the attribute does not exist or fails, or the plugin is not callable.
    """
    what = f"{group.rpartition('.')[2].rstrip('s').replace('_', ' ')} {name}"
    point = registered(group).get(name)
    place = name.replace(KORNIA, KORNIA_FEATURES, 1) if name.startswith(KORNIA) else name
    package, _, attribute = (point.value if point else place).partition(":")
    try:
        part: Any = import_module(package)
    except ModuleNotFoundError as error:
        missing = "it" if error.name == package.partition(".")[0] or error.name == package else error.name
        raise ConfigError(
            f"{what}: no package {package!r} can be imported ({missing} is not there)"
        ) from None
    except Exception as error:
        raise ConfigError(f"{what}: importing {package!r} failed: {_words(error)}") from error
    for each in attribute.split("."):
        if not hasattr(part, each):
            raise ConfigError(f"{what}: {package!r} has no {attribute!r}")
        part = getattr(part, each)
    if isinstance(part, type):
        try:
            part = make(part, **arguments)
        except ConfigError:
            raise
        except Exception as error:
            raise ConfigError(f"{what}: cannot be instantiated: {_words(error)}") from error
    if not callable(part):
        raise ConfigError(f"{what}: {type(part).__name__} cannot be called")
    called: Callable[..., Any] = part
    return called


def load_feature_extractor(name: str, num_keypoints: int, weights: str | None) -> Callable[..., Any]:
    """Return the feature extractor of a name: one of torchslam's own, one of kornia's (`kornia:DISK`), or a plugin."""
    from torchslam.features import EXTRACTORS, extractor
    from torchslam.features.kornia_modules import is_kornia_module, make_kornia_extractor

    def make(kind: type, **arguments: Any) -> Any:
        return (make_kornia_extractor if is_kornia_module(kind) else instantiate)(kind, **arguments)

    if name in EXTRACTORS or not is_known(FEATURE_EXTRACTORS, name):
        return extractor(name, num_keypoints, weights)
    return load(FEATURE_EXTRACTORS, name, make, num_keypoints=num_keypoints, weights=weights)


def _words(error: Exception) -> str:
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
