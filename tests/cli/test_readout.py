"""The readout on the command line: numbers, names, what is looked for."""

from __future__ import annotations

import argparse

import pytest

from torchslam.cli import arguments
from torchslam.errors import ConfigError


def parsed(*words: str) -> tuple[float, float]:
    """Readout and standard deviation of the configuration, milliseconds."""
    parser = argparse.ArgumentParser()
    arguments.add_config(parser)
    camera = arguments.config(parser.parse_args(words)).camera
    return camera.readout, camera.readout_std


def test_numbers_and_names_are_given_readouts() -> None:
    assert parsed() == (0.0, 1000.0)
    assert parsed("--readout", "auto") == parsed()
    assert parsed("--readout", "28.5") == (28.5, 1.0)
    assert parsed("--readout", "-28.5") == (-28.5, 1.0)
    assert parsed("--readout", "kinect") == (30.0, 1.0)
    assert parsed("--readout", "0") == (0.0, 0.0)


def test_other_words_are_named(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        parsed("--readout", "fast")
    assert "'fast' is neither a number nor one of auto, kinect" in capsys.readouterr().err
    for number in ("nan", "2000"):
        with pytest.raises(ConfigError, match=r"camera\.readout must be at least -1000 and at most 1000"):
            parsed("--readout", number)
