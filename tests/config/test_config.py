from __future__ import annotations

import math
import os
import time
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchslam.config import (
    Config,
    FeaturesConfig,
    KeyframesConfig,
    LoopClosingConfig,
    MatchingConfig,
    load_config,
    to_toml,
)
from torchslam.config.schema import MAX_BYTES, Allowed, Settings, descriptions, setting
from torchslam.errors import ConfigError

SECTIONS = {
    f.name: type(getattr(Config(), f.name)) for f in fields(Config) if f.name not in ("seed", "scale")
}


def test_resolved_toml_reads_back_as_the_same_configuration(tmp_path: Path) -> None:
    config = load_config(
        None, ["seed=7", "features.kind=opencv-orb", "matching.max_ratio=0.7", 'features.weights="a \\"b\\""']
    )
    file = tmp_path / "config.toml"
    file.write_text(to_toml(config))
    assert load_config(file) == config
    assert config != Config()


def test_every_character_of_a_string_round_trips(tmp_path: Path) -> None:
    weights = "".join(map(chr, range(0x100))) + "\u2028\U0001f600"
    file = tmp_path / "config.toml"
    file.write_text(to_toml(Config(features=FeaturesConfig(weights=weights))), encoding="utf-8")
    assert load_config(file).features.weights == weights


