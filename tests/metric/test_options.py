"""How sources are given: on the command line, in a configuration, by a dataset."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import pytest

from torchslam.cli import arguments
from torchslam.config import Config, MetricConfig, load_config
from torchslam.config.schema import descriptions
from torchslam.errors import ConfigError, MeasurementError
from torchslam.metric import options as kinds
from torchslam.metric.options import KINDS, Option, SourceKind, given_options, sources_of


def parsed(*words: str) -> Config:
    parser = argparse.ArgumentParser()
    arguments.add_config(parser)
    arguments.add_metric(parser)
    return arguments.config(parser.parse_args(words))


def test_an_option_is_a_setting() -> None:
    config = parsed(
        "--marker",
        "apriltag-25h9:0.05",
        "--marker",
        "aruco-4x4:0.1",
        "--distance",
        "3:10,20",
        "4:30.5,40",
        "1.5",
        "--camera-height",
        "1.65",
    ).metric
    assert config.marker == "apriltag-25h9:0.05 ';' aruco-4x4:0.1" or config.marker == (
        "apriltag-25h9:0.05 ; aruco-4x4:0.1"
    )
    given = given_options(config)
    assert given["marker"] == (("apriltag-25h9:0.05",), ("aruco-4x4:0.1",))
    assert given["distance"] == (("3:10,20", "4:30.5,40", "1.5"),)
    assert given["camera_height"] == (("1.65",),)
    assert len(sources_of(given)) == 3


def test_nothing_is_given_by_default() -> None:
    assert given_options(MetricConfig()) == {}


def test_a_file_of_settings_gives_them_too(tmp_path: Path) -> None:
    path = tmp_path / "own.toml"
    path.write_text('[metric]\ncamera_height = 1.2\nmarker = "aruco-4x4:0.1 ; aruco-5x5:0.2"\n')
    given = given_options(load_config(path).metric)
    assert given["marker"] == (("aruco-4x4:0.1",), ("aruco-5x5:0.2",))
    assert given["camera_height"] == (("1.2",),)


def test_every_option_is_a_setting_with_a_description() -> None:
    for option in (option for kind in KINDS for option in kind.options):
        assert descriptions(MetricConfig)[option.name]


def test_a_wrong_number_of_words_is_named() -> None:
    with pytest.raises(ConfigError, match=r"needs FRAME:X,Y FRAME:X,Y METERS, not '3:10,20 1.5'"):
        given_options(MetricConfig(distance="3:10,20 1.5"))


@pytest.fixture
def paired(monkeypatch: pytest.MonkeyPatch) -> None:
    """A kind with a detail."""
    pair = SourceKind((Option("marker", ("FILE",)), Option("distance", ("FILE",))), "nowhere:nothing")
    monkeypatch.setattr(kinds, "KINDS", (pair,))


@pytest.mark.usefixtures("paired")
def test_a_detail_needs_its_source() -> None:
    with pytest.raises(ConfigError, match="--distance requires --marker"):
        given_options(MetricConfig(distance="a.yaml"))


@pytest.mark.usefixtures("paired")
def test_what_a_dataset_brings_counts_unless_the_user_gives_its_kind() -> None:
    brought = {"marker": "theirs.csv", "distance": "'their camera.yaml'"}
    both = given_options(MetricConfig(), brought)
    assert both == {"marker": (("theirs.csv",),), "distance": (("their camera.yaml",),)}
    assert given_options(MetricConfig(marker="mine.csv"), brought) == {"marker": (("mine.csv",),)}
    assert given_options(replace(MetricConfig(), own=False), brought) == {}


def test_what_is_used_on_request_alone() -> None:
    """A recording with depth images stays one of a single camera, unless they are asked for."""
    brought = {"depth": "'my scan/depth.txt'", "depth_camera": "585,585,320,240"}
    assert given_options(MetricConfig(), brought) == {}
    asked = {"depth": (("my scan/depth.txt",),), "depth_camera": (("585,585,320,240",),)}
    assert given_options(MetricConfig(depth="auto"), brought) == asked
    assert given_options(MetricConfig(depth="auto", own=False), brought) == asked
    assert given_options(MetricConfig(depth="other:5000"), brought) == {"depth": (("other:5000",),)}
    with pytest.raises(ConfigError, match="--depth auto: the recording contains none"):
        given_options(MetricConfig(depth="auto"))


def test_a_wrong_description_is_refused_before_the_run() -> None:
    for config in (MetricConfig(marker="apriltag-9h9:0.05"), MetricConfig(distance="1:2,3 1:2,3 4")):
        with pytest.raises(MeasurementError):
            sources_of(given_options(config))


@pytest.mark.parametrize("word", ["165cm", "0", "-1.65", "nan", "inf", ""])
def test_a_height_is_a_positive_number(word: str) -> None:
    """0 is the setting of no height, and would be ignored."""
    with pytest.raises(ConfigError, match=f"--camera-height {word}: write a number above 0"):
        parsed("--camera-height", word)


def test_a_height_is_given_once() -> None:
    with pytest.raises(ConfigError, match="--camera-height is given 2 times"):
        parsed("--camera-height", "1.6", "--camera-height", "1.7")
    assert parsed("--camera-height", "1.65").metric.camera_height == 1.65
