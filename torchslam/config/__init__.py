"""Configuration: settings with their defaults and allowed values.

Every section is exported here. A configuration is validated however it is built: see `torchslam.config.schema`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from torchslam.config.builtin import find
from torchslam.config.dynamic import IndependentMotionConfig, StaticOverlayConfig
from torchslam.config.features import FeaturesConfig, MatchingConfig, MeasurementConfig, SimulatedConfig
from torchslam.config.mapping import BundleAdjustmentConfig, KeyframesConfig, LoopClosingConfig, MappingConfig
from torchslam.config.schema import Settings, choices, enlarged, merged, setting, to_toml
from torchslam.config.tracking import (
    InitializationConfig,
    PoseValidationConfig,
    RelocalizationConfig,
    TrackingConfig,
)

__all__ = [
    "CHOICES",
    "BundleAdjustmentConfig",
    "Config",
    "FeaturesConfig",
    "IndependentMotionConfig",
    "InitializationConfig",
    "KeyframesConfig",
    "LoopClosingConfig",
    "MappingConfig",
    "MatchingConfig",
    "MeasurementConfig",
    "PoseValidationConfig",
    "RelocalizationConfig",
    "SimulatedConfig",
    "StaticOverlayConfig",
    "TrackingConfig",
    "load_config",
    "to_toml",
]


@dataclass(frozen=True)
class Config(Settings):
    """All settings, section by section: `Config(loop_closing=LoopClosingConfig(enabled=False))`, or by `load_config`.

    Frozen, like its sections: `dataclasses.replace` makes another one. Raises ConfigError for a value that is not
    allowed, however it is made.
    """

    seed: int = setting(0, "Seed of the random number generators.", low=0, high=2**63 - 1)
    scale: str = setting(
        "unit",
        "Length unit of the map; unit: the median depth of the initial map is 1.",
        choices=("unit", "groundtruth"),
    )
    features: FeaturesConfig = field(default_factory=FeaturesConfig)
    simulated: SimulatedConfig = field(default_factory=SimulatedConfig)
    matching: MatchingConfig = field(default_factory=MatchingConfig)
    measurement: MeasurementConfig = field(default_factory=MeasurementConfig)
    initialization: InitializationConfig = field(default_factory=InitializationConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    static_overlay: StaticOverlayConfig = field(default_factory=StaticOverlayConfig)
    independent_motion: IndependentMotionConfig = field(default_factory=IndependentMotionConfig)
    pose_validation: PoseValidationConfig = field(default_factory=PoseValidationConfig)
    relocalization: RelocalizationConfig = field(default_factory=RelocalizationConfig)
    keyframes: KeyframesConfig = field(default_factory=KeyframesConfig)
    mapping: MappingConfig = field(default_factory=MappingConfig)
    loop_closing: LoopClosingConfig = field(default_factory=LoopClosingConfig)
    bundle_adjustment: BundleAdjustmentConfig = field(default_factory=BundleAdjustmentConfig)

    def for_size(self, size: tuple[int, int]) -> Config:
        """The configuration for images (width, height): what is said in pixels of reduced ones grows with them.

        What is said in units of a keypoint's scale does not: the scale has grown already.
        """
        return enlarged(self, self.features.reduction(size))


CHOICES = choices(Config)
"""The settings that are one of a few words, by full name."""


def load_config(path: Path | str | None = None, overrides: Iterable[str] = ()) -> Config:
    """The defaults, changed by a TOML file, changed by overrides of the form `section.key=value`.

    path: of the file, or as a string the name of one of `configs/`, such as "paper"

    Raises ConfigError for a missing or malformed file, an unknown key, or a value of the wrong type or not allowed.
    """
    return merged(Config(), None if path is None else find(path), overrides)
