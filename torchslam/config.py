"""The configuration: frozen dataclasses with defaults, read from TOML, written back as resolved.

An unknown key is an error that names the nearest known one; a value of the wrong type or out of range is an
error that names the key.
"""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, get_type_hints

from torchslam.errors import ConfigError


@dataclass(frozen=True)
class FeaturesConfig:
    kind: str = "orb"  # orb | opencv-orb | simulated | xfeat | aliked
    num_keypoints: int = 1000
    weights: str = ""  # file with the weights of a learned front end


@dataclass(frozen=True)
class SimulatedConfig:
    """Simulated features: points scattered in the views of the true trajectory and projected through it."""

    points_per_view: int = 400
    depth_near: float = 0.1  # as a share of the extent of the trajectory
    depth_far: float = 1.0
    noise_px: float = 0.0
    outliers: float = 0.0  # share of the keypoints that lie at a random place
    dropout: float = 0.0  # share of the visible points that a frame misses


@dataclass(frozen=True)
class MatchingConfig:
    max_distance: float = 64.0  # bits; learned features use max_cosine_distance
    max_cosine_distance: float = 0.25
    ratio: float = 0.8


@dataclass(frozen=True)
class MeasurementConfig:
    """How far a keypoint may lie from where its point is predicted: the one test of tracking, mapping and adjusting."""

    # chi_square: errors in units of the pixel noise | mahalanobis: in tracking of that and the point's uncertainty
    gate: str = "chi_square"
    chi_square: float = 5.991  # 95 % of two degrees of freedom


@dataclass(frozen=True)
class InitializationConfig:
    criterion: str = "uncertainty"  # uncertainty | parallax (the criteria of configs/paper.toml)
    min_matches: int = 100  # fewer than this with the reference frame: a new reference
    min_motion_px: float = 2.0  # of the matches, in the median; less is a standstill
    min_points: int = 60
    threshold_px: float = 1.5
    max_depth_std: float = (
        0.1  # uncertainty: a point counts when its relative depth is known better than this
    )
    min_good_share: float = 0.15  # ... and this share of the matches must count
    planar_patience: int = 10  # frames that look planar before a plane is believed
    min_planar_share: float = 0.5  # uncertainty: ... of the matches on a plane
    min_parallax_deg: float = 3.0  # parallax: a point counts from this angle on
    min_mean_parallax_deg: float = 5.0
    min_explained: float = 0.8  # share of the frames since the reference that the start must explain
    max_reference_age: int = 300  # frames; an older reference is replaced
    max_waiting: int = 1000  # frames without a pose that are kept, to be posed once there is a map
    min_frames: int = (
        20  # a world that was lost before it had tracked this many after its start is taken back
    )


@dataclass(frozen=True)
class TrackingConfig:
    predict: bool = True  # constant velocity; without it the previous pose
    guided: bool = True  # match near the projection first; without it brute force alone
    radius_px: float = 12.0  # at the finest pyramid level
    wide_radius_factor: float = 3.0
    refine_radius_px: float = 5.0
    threshold_px: float = 3.0  # of the PnP RANSAC
    min_matches: int = 20
    min_inliers: int = 20
    local_keyframes: int = 12
    max_view_angle_deg: float = 60.0
    recent_frames: int = (
        0  # match points seen in the last n frames instead of the co-visible ones; 0: co-visible
    )


@dataclass(frozen=True)
class StillnessConfig:
    """When pixels stay in place that should have moved with the scene, as logos and dirt on the lens do."""

    enabled: bool = True
    min_motion_px: float = 4.0  # a point of the scene would have moved by at least this
    min_moving_share: float = 0.5  # of the keypoints, before two frames are compared
    radius_px: float = 1.5  # within which a keypoint has stayed
    max_distance_share: float = 0.6  # of the distance at which descriptors match
    min_keypoints: int = 8  # fewer that stay are chance
    min_evidence: int = 2  # comparisons in which a pixel stayed


@dataclass(frozen=True)
class JudgeConfig:
    """When a pose is uncertain: it makes no keyframe and no point until later frames confirm it."""

    min_inlier_share: float = 0.5  # of the matches around the predicted pixels
    max_position_std: float = 0.017  # as a share of the median depth of the tracked points
    max_rotation_std_deg: float = 0.9
    max_jump: float = 0.5  # distance from the predicted position, as a share of the depth
    max_turn_deg: float = 20.0  # from the predicted rotation
    confirmations: int = 2  # certain frames in a row after an uncertain one


@dataclass(frozen=True)
class RelocalizationConfig:
    """What happens after the camera is lost."""

    tries: int = 3  # places compared a frame
    confirmations: int = 4  # certain frames in a row after a relocalised one, before anything is mapped
    patience: int = 20  # lost frames before a new world may begin


@dataclass(frozen=True)
class KeyframesConfig:
    max_translation: float = 0.10  # as a share of the median depth of the tracked points
    max_rotation_deg: float = 12.0
    min_overlap: float = 0.8  # tracked points as a share of the well observed ones of the reference keyframe
    min_interval: int = 0  # frames between two keyframes


