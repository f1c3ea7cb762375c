"""The configuration: what can be set, with defaults and what each setting allows.

Its sections are in `torchslam.sections`, and all of them can be imported from here. A configuration is valid however it
was built: see `torchslam.config.schema`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from torchslam.config.builtin import find
from torchslam.config.dynamic import IndependentMotionConfig, StillnessConfig
from torchslam.config.features import FeaturesConfig, MatchingConfig, MeasurementConfig, SimulatedConfig
from torchslam.config.mapping import BundleConfig, KeyframesConfig, LoopsConfig, MappingConfig
from torchslam.config.schema import Settings, choices, enlarged, merged, setting, to_toml
from torchslam.config.tracking import (
    InitializationConfig,
    JudgeConfig,
    PatchesConfig,
    RelocalizationConfig,
    TrackingConfig,
)

__all__ = [
    "CHOICES",
    "BundleConfig",
    "Config",
    "FeaturesConfig",
    "IndependentMotionConfig",
    "InitializationConfig",
    "JudgeConfig",
    "KeyframesConfig",
    "LoopsConfig",
    "MappingConfig",
    "MatchingConfig",
    "MeasurementConfig",
    "PatchesConfig",
    "RelocalizationConfig",
    "SimulatedConfig",
    "StillnessConfig",
    "TrackingConfig",
    "load_config",
    "to_toml",
]


@dataclass(frozen=True)
class Config(Settings):
    """All settings, section by section: `Config(loops=LoopsConfig(enabled=False))`, or read by `load_config`.

    Frozen, like its sections: `dataclasses.replace` makes another one. Raises ConfigError for a value that is not
    allowed, however it is made.
    """

    seed: int = setting(0, "of all random choices", low=0, high=2**63 - 1)
    scale: str = setting(
        "unit",
        "length of a map unit; unit: the median depth of the first map is 1",
        choices=("unit", "groundtruth"),
    )
    features: FeaturesConfig = field(default_factory=FeaturesConfig)
    simulated: SimulatedConfig = field(default_factory=SimulatedConfig)
    matching: MatchingConfig = field(default_factory=MatchingConfig)
    measurement: MeasurementConfig = field(default_factory=MeasurementConfig)
    initialization: InitializationConfig = field(default_factory=InitializationConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    patches: PatchesConfig = field(default_factory=PatchesConfig)
    stillness: StillnessConfig = field(default_factory=StillnessConfig)
    independent_motion: IndependentMotionConfig = field(default_factory=IndependentMotionConfig)
    judge: JudgeConfig = field(default_factory=JudgeConfig)
    relocalization: RelocalizationConfig = field(default_factory=RelocalizationConfig)
    keyframes: KeyframesConfig = field(default_factory=KeyframesConfig)
    mapping: MappingConfig = field(default_factory=MappingConfig)
    loops: LoopsConfig = field(default_factory=LoopsConfig)
    bundle: BundleConfig = field(default_factory=BundleConfig)

    def for_size(self, size: tuple[int, int]) -> Config:
        """The configuration for images (width, height): what is said in pixels of reduced ones grows with them.

        What is said in units of a keypoint's scale does not: the scale has grown already.
        """
        return enlarged(self, self.features.reduction(size))


CHOICES = choices(Config)
"""The settings that are one of a few words, by full name."""


def load_config(path: Path | str | None = None, overrides: Iterable[str] = ()) -> Config:
    """The defaults, changed by a TOML file, changed by overrides of the form `section.key=value`.

    path: of the file, or as a string the name of one of `configs/`, such as "fast"

    Raises ConfigError for a missing or malformed file, an unknown key, or a value of the wrong type or not allowed.
    """
    return merged(Config(), None if path is None else find(path), overrides)
