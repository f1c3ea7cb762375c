"""A pose is one of a minimum, or no success: only at a minimum is its gradient right."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.learning.test_clip_slam import BentExtractor, clip_of
from tests.walks import Walk, arc
from torchslam import ClipGraph, ClipPoses, ClipSLAM, Features, clip_loss
from torchslam.learning import clip_slam as clip_module
from torchslam.learning.losses import relative_ate

NOISE_PX = 3.0  # many observations lie where the kernel bends: the way to the minimum is long
FEW, MANY = 0, 5  # seeds of a noise with which it takes 22 iterations, and 57


class Seen:
    """A clip that was looked at, and its true poses."""

    def __init__(self) -> None:
        walk = Walk(arc(10, length=1.0))
        images, self.truth = clip_of(walk)
        self.clip_slam = ClipSLAM(BentExtractor(walk, bend=0.0))
        with torch.no_grad():
            features = self.clip_slam.extract(images)
        assert isinstance(features, Features)
        self.features, self.graph = features, self.clip_slam.build_graph(images, walk.camera)

    def moved(self, seed: int) -> Features:
        """The features with keypoints moved at random, which require a gradient."""
        generator = torch.Generator().manual_seed(seed)
        noise = torch.randn(self.features.keypoints.shape, generator=generator, dtype=torch.float64)
        return replace(self.features, keypoints=(self.features.keypoints + NOISE_PX * noise).requires_grad_())

    def pose(self, features: Features) -> ClipPoses:
        return self.clip_slam.pose(self.graph, features)

    def loss(self, features: Features) -> Tensor:
        return clip_loss(self.pose(features), T_cw_groundtruth=self.truth, error=relative_ate).loss


@pytest.fixture(scope="module")
def seen() -> Seen:
    return Seen()


def test_a_slow_convergence_reaches_the_minimum_with_the_right_gradient(seen: Seen) -> None:
    features = seen.moved(MANY)
    (gradient,) = torch.autograd.grad(seen.loss(features), features.keypoints)
    h, direction = 1e-4, gradient / gradient.norm()
    with torch.no_grad():
        ahead, behind = (
            seen.loss(replace(features, keypoints=features.keypoints + step * direction)) for step in (h, -h)
        )
    assert float((ahead - behind) / (2 * h)) == pytest.approx(float(gradient.norm()), rel=2e-6)


def test_gradients_do_not_depend_on_batching(seen: Seen) -> None:
    features = [seen.moved(seed) for seed in (FEW, MANY)]
    truths = torch.stack([seen.truth, seen.truth])
    together = seen.clip_slam.pose(ClipGraph.stack([seen.graph, seen.graph]), features)
    clip_loss(together, T_cw_groundtruth=truths, error=relative_ate).loss.backward()
    for each in features:
        (alone,) = torch.autograd.grad(seen.loss(each) / 2, each.keypoints)
        assert each.keypoints.grad is not None
        assert (each.keypoints.grad - alone).norm() < 1e-6 * alone.norm()


def test_unconverged_problems_are_reported_as_failed(seen: Seen, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clip_module, "_ITERATIONS", 40)
    features = [seen.moved(seed) for seed in (FEW, MANY)]
    poses = seen.clip_slam.pose(ClipGraph.stack([seen.graph, seen.graph]), features)
    assert poses.success.tolist() == [True, False]
    assert poses.posed.all()  # there are poses, and nearly the right ones
    assert poses.reasons == ("", "its poses did not converge in 40 iterations: their gradient would be wrong")
    truths = torch.stack([seen.truth, seen.truth])
    loss, failure_rate = clip_loss(poses, T_cw_groundtruth=truths, error=relative_ate, on_failure=1.0)
    assert failure_rate == 0.5
    loss.backward()
    assert (features[0].keypoints.grad != 0).any()
    assert (features[1].keypoints.grad == 0).all()
    assert seen.pose(features[0]).success