@dataclass(frozen=True)
class MappingConfig:
    partners: str = "covisible"  # new points are triangulated against: covisible | last (keyframes)
    neighbours: int = 5  # how many of them
    min_parallax_deg: float = 1.0
    epipolar_px: float = 2.0
    min_baseline: float = 0.01  # as a share of the median depth
    fuse: bool = True
    cull: bool = True
    min_found_share: float = 0.25


@dataclass(frozen=True)
class BundleConfig:
    enabled: bool = True
    window: int = 8  # keyframes whose poses are free
    max_fixed: int = 12
    iterations: int = 6
    final: bool = True  # one bundle adjustment over the whole map when the run ends
    final_iterations: int = 15


@dataclass(frozen=True)
class Config:
    seed: int = 0
    scale: str = "unit"  # unit: the median depth of the first map is 1 | groundtruth
    features: FeaturesConfig = field(default_factory=FeaturesConfig)
    simulated: SimulatedConfig = field(default_factory=SimulatedConfig)
    matching: MatchingConfig = field(default_factory=MatchingConfig)
    measurement: MeasurementConfig = field(default_factory=MeasurementConfig)
    initialization: InitializationConfig = field(default_factory=InitializationConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    stillness: StillnessConfig = field(default_factory=StillnessConfig)
    judge: JudgeConfig = field(default_factory=JudgeConfig)
    relocalization: RelocalizationConfig = field(default_factory=RelocalizationConfig)
    keyframes: KeyframesConfig = field(default_factory=KeyframesConfig)
    mapping: MappingConfig = field(default_factory=MappingConfig)
    bundle: BundleConfig = field(default_factory=BundleConfig)


CHOICES = {
    "scale": ("unit", "groundtruth"),
    "features.kind": ("orb", "opencv-orb", "simulated", "xfeat", "aliked"),
    "initialization.criterion": ("uncertainty", "parallax"),
    "measurement.gate": ("chi_square", "mahalanobis"),
    "mapping.partners": ("covisible", "last"),
}


def load_config(path: Path | str | None = None, overrides: Iterable[str] = ()) -> Config:
    """The defaults, changed by a TOML file, changed by overrides of the form `section.key=value`.

    Raises ConfigError for a missing or malformed file, an unknown key or a value of the wrong type.
    """
    config = Config()
    if path is not None:
        config = _merge(config, _read_toml(Path(path)), str(path))
    for override in overrides:
        config = _merge(config, _parse_override(override), f"--set {override}")
    return config


def to_toml(config: Config) -> str:
    """The configuration as TOML, every value written out."""
    lines = [
        f"{f.name} = {_toml_value(getattr(config, f.name))}"
        for f in fields(config)
        if not _is_section(config, f.name)
    ]
    for section in fields(config):
        if _is_section(config, section.name):
            values = getattr(config, section.name)
            lines += ["", f"[{section.name}]"]
            lines += [f"{f.name} = {_toml_value(getattr(values, f.name))}" for f in fields(values)]
    return "\n".join(lines) + "\n"


def _is_section(config: object, name: str) -> bool:
    return is_dataclass(getattr(config, name))


def _toml_value(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    return repr(value)


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ConfigError(f"configuration file {path} does not exist") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
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
    except tomllib.TOMLDecodeError:
        parsed = value.strip()  # a bare word is a string
    for part in reversed(key.strip().split(".")):
        parsed = {part: parsed}
    return parsed


def _merge(config: Any, values: Mapping[str, Any], source: str, prefix: str = "") -> Any:
    hints = get_type_hints(type(config))
    changes: dict[str, Any] = {}
    for key, value in values.items():
        name = prefix + key
        if key not in hints:
            raise ConfigError(f"{source}: unknown key {name!r}{_suggestion(name)}")
        current = getattr(config, key)
        if is_dataclass(current):
            if not isinstance(value, Mapping):
                raise ConfigError(f"{source}: {name} is a section, write {name}.key = value")
            changes[key] = _merge(current, value, source, f"{name}.")
        else:
            changes[key] = _checked(name, value, hints[key], source)
    return replace(config, **changes)


def _checked(name: str, value: Any, kind: type, source: str) -> Any:
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if type(value) is not kind:
        raise ConfigError(f"{source}: {name} must be of type {kind.__name__}, not {value!r}")
    if name in CHOICES and value not in CHOICES[name]:
        raise ConfigError(f"{source}: {name} must be one of {', '.join(CHOICES[name])}, not {value!r}")
    if isinstance(value, int | float) and not 0 <= value < float("inf"):
        raise ConfigError(f"{source}: {name} must be finite and not negative, not {value!r}")
    return value


def _suggestion(name: str) -> str:
    known = []
    for section in fields(Config):
        known.append(section.name)
        default = getattr(Config(), section.name)
        if is_dataclass(default):
            known += [f"{section.name}.{f.name}" for f in fields(default)]
    nearest = (
        difflib.get_close_matches(name, known, n=1, cutoff=0.5)
        or [k for k in known if k.endswith("." + name)][:1]
    )
    return f"; did you mean {nearest[0]!r}?" if nearest else f"; known are {', '.join(known)}"
