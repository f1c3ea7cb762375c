"""Learned features: clips, the network that moves keypoints, and a loop that learns."""

from __future__ import annotations

import math
from dataclasses import fields

import pytest
import torch
from torch import Tensor, nn

from experiments.learn_features.clips import Clip, Errors, errors_of, step_of
from experiments.learn_features.front_end import RADIUS, REACH, SubPixel, patches
from experiments.learn_features.pairs import PairErrors, frames_apart, pair_errors
from experiments.learn_features.run import BEFORE, Result, common_pairs, drawing, report
from experiments.learn_features.training import Settings, train
from tests.test_clip import BentEyes
from tests.walks import Walk, arc
from torchslam import ORB, ClipSLAM, Features

CPU = torch.device("cpu")


def errors(position: float, rotation: float, posed: int = 8, seen: int = 800) -> Errors:
    return Errors(torch.tensor(position), torch.tensor(rotation), posed, seen)


def noise_images(seed: int = 0) -> Tensor:
    return torch.rand(1, 1, 96, 128, generator=torch.Generator().manual_seed(seed))


def test_a_clip_has_the_frames_it_says() -> None:
    walk = Walk(arc(20))
    clip = Clip.of(walk, 2, frames=5, step=3, device=CPU)
    assert clip.images.shape == (5, 1, 240, 320)
    for row, index in enumerate((2, 5, 8, 11, 14)):
        assert torch.equal(clip.T_cw[row], walk[index].T_cw_groundtruth)
    with pytest.raises(ValueError, match="lacks frames"):
        Clip.of(walk, 10, frames=5, step=3, device=CPU)
    assert step_of(walk) == 2


def test_drawn_clips_stay_in_their_part() -> None:
    walk = Walk(arc(40))
    draw, generator = drawing(walk, 0.5, 5, CPU), torch.Generator().manual_seed(0)
    known = torch.stack([walk.pose(index) for index in range(20)])
    for _ in range(20):
        clip = draw(generator)
        assert (clip.T_cw[:, None] == known).flatten(2).all(-1).any(-1).all()


def test_patches_are_centred_on_their_pixel() -> None:
    images = noise_images()
    found = patches(images, torch.tensor([[[60.3, 40.4], [20.0, 30.0]]]))
    side = 2 * RADIUS + 1
    expected = images[0, 0, 40 - RADIUS : 41 + RADIUS, 60 - RADIUS : 61 + RADIUS]
    correlation = torch.corrcoef(torch.stack([found[0, 0], expected.flatten()]))[0, 1]
    assert found.shape == (1, 2, side * side)
    assert float(correlation) == pytest.approx(1.0, abs=1e-5)
    torch.testing.assert_close(found.mean(-1), torch.zeros(1, 2), atol=1e-5, rtol=0)


def test_without_training_nothing_moves_and_later_no_further_than_the_reach() -> None:
    images = noise_images()
    front_end = SubPixel(ORB(100))
    plain, moved = front_end.front_end(images), front_end(images)
    assert torch.equal(plain.keypoints, moved.keypoints)
    nn.init.normal_(front_end.moves[-1].weight, std=10.0, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        distance = (front_end(images).keypoints - plain.keypoints).abs()
    assert 0 < float(distance.max()) <= REACH


def test_training_lowers_both_errors() -> None:
    walk = Walk(arc(10, length=1.0))
    clip = Clip.of(walk, 0, frames=10, step=1, device=CPU)
    clip_slam = ClipSLAM(BentEyes(walk, bend=0.02))
    before = errors_of(clip_slam, clip)
    losses = train(clip_slam, lambda _: clip, Settings(steps=4, learning_rate=8e-3, warm_up=1))
    after = errors_of(clip_slam, clip)
    assert len(losses) == 4
    assert float(after.position.detach()) < 0.5 * float(before.position.detach())
    assert float(after.rotation.detach()) < 0.5 * float(before.rotation.detach())


def test_a_front_end_that_knows_the_scene_makes_no_error() -> None:
    walk = Walk(arc(10, length=1.0))
    eyes = BentEyes(walk, bend=0.0, noise_px=0.0)
    apart = frames_apart(walk)

    class Pair(nn.Module):
        def forward(self, images: Tensor) -> Features:
            features = eyes(images)
            return Features(*(getattr(features, c.name)[[2, 2 + apart]] for c in fields(Features)))

    found = pair_errors(Pair(), walk, [2], CPU)
    assert found.inliers[0] > 50
    assert found.rotation[0] < 1e-4
    assert found.direction[0] < 1e-3


def test_the_report_compares_what_all_could_pose() -> None:
    def result(rotations: list[float], inliers: float, clips: list[Errors]) -> Result:
        rotation = torch.tensor(rotations)
        return Result(PairErrors(rotation, 10 * rotation, torch.full_like(rotation, inliers)), clips)

    none = errors(0.5, 0.5, posed=0, seen=0)
    results = {
        BEFORE: {"walk": result([0.002, 0.004, 0.008], 100, [errors(0.01, 0.002), errors(0.04, 0.008)])},
        "other": {"walk": result([0.001, 0.002, math.nan], 80, [errors(0.02, 0.004), none])},
    }
    assert common_pairs(results)["other"].shape == (2, 2)
    text = report(results)
    assert f"| walk | {BEFORE} | 100 | 4.00 | 2.29 | 2 of 2 | 1.00 % |" in text
    assert f"| geometric mean | {BEFORE} | 2 pairs | 2.83 | 1.62 | 1 clips | 1.00 % |" in text
    assert "| geometric mean | other | 2 pairs | 1.41 | 0.81 | 1 clips | 2.00 % |" in text