def test_overrides_take_precedence_over_the_file(tmp_path: Path) -> None:
    file = tmp_path / "config.toml"
    file.write_text("[features]\nnum_keypoints = 500\nkind = 'opencv-orb'\n")
    config = load_config(file, ["features.num_keypoints=750"])
    assert (config.features.num_keypoints, config.features.kind) == (750, "opencv-orb")


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("features.num_keypoint=5", "did you mean 'features.num_keypoints'"),
        ("num_keypoints=5", "did you mean 'features.num_keypoints'"),
        ("features.num_keypoints=many", "must be of type int"),
        ("features.num_keypoints=true", "must be of type int"),
        ("features.kind=surf", "must be one of orb, opencv-orb, sift"),
        ("features=3", "is a section"),
        ("matching.max_ratio=nan", "matching.max_ratio must be above 0 and at most 1, not nan"),
        ("matching.max_ratio=-0.5", "matching.max_ratio must be above 0 and at most 1, not -0.5"),
        (
            "global_mapping.window_images=0",
            "--set global_mapping.window_images=0: global_mapping.window_images must be at least 3 and at most "
            "1000000, not 0",
        ),
        ("features.max_image_pixels=1", "features.max_image_pixels must be 0 or at least 1024 and at most"),
        ("seed=18446744073709551616", "seed must be at least 0 and at most 9223372036854775807"),
        pytest.param("a" + 20_000 * ".a" + "=1", "40003 characters, more than the 4096", id="too many dots"),
        pytest.param("seed=" + 3000 * "[" + 3000 * "]", "6005 characters", id="too deep"),
        pytest.param("seed=" + 1500 * "[" + 1500 * "]", "seed must be of type int", id="deep"),
        pytest.param("seed=" + 1000 * "9", "seed must be at least 0 and at most", id="many digits"),
        pytest.param("seed=" + 5000 * "9", "5005 characters, more than the 4096", id="too many digits"),
        ("seed", "section.key=value"),
    ],
)
def test_an_invalid_override_is_rejected_by_name(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        load_config(None, [override])


def test_an_unknown_key_in_a_file_names_the_file(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text("[keyframes]\nmax_rotation = 3\n")
    with pytest.raises(
        ConfigError, match=r"mine\.toml: unknown key 'keyframes\.max_rotation'.*keyframes\.max_rotation_deg"
    ):
        load_config(file)


def test_a_missing_and_a_malformed_file_are_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="does not exist"):
        load_config(tmp_path / "none.toml")
    broken = tmp_path / "broken.toml"
    broken.write_text("[features\n")
    with pytest.raises(ConfigError, match="not valid TOML"):
        load_config(broken)
    with pytest.raises(ConfigError, match="cannot be read"):
        load_config(tmp_path)


@pytest.mark.parametrize(
    "file", sorted((Path(__file__).parents[2] / "configs").glob("*.toml")), ids=lambda f: f.stem
)
def test_every_configuration_file_of_the_repository_loads(file: Path) -> None:
    assert isinstance(load_config(file), Config)


def test_default_toml_is_the_default() -> None:
    assert load_config(Path(__file__).parents[2] / "configs" / "default.toml") == Config()


def test_the_commented_toml_reads_back(tmp_path: Path) -> None:
    config = load_config(None, ["seed=7", "features.max_image_pixels=0", "matching.max_ratio=0.7"])
    text = to_toml(config, commented=True)
    (tmp_path / "c.toml").write_text(text)
    assert load_config(tmp_path / "c.toml") == config
    assert len((tmp_path / "c.toml").read_bytes()) < MAX_BYTES / 2
    assert "#   0 or at least 1024 and at most 67108864; default 307200\nmax_image_pixels = 0\n" in text
    assert "#   default true\nenabled = true" in text


@pytest.mark.parametrize("kind", [Config, *SECTIONS.values()], ids=lambda kind: kind.__name__)
def test_every_setting_has_a_description_and_a_range(kind: type[Settings]) -> None:
    for declared in fields(kind):
        if declared.type in ("int", "float"):
            assert declared.metadata["allowed"].high < math.inf, declared.name
            assert declared.default in declared.metadata["allowed"]
        if declared.type in ("int", "float", "bool", "str"):
            assert descriptions(kind)[declared.name], declared.name


def test_a_slow_or_large_file_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "hostile.toml"
    for text, message in (
        ("a" + ".a" * 20_000 + " = 1", "a line of 40005 characters, more than the 4096"),
        (
            "seed = " + "9" * 4000 + "\n# " + "#\n" * 40_000,
            "has 84010 bytes, more than the 65536 of a configuration",
        ),
        ("seed = " + "[\n" * 3000 + "]\n" * 3000, "not valid TOML|type int"),
        ("a" + ".a" * 2000 + " = 1", "unknown key 'a'"),
    ):
        file.write_text(text)
        start = time.process_time()
        with pytest.raises(ConfigError, match=rf"hostile\.toml.*{message}"):
            load_config(file)
        assert time.process_time() - start < 1
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ConfigError, match="pipe cannot be read: not a regular file"):
        load_config(tmp_path / "pipe")


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Config(scale="metric"), "^scale must be one of unit, groundtruth, not 'metric'"),
        (
            lambda: replace(Config(), seed=-1),
            "^seed must be at least 0 and at most 9223372036854775807, not -1",
        ),
        (lambda: Config(keyframes=LoopClosingConfig()), "^keyframes must be of type KeyframesConfig"),
        (lambda: Config(keyframes=None), "^keyframes must be of type KeyframesConfig, not None"),
        (
            lambda: FeaturesConfig(num_keypoints=100.0),
            "^features.num_keypoints must be of type int, not 100.0",
        ),
        (
            lambda: FeaturesConfig(weights="\udcff"),
            "^features.weights must be text that can be written as UTF-8",
        ),
        (
            lambda: MatchingConfig(max_hamming_distance=10**400),
            "^matching.max_hamming_distance must be above 0 and at most 4096",
        ),
    ],
)
def test_an_invalid_value_in_python_is_rejected_by_name(build: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        build()


@pytest.mark.parametrize(
    ("key", "accepted", "refused"),
    [
        ("seed", 2**63 - 1, 2**63),
        ("features.num_keypoints", 1, 0),
        ("simulated.depth_near", 1e-9, 0),
        ("simulated.noise_px", 0, -1e-9),
        ("matching.max_cosine_distance", 2, 2.001),
        ("keyframes.max_rotation_deg", 180, 180.1),
        ("global_mapping.window_images", 3, 2),
    ],
)
def test_limits_are_inclusive_or_exclusive_as_declared(key: str, accepted: float, refused: float) -> None:
    load_config(None, [f"{key}={accepted}"])
    with pytest.raises(ConfigError, match=f"{key} must be "):
        load_config(None, [f"{key}={refused}"])


def test_an_integer_becomes_a_float() -> None:
    for keyframes in (
        KeyframesConfig(max_rotation_deg=20),
        load_config(None, ["keyframes.max_rotation_deg=20"]).keyframes,
    ):
        assert repr(keyframes.max_rotation_deg) == "20.0"


def _valid(default: Any, allowed: Allowed) -> st.SearchStrategy[Any]:
    """Values that a setting with this default may have."""
    if isinstance(default, bool):
        return st.booleans()
    if isinstance(default, str):
        return st.sampled_from(allowed.choices) if allowed.choices else st.text()
    low, high = max(allowed.low, allowed.above), allowed.high if allowed.high < float("inf") else None
    if isinstance(default, int):
        return st.integers(int(low), high if high is None else int(high))
    return st.floats(
        low, high, exclude_min=allowed.above >= allowed.low, allow_nan=False, allow_infinity=False
    )


def _broken(default: Any, allowed: Allowed) -> st.SearchStrategy[Any]:
    """Values that it may not have: of another type, out of range, not finite, not among the choices."""
    other_types: list[Any] = [None, [1], b"orb"]
    if isinstance(default, bool):
        return st.sampled_from([*other_types, 0, 1, 1.0, "true"])
    if isinstance(default, str):
        # A word with a colon may name a plugin, PACKAGE:NAME.
        unknown = st.text().filter(lambda word: word not in allowed.choices and ":" not in word)
        words = unknown if allowed.choices else st.nothing()
        return st.sampled_from([*other_types, 0, True]) | words
    numbers = st.integers(max_value=int(allowed.low) - 1)
    if isinstance(default, int):
        numbers |= st.sampled_from([1.0, float("nan")])
        numbers |= st.integers(int(allowed.high) + 1) if allowed.high < float("inf") else st.nothing()
    else:
        numbers |= st.floats(
            max_value=max(allowed.low, allowed.above), exclude_max=allowed.above < allowed.low
        )
        numbers |= st.sampled_from([float("nan"), float("inf"), 10**400])
        numbers |= st.floats(allowed.high, exclude_min=True) if allowed.high < float("inf") else st.nothing()
    return st.sampled_from([*other_types, True, "1"]) | numbers


def _settings(kind: type[Settings]) -> dict[str, tuple[Any, Allowed]]:
    """Default and constraint of the settings of a section, by name."""
    return {
        f.name: (f.default, f.metadata.get("allowed", Allowed()))
        for f in fields(kind)
        if f.name not in SECTIONS
    }


def _valid_settings(kind: type[Settings]) -> dict[str, st.SearchStrategy[Any]]:
    return {name: _valid(*declared) for name, declared in _settings(kind).items()}


VALID = st.builds(
    Config,
    **_valid_settings(Config),
    **{name: st.builds(kind, **_valid_settings(kind)) for name, kind in SECTIONS.items()},
)
KEYS = [(kind, name, key) for name, kind in {"": Config, **SECTIONS}.items() for key in _settings(kind)]


@settings(max_examples=25, deadline=None)
@given(config=VALID)
def test_any_valid_configuration_reads_back(tmp_path_factory: pytest.TempPathFactory, config: Config) -> None:
    file = tmp_path_factory.mktemp("valid") / "config.toml"
    file.write_text(to_toml(config), encoding="utf-8")
    assert load_config(file) == config


@settings(max_examples=300, deadline=None)
@given(place=st.sampled_from(KEYS), data=st.data())
def test_any_invalid_value_is_rejected_by_name(
    tmp_path_factory: pytest.TempPathFactory, place: tuple[type[Settings], str, str], data: st.DataObject
) -> None:
    kind, section, key = place
    name = f"{section}.{key}" if section else key
    value = data.draw(_broken(*_settings(kind)[key]))
    for build in (kind, lambda **changes: replace(kind(), **changes)):
        with pytest.raises(ConfigError, match=f"^{name} must be "):
            build(**{key: value})
    if isinstance(value, bool | int | float):
        file = tmp_path_factory.mktemp("broken") / "mine.toml"
        file.write_text((f"[{section}]\n" if section else "") + f"{key} = {str(value).lower()}\n")
        with pytest.raises(ConfigError, match=rf"mine\.toml: {name} must be "):
            load_config(file)


def test_a_section_describes_its_allowed_values() -> None:
    @dataclass(frozen=True)
    class Own(Settings, section="own"):
        below: float = setting(-1.0, low=-2, high=0)
        between: float = setting(0.5, above=0, high=1)
        plain: int = 3

    assert Own() == Own(-1, 0.5)
    for name, words in (("below", "at least -2 and at most 0"), ("between", "above 0 and at most 1")):
        with pytest.raises(ConfigError, match=f"own.{name} must be {words}, not 2"):
            Own(**{name: 2})
    with pytest.raises(ConfigError, match=r"own\.plain must be at least 0 and finite, not -1"):
        Own(plain=-1)


def test_a_name_selects_a_bundled_configuration_and_a_path_a_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("paper").write_text("seed = 5\n")
    assert load_config("paper").seed != 5
    assert load_config("default") == Config()
    assert load_config("./paper").seed == load_config(Path("paper")).seed == 5
    Path("mine").write_text("seed = 6\n")
    assert load_config("mine").seed == 6
    with pytest.raises(
        ConfigError, match="fats does not exist, nor a configuration of that name; there are default"
    ):
        load_config("fats")
