"""Whole runs beside the default: ratios, intervals, kept features, matches without ratio test, weights in the hook."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from experiments import kept_features
from experiments.better_front_end.parts import Mutual
from experiments.match_weights.hook import (
    BOUND,
    FAR_PX,
    Alike,
    HookWeights,
    Learned,
    Shown,
    as_in_tracking,
    between,
    refine_shown,
    save,
    shown_of,
    smooth_residuals,
)
from experiments.match_weights.training import Settings, losses, train
from experiments.recordings import Outcome, Outcomes, geometric_mean, interval, log_ratios, report
from tests.experiments.test_match_weights import simulated
from torchslam import ORB, SLAM, load_config, open_sequence
from torchslam.errors import ConfigError
from torchslam.tracking.matcher import DescriptorMatcher, Prior
from torchslam.types import View

ROOM = "synthetic:room?frames=14"


def outcomes_with(ratio: float, posed: float = 1.0) -> Outcomes:
    found: Outcomes = {}
    for label, ate in (("kitti07", 0.4), ("kitti07, 685 px", 0.1), ("shelf_bin", 0.003)):
        for seed in (0, 1, 2):
            found[label, "default", seed] = Outcome(1.0, ate)
            found[label, "other", seed] = Outcome(posed, ratio * ate)
    return found


def test_ratios_are_those_of_errors_whatever_their_size() -> None:
    outcomes = outcomes_with(0.8)
    ratios = {label: log_ratios(outcomes, label, "other") for label in ("kitti07", "shelf_bin")}
    assert geometric_mean(ratios) == pytest.approx(0.8)
    assert "**0.80** (0.80 to 0.80)" in report(outcomes, ["default", "other"])


def test_what_poses_less_is_not_compared() -> None:
    assert log_ratios(outcomes_with(0.8, posed=0.85), "shelf_bin", "other") == {}
    lost = outcomes_with(0.8) | {("shelf_bin", "other", 1): Outcome(1.0, None)}
    assert set(log_ratios(lost, "shelf_bin", "other")) == {0, 2}
    assert "not compared" in report(outcomes_with(0.8, posed=0.5), ["default", "other"])


def test_an_interval_draws_recordings_of_the_same_images_together() -> None:
    ratios = {"a": {0: math.log(0.5)}, "a2": {0: math.log(0.5)}, "b": {0: math.log(2.0)}}
    low, high = interval(ratios, {"a": "a", "a2": "a", "b": "b"})
    assert low == pytest.approx(0.5)
    assert high == pytest.approx(2.0)
    assert math.isnan(interval(ratios, dict.fromkeys(ratios, "a"))[0])
    alone = {case: found for case, found in outcomes_with(0.8).items() if case[0] == "shelf_bin"}
    assert report(alone, ["default", "other"]).splitlines()[-1].endswith("| **0.80** |")


def test_kept_features_are_those_of_the_front_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kept_features, "FOLDER", tmp_path)
    image = open_sequence(ROOM).image(0)
    kept, own = kept_features.ORB(200), ORB(200)(image)
    first = kept(image)
    monkeypatch.setattr(kept, "front_end", None)  # it is not asked again
    for found in (first, kept(image)):
        for name, values in vars(own).items():
            assert values is None or torch.equal(getattr(found, name), values), name
    assert len(list(tmp_path.rglob("*.pt"))) == 1


def room_views() -> tuple[View, View]:
    sequence = open_sequence(ROOM)
    orb = ORB(300)
    like = torch.zeros(0, dtype=torch.float64)
    one, other = (View.of(sequence[index], orb(sequence.image(index)), like) for index in (0, 1))
    return one, other


def test_without_ratio_test_what_is_hard_to_tell_apart_matches_too() -> None:
    def view(*angles: float) -> View:
        turned = torch.tensor(angles, dtype=torch.float64)
        described = torch.stack([turned.cos(), turned.sin()], -1).float()
        ones, keypoints = torch.ones(len(angles)).double(), torch.zeros(len(angles), 2).double()
        return View(0, 0.0, keypoints, ones, 0 * ones, described, ones > 0)

    one, other = view(0.0, 2.0), view(0.100, 0.105, 2.1)
    for prior in (None, Prior(radius_px=torch.full((2,), 20.0), ratio=0.9)):
        strict = DescriptorMatcher(load_config().matching)(one, other, prior)
        found = Mutual()(one, other, prior)
        assert strict.mask.tolist() == [[False, True]]
        assert found.mask.tolist() == [[True, True]]
        assert found.indices_2.tolist() == [[0, 2]]


def test_a_smooth_motion_of_the_image_is_no_disagreement() -> None:
    generator = torch.Generator().manual_seed(0)
    pixels = 600 * torch.rand(1, 80, 2, generator=generator, dtype=torch.float64)
    offsets = pixels @ torch.tensor([[0.01, -0.02], [0.0, 0.03]], dtype=torch.float64) + 3
    offsets[0, :5] += 7.0
    residuals = smooth_residuals(pixels, offsets, torch.ones(1, 80, dtype=torch.bool))
    assert float(residuals[0, 5:].max()) < 0.2
    assert float((residuals[0, :5] - 7 * math.sqrt(2)).abs().max()) < 0.2


def test_problems_as_in_tracking_keep_what_is_near_and_alike() -> None:
    problems = simulated()
    far = replace(problems, pixels=problems.pixels + 100 * (torch.arange(60) < 5)[:, None])
    kept = as_in_tracking(far)
    assert 0 < len(kept) <= len(far)
    assert not bool(kept.mask[:, :5].any())
    offsets = shown_of(problems).offsets.norm(dim=-1)
    assert float((offsets < FAR_PX).double().mean()) > 0.5


def test_the_hook_learns_that_the_distance_of_descriptors_tells_the_noise() -> None:
    problems = simulated(count=48)
    network = HookWeights(width=8)
    units = torch.full((len(problems), 2), 0.01, dtype=torch.float64)
    before = losses(network, problems, units, refine_shown).mean()
    train(network, [problems], Settings(steps=30, batch=8, matches=60), refine_shown)
    shown = shown_of(problems)
    factors = network(shown.cues(), shown.mask)
    noisy = (problems.cues.distances > 30) & shown.mask
    assert losses(network, problems, units, refine_shown).mean() < 0.98 * before
    assert factors[noisy].mean() < 0.7 * factors[~noisy & shown.mask].mean()
    assert 1 / BOUND <= float(factors.detach().min()) <= float(factors.detach().max()) <= BOUND


def untrained(tmp_path: Path) -> Path:
    save(HookWeights(), tmp_path / "network.pt")
    return tmp_path / "network.pt"


def test_in_the_hook_it_is_shown_what_it_was_trained_on() -> None:
    one, other = room_views()
    found = DescriptorMatcher(load_config().matching)(one, other, Prior(torch.full((300,), 20.0), 0.9))
    shown = between(one, other, found)
    assert isinstance(shown, Shown)
    assert shown.cues().shape == (1, int(found.mask.sum()), 12)
    torch.testing.assert_close(shown.bits, found.distances[found.mask][None].double())
    assert bool((shown.seconds_1 >= shown.bits).all())
    assert bool((shown.seconds_2 >= shown.bits).all())


def test_untrained_weights_are_all_alike_in_a_run(tmp_path: Path) -> None:
    room = open_sequence(ROOM)
    config = load_config(None, ["features.num_keypoints=400"])
    runs = [
        SLAM(room.camera, config, matcher=one).run(room) for one in (Alike(), Learned(untrained(tmp_path)))
    ]
    assert len(runs[0].trajectory) >= 12
    assert torch.equal(runs[0].trajectory.T_wc, runs[1].trajectory.T_wc)


def test_weights_reach_the_observations_of_a_run(tmp_path: Path) -> None:
    """What says that the ATE can change at all."""
    network = HookWeights()
    torch.nn.init.normal_(network.last.weight, generator=torch.Generator().manual_seed(0))
    save(network, tmp_path / "network.pt")
    room = open_sequence(ROOM)
    config = load_config(None, ["features.num_keypoints=400"])
    graph = SLAM(room.camera, config, matcher=Learned(tmp_path / "network.pt")).run(room).graph
    assert len(torch.unique(graph.weights)) > 100


def test_another_file_is_no_network(tmp_path: Path) -> None:
    (tmp_path / "x.pt").write_bytes(b"nothing")
    with pytest.raises(ConfigError, match="not the weights of such a network"):
        Learned(tmp_path / "x.pt")
