"""Learned features: the network that moves keypoints, clips and pairs to measure it on, and the report."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn

from experiments.learned_weights.features.evaluation import (
    APART_S,
    FRAMES,
    STEP_S,
    Pair,
    PairErrors,
    clip_from,
    pair_errors,
    position_error,
)
from experiments.learned_weights.features.front_end import (
    NUM_INPUTS,
    RADIUS,
    REACH,
    Remembering,
    SubPixel,
    patches,
)
from experiments.learned_weights.features.report import Result, bootstrap, medians, ratios
from experiments.learned_weights.features.run import Part, spread
from tests.learning.test_clip_slam import BentExtractor
from tests.walks import T_cw, Walk, arc, still
from torchslam import ORB, ClipSLAM, Features
from torchslam.evaluation import ate
from torchslam.learning.dataset import frames_in
from torchslam.learning.losses import path_length

CPU = torch.device("cpu")


class PairExtractor(nn.Module):
    """Features of a pair of a walk, from a feature extractor that knows the scene."""

    def __init__(self, extractor: nn.Module, rows: list[int]) -> None:
        super().__init__()
        self.extractor = extractor
        self.rows = rows

    def forward(self, images: Tensor) -> Features:
        features = self.extractor(images)
        return features[self.rows]


def noise_images(seed: int = 0) -> Tensor:
    return torch.rand(1, 1, 96, 128, generator=torch.Generator().manual_seed(seed))


def test_the_error_of_a_clip_is_relative_to_its_path_and_nan_without_poses() -> None:
    walk, standing = Walk(arc(20, length=2.0)), Walk(still(20))
    clip = clip_from(walk, 2, CPU)
    assert torch.equal(clip.T_cw, T_cw(walk)[2:18:2])
    extractor = PairExtractor(BentExtractor(walk, bend=0.01), list(range(2, 18, 2)))
    poses = ClipSLAM(extractor)(clip.images, clip.camera)
    expected = ate(T_cw=poses.T_cw, T_cw_groundtruth=clip.T_cw) / path_length(clip.T_cw)
    assert position_error(ClipSLAM(extractor), clip) == pytest.approx(float(expected.detach()))
    blind = PairExtractor(BentExtractor(standing, bend=0.0), list(range(8)))
    assert math.isnan(position_error(ClipSLAM(blind), clip_from(standing, 0, CPU)))


def test_pairs_and_clips_stay_in_their_split() -> None:
    walk = Walk(arc(100))
    part = Part.of(walk, (0.5, 0.9), pairs=200, clips=3)
    assert part.pairs == list(range(50, 90 - frames_in(APART_S, walk)))
    assert (part.clips[0], part.clips[-1]) == (50, 90 - FRAMES * frames_in(STEP_S, walk))
    assert spread(3, 4, 5) == [4, 5]
    assert spread(0, 4, 5) == []


def test_patches_are_centered_on_their_keypoint() -> None:
    images = noise_images()
    whole = torch.tensor([[[60.0, 40.0], [20.0, 30.0]]])
    found = patches(images, whole)
    expected = images[0, 0, 40 - RADIUS : 41 + RADIUS, 60 - RADIUS : 61 + RADIUS]
    correlation = torch.corrcoef(torch.stack([found[0, 0], expected.flatten()]))[0, 1]
    assert found.shape == (1, 2, NUM_INPUTS)
    assert float(correlation) == pytest.approx(1.0, abs=1e-5)
    torch.testing.assert_close(found.mean(-1), torch.zeros(1, 2), atol=1e-5, rtol=0)


def test_patches_between_pixels_are_interpolated() -> None:
    images = noise_images()
    found = patches(images, torch.tensor([[[60.5, 40.0]]]))[0, 0]
    rows = images[0, 0, 40 - RADIUS : 41 + RADIUS]
    mean = (rows[:, 60 - RADIUS : 61 + RADIUS] + rows[:, 61 - RADIUS : 62 + RADIUS]) / 2
    assert float(torch.corrcoef(torch.stack([found, mean.flatten()]))[0, 1]) == pytest.approx(1.0, abs=1e-5)


def test_offsets_start_at_zero_and_are_bounded() -> None:
    images = noise_images()
    extractor = SubPixel(ORB(100))
    plain, moved = extractor.extractor(images), extractor(images)
    assert torch.equal(plain.keypoints, moved.keypoints)
    nn.init.normal_(extractor.network[-1].weight, std=10.0, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        distance = (extractor(images).keypoints - plain.keypoints).abs()
    assert 0 < float(distance.max()) <= REACH + 1e-4


def test_a_caching_feature_extractor_extracts_an_image_once() -> None:
    prepared: list[Tensor] = []

    class Counting(ORB):
        def forward(self, images: Tensor) -> Features:
            prepared.append(images)
            return super().forward(images)

    extractor = Remembering(Counting(50))
    first, second = noise_images(0), noise_images(1)
    found = extractor(first)
    assert extractor(first) is found
    extractor(second)
    assert torch.equal(extractor(first).keypoints, found.keypoints)
    assert len(prepared) == 3


def test_an_exact_feature_extractor_makes_no_error() -> None:
    walk = Walk(arc(10, length=1.0))
    pair = Pair.of(walk, 2, CPU)
    extractor = PairExtractor(BentExtractor(walk, bend=0.0, noise_px=0.0), [2, 2 + frames_in(APART_S, walk)])
    with torch.no_grad():
        found = pair_errors(extractor(pair.images), pair)
    assert found.inliers[0] > 50
    assert found.rotation[0] < 1e-4
    assert found.direction[0] < 1e-3
    assert found.rotation_halves[0] < 1e-4
    assert found.direction_halves[0] < 1e-3


def result(rotations: list[float], inliers: float, positions: list[float]) -> Result:
    rotation = torch.tensor(rotations)
    pairs = PairErrors(rotation, 10 * rotation, rotation, rotation, torch.full_like(rotation, inliers))
    return Result(pairs, torch.tensor(positions))


def test_the_report_compares_only_clips_that_both_posed() -> None:
    before = {"walk": result([0.002, 0.004, 0.008], 100, [0.01, 0.04])}
    after = {"walk": result([0.001, 0.002, math.nan], 80, [0.02, math.nan])}
    text = medians({"before": before, "after": after})
    assert "| walk | before | 100 | 4.00 | 2.29 | 4.00 | 0.23 | 2 of 2 | 1.00 % |" in text
    assert "| walk | after | 80 | 1.00 |" in text
    text = ratios(before, after)
    assert "| rotation error | 0.50 (0.50 to 0.50) | 0.50 (0.50 to 0.50) |" in text
    assert "| ATE / path | 2.00 (2.00 to 2.00) |" in text
    assert "| inliers | 0.800 | 0.800 |" in text
    assert "ATE" not in ratios(before, {"walk": replace(after["walk"], positions=torch.zeros(0))})


def test_the_interval_is_that_of_a_mean() -> None:
    logs = 0.5 * torch.randn(400, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    low, high = bootstrap([logs[:100], logs[100:]], block=1)
    half = 1.96 * 0.5 / math.sqrt(400)
    assert (math.log(high) - math.log(low)) / 2 == pytest.approx(half, rel=0.15)
    assert math.log(low) < float(logs.mean()) < math.log(high)
    # Neighbors that are all the same are worth one of them.
    low_runs, high_runs = bootstrap([logs[:80].repeat_interleave(5)], block=5)
    assert math.log(high_runs / low_runs) / 2 == pytest.approx(
        1.96 * float(logs[:80].std()) / math.sqrt(80), rel=0.15
    )
