"""Configuration: settings with their defaults and allowed values.

Every section is exported here. A configuration is validated however it is built: see `torchslam.config.schema`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from torchslam.config.schema import Settings, choices, merge_settings, setting, to_toml
from torchslam.config.sections import (
    CameraConfig,
    DenseConfig,
    FeaturesConfig,
    GlobalMappingConfig,
    InitializationConfig,
    KeyframesConfig,
    LoopClosingConfig,
    MatchingConfig,
    MetricConfig,
    PaperConfig,
    SimulatedConfig,
    TrackingConfig,
)
from torchslam.errors import ConfigError

__all__ = [
    "CHOICES",
    "CameraConfig",
    "Config",
    "DenseConfig",
    "FeaturesConfig",
    "GlobalMappingConfig",
    "InitializationConfig",
    "KeyframesConfig",
    "LoopClosingConfig",
    "MatchingConfig",
    "MetricConfig",
    "PaperConfig",
    "SimulatedConfig",
    "TrackingConfig",
    "load_config",
    "to_toml",
]


@dataclass(frozen=True)
class Config(Settings):
    """All settings by section, for example `Config(loop_closing=LoopClosingConfig(enabled=False))`.

    Frozen, like its sections; `dataclasses.replace` returns a changed copy. Every way of building it raises ConfigError
    for a value that is not allowed.

    Attributes:
        seed: Seed of the random number generators; other seeds show how much results vary.
        scale: Length unit of the map; unit: the median depth of the initial map is 1.
    """

    seed: int = setting(0, high=2**63 - 1)
    scale: str = setting("unit", choices=("unit", "groundtruth"))
    camera: CameraConfig = field(default_factory=CameraConfig)
    features: FeaturesConfig = field(default_factory=FeaturesConfig)
    simulated: SimulatedConfig = field(default_factory=SimulatedConfig)
    matching: MatchingConfig = field(default_factory=MatchingConfig)
    initialization: InitializationConfig = field(default_factory=InitializationConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    keyframes: KeyframesConfig = field(default_factory=KeyframesConfig)
    loop_closing: LoopClosingConfig = field(default_factory=LoopClosingConfig)
    global_mapping: GlobalMappingConfig = field(default_factory=GlobalMappingConfig)
    dense: DenseConfig = field(default_factory=DenseConfig)
    metric: MetricConfig = field(default_factory=MetricConfig)
    paper: PaperConfig = field(default_factory=PaperConfig)


CHOICES = choices(Config)
"""Allowed values of the settings that have a fixed set of them, by full name."""


_PACKAGE = Path(__file__).parents[1]
"""Folder of the package."""
FOLDER = _PACKAGE / "configs" if (_PACKAGE / "configs").is_dir() else _PACKAGE.parent / "configs"
"""Folder of the built-in configurations: in the package of a wheel (`setup.py`), in the root of a checkout."""


def builtin_names() -> list[str]:
    """Return the names of the built-in configurations."""
    return sorted(file.stem for file in FOLDER.glob("*.toml"))


def find_config(file: str | Path) -> Path:
    """Return the path of a configuration file, given as a path or as the name of a built-in configuration.

    Raises:
        ConfigError: if a string without folder and suffix is neither a name nor a file.
    """
    if not isinstance(file, str) or not file or Path(file).suffix or Path(file).name != file:
        return Path(file)
    if file in builtin_names():
        return FOLDER / f"{file}.toml"
    if not Path(file).exists():
        raise ConfigError(
            f"configuration file {file} does not exist, nor a configuration of that name; "
            f"there are {', '.join(builtin_names())}"
        )
    return Path(file)


def load_config(path: Path | str | None = None, overrides: Iterable[str] = ()) -> Config:
    """Load a configuration: the defaults, changed by a TOML file, then by overrides.

    Args:
        path: the file, or as a string the name of a built-in configuration, such as "paper".
        overrides: changes of the form `section.key=value`.

    Raises:
        ConfigError: for a missing or malformed file, an unknown key, or a value that is not allowed.
    """
    return merge_settings(Config(), None if path is None else find_config(path), overrides)
