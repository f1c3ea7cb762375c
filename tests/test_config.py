from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import pytest

from torchslam.config import Config, load_config, to_toml
from torchslam.errors import ConfigError


def test_resolved_toml_reads_back_as_the_same_configuration(tmp_path: Path) -> None:
    config = load_config(
        None, ["seed=7", "features.kind=opencv-orb", "matching.ratio=0.7", 'features.weights="a \\"b\\""']
    )
    file = tmp_path / "config.toml"
    file.write_text(to_toml(config))
    assert load_config(file) == config
    assert config != Config()


def test_overrides_win_over_the_file(tmp_path: Path) -> None:
    file = tmp_path / "config.toml"
    file.write_text("[features]\nnum_keypoints = 500\nkind = 'opencv-orb'\n")
    config = load_config(file, ["features.num_keypoints=750"])
    assert (config.features.num_keypoints, config.features.kind) == (750, "opencv-orb")


def test_an_integer_serves_as_a_float() -> None:
    assert load_config(None, ["tracking.radius_px=20"]).tracking.radius_px == 20.0


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("features.num_keypoint=5", "did you mean 'features.num_keypoints'"),
        ("num_keypoints=5", "did you mean 'features.num_keypoints'"),
        ("features.num_keypoints=many", "must be of type int"),
        ("features.num_keypoints=true", "must be of type int"),
        ("features.kind=sift", "must be one of orb, opencv-orb"),
        ("features=3", "is a section"),
        ("matching.ratio=nan", "must be finite"),
        ("matching.ratio=-0.5", "must be finite and not negative"),
        ("seed", "section.key=value"),
    ],
)
def test_a_wrong_override_is_named(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        load_config(None, [override])


def test_an_unknown_key_in_a_file_names_the_file(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text("[tracking]\nradius = 3\n")
    with pytest.raises(ConfigError, match=r"mine\.toml: unknown key 'tracking\.radius'.*tracking\.radius_px"):
        load_config(file)


def test_a_missing_and_a_broken_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="does not exist"):
        load_config(tmp_path / "none.toml")
    broken = tmp_path / "broken.toml"
    broken.write_text("[features\n")
    with pytest.raises(ConfigError, match="not valid TOML"):
        load_config(broken)


@pytest.mark.parametrize(
    "file", sorted((Path(__file__).parents[1] / "configs").glob("*.toml")), ids=lambda f: f.stem
)
def test_every_configuration_file_of_the_repository_loads(file: Path) -> None:
    assert isinstance(load_config(file), Config)


def test_default_toml_is_the_default() -> None:
    assert load_config(Path(__file__).parents[1] / "configs" / "default.toml") == Config()


def test_every_section_is_written_out() -> None:
    text = to_toml(Config())
    for section in fields(Config):
        assert section.name in text
