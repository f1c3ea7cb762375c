"""Learned features: tracks that are matched once, and the training through them."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn

from experiments.learned_weights.features.front_end import NUM_INPUTS, SubPixel
from experiments.learned_weights.features.tracks import MIN_VIEWS, VIEWS_S, Tracks
from experiments.learned_weights.features.training import (
    Settings,
    draw,
    localization_errors,
    pose_loss,
    train,
)
from tests.learning.test_clip_slam import BentExtractor
from tests.walks import Walk, arc
from torchslam import Features

CPU = torch.device("cpu")
SHIFT_PX = 1.5
KINDS = 4


class WalkExtractor(nn.Module):
    """What a feature extractor that knows the scene sees of a walk, frame after frame."""

    def __init__(self, walk: Walk) -> None:
        super().__init__()
        self.features = BentExtractor(walk, bend=0.0, noise_px=0.0).exact
        self.next = 0

    def forward(self, images: Tensor) -> Features:
        self.next += 1
        return self.features[self.next - 1 : self.next]


def exact_tracks() -> Tracks:
    """Tracks without noise."""
    walk = Walk(arc(16, length=1.5))
    return Tracks.of(WalkExtractor(walk), walk, range(16), CPU)


def disturbed(tracks: Tracks) -> Tracks:
    """Keypoints shifted in one of a few directions, which the patch tells."""
    generator = torch.Generator().manual_seed(0)
    kind = torch.randint(KINDS, tracks.keypoints.shape[:2], generator=generator)
    shifts = SHIFT_PX * torch.tensor([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]], dtype=torch.float64)
    encoded = nn.functional.one_hot(kind, NUM_INPUTS).to(tracks.patches.dtype)
    return replace(tracks, keypoints=tracks.keypoints + shifts[kind], patches=4 * encoded)


@pytest.fixture(scope="module")
def tracks() -> Tracks:
    return exact_tracks()


def test_tracks_of_an_exact_feature_extractor_meet_in_points(tracks: Tracks) -> None:
    assert len(tracks) == 16 - 8  # all views of a problem lie in the part
    assert tracks.frames.shape == (8, len(VIEWS_S))
    assert int(tracks.seen.any(-1).sum(-1).min()) > 50
    assert bool((tracks.seen.sum(-1)[tracks.seen.any(-1)] >= MIN_VIEWS).all())


def test_sampled_points_are_visible_in_the_localized_frame(tracks: Tracks) -> None:
    settings = Settings(problems=5, tracks=12)
    generator = torch.Generator().manual_seed(0)
    for _ in range(5):
        drawn = draw(tracks, settings, generator)
        assert drawn.indices.shape == (5, 12, len(VIEWS_S))
        used = drawn.seen.any(-1)
        assert bool(drawn.seen[..., drawn.query][used].all())
        assert bool((drawn.seen.sum(-1)[used] >= MIN_VIEWS).all())


def test_exact_tracks_have_no_pose_error_and_disturbed_ones_a_gradient(tracks: Tracks) -> None:
    extractor = SubPixel(nn.Identity())
    drawn = draw(tracks, Settings(problems=4), torch.Generator().manual_seed(0))
    errors, success = localization_errors(extractor, tracks, drawn)
    assert bool(success.all())
    assert float(errors.detach().max()) < 1e-5
    errors, success = localization_errors(extractor, disturbed(tracks), drawn)
    assert float(errors.detach().min()) > 1e-4
    errors[success].log1p().sum().backward()
    gradient = extractor.network[-1].weight.grad
    assert gradient is not None
    assert bool(torch.isfinite(gradient).all())
    assert float(gradient.abs().max()) > 0


def test_training_through_poses_lowers_the_pose_errors(tracks: Tracks) -> None:
    wrong = disturbed(tracks)
    extractor = SubPixel(nn.Identity(), width=16)
    fixed = draw(wrong, Settings(problems=8), torch.Generator().manual_seed(5))
    before = float(pose_loss(extractor, wrong, fixed).detach())
    losses = train(extractor, wrong, Settings(steps=120, problems=8, learning_rate=1e-2))
    after = float(pose_loss(extractor, wrong, fixed).detach())
    assert len(losses) == 120
    assert sum(losses[-20:]) < 0.5 * sum(losses[:20])
    assert after < 0.5 * before


def test_the_same_seed_trains_the_same_weights(tracks: Tracks) -> None:
    wrong, settings = disturbed(tracks), Settings(steps=3, problems=4)
    once, again = (train(SubPixel(nn.Identity()), wrong, settings, seed=1) for _ in range(2))
    assert once == again
