"""Whole runs compared with the default: ratios and intervals."""

from __future__ import annotations

import math

import pytest

from experiments.recordings import Outcome, Outcomes, geometric_mean, interval, log_ratios, report


def outcomes_with(ratio: float, posed: float = 1.0) -> Outcomes:
    found: Outcomes = {}
    for label, ate in (("kitti07", 0.4), ("kitti07, 685 px", 0.1), ("shelf_bin", 0.003)):
        for seed in (0, 1, 2):
            found[label, "default", seed] = Outcome(1.0, ate)
            found[label, "other", seed] = Outcome(posed, ratio * ate)
    return found


def test_ratios_do_not_depend_on_the_size_of_the_errors() -> None:
    outcomes = outcomes_with(0.8)
    ratios = {label: log_ratios(outcomes, label, "other") for label in ("kitti07", "shelf_bin")}
    assert geometric_mean(ratios) == pytest.approx(0.8)
    assert "**0.80** (0.80 to 0.80)" in report(outcomes, ["default", "other"])


def test_runs_with_fewer_poses_are_not_compared() -> None:
    assert log_ratios(outcomes_with(0.8, posed=0.85), "shelf_bin", "other") == {}
    lost = outcomes_with(0.8) | {("shelf_bin", "other", 1): Outcome(1.0, None)}
    assert set(log_ratios(lost, "shelf_bin", "other")) == {0, 2}
    assert "not compared" in report(outcomes_with(0.8, posed=0.5), ["default", "other"])


def test_the_bootstrap_resamples_recordings_of_the_same_images_together() -> None:
    ratios = {"a": {0: math.log(0.5)}, "a2": {0: math.log(0.5)}, "b": {0: math.log(2.0)}}
    low, high = interval(ratios, {"a": "a", "a2": "a", "b": "b"})
    assert low == pytest.approx(0.5)
    assert high == pytest.approx(2.0)
    assert math.isnan(interval(ratios, dict.fromkeys(ratios, "a"))[0])
    alone = {case: found for case, found in outcomes_with(0.8).items() if case[0] == "shelf_bin"}
    assert report(alone, ["default", "other"]).splitlines()[-1].endswith("| **0.80** |")
