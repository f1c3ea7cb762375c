"""Whole runs compared with the default: ratios, intervals, cached features, matches without ratio test."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch

from experiments import cached_features
from experiments.better_front_end.parts import Mutual
from experiments.recordings import Outcome, Outcomes, geometric_mean, interval, log_ratios, report
from torchslam import ORB, load_config, open_sequence
from torchslam.tracking.matcher import DescriptorMatcher
from torchslam.types import FrameFeatures, MatchPrior

ROOM = "synthetic:room?frames=14"


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


def test_cached_features_equal_those_of_the_feature_extractor(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cached_features, "FOLDER", tmp_path)
    image = open_sequence(ROOM).image(0)
    cached_run, own = cached_features.ORB(200), ORB(200)(image)
    first = cached_run(image)
    monkeypatch.setattr(cached_run, "extractor", None)  # it is not called again
    for found in (first, cached_run(image)):
        for name, values in vars(own).items():
            assert values is None or torch.equal(getattr(found, name), values), name
    assert len(list(tmp_path.rglob("*.pt"))) == 1


def test_without_the_ratio_test_ambiguous_keypoints_match() -> None:
    def view(*angles: float) -> FrameFeatures:
        turned = torch.tensor(angles, dtype=torch.float64)
        described = torch.stack([turned.cos(), turned.sin()], -1).float()
        ones, keypoints = torch.ones(len(angles)).double(), torch.zeros(len(angles), 2).double()
        return FrameFeatures(0, 0.0, keypoints, ones, 0 * ones, described, ones > 0)

    one, other = view(0.0, 2.0), view(0.100, 0.105, 2.1)
    for prior in (None, MatchPrior(radius_px=torch.full((2,), 20.0), ratio=0.9)):
        strict = DescriptorMatcher(load_config().matching)(one, other, prior)
        found = Mutual()(one, other, prior)
        assert strict.mask.tolist() == [[False, True]]
        assert found.mask.tolist() == [[True, True]]
        assert found.indices_2.tolist() == [[0, 2]]
