"""Images of any size: large ones are looked at reduced, and thresholds in pixels grow with them."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import pytest
import torch

from torchslam import SLAM
from torchslam.config import Config, FeaturesConfig
from torchslam.data import open_sequence
from torchslam.data.transforms import resize
from torchslam.features import match
from torchslam.system.front_end import WithFeatures, image_extractor, reduced
from torchslam.system.run import Run
from torchslam.types import Features, Frame

WALK = "synthetic:room?frames=12"


@pytest.mark.parametrize(
    ("size", "factor"),
    [
        ((320, 240), 1), ((640, 480), 1), ((1241, 376), 1), ((768, 640), 1), ((769, 640), 1.265734),
        ((1280, 960), 2), ((1920, 1440), 3), ((1920, 1080), 2.598076),
    ],
)  # fmt: skip
def test_only_much_larger_images_are_reduced(size: tuple[int, int], factor: float) -> None:
    assert FeaturesConfig().reduction(size) == pytest.approx(factor, rel=1e-5)
    assert FeaturesConfig(max_image_pixels=0).reduction(size) == 1
    assert FeaturesConfig(kind="simulated").reduction(size) == 1
    assert FeaturesConfig(max_image_pixels=1280 * 960).reduction((1920, 1440)) == pytest.approx(1.5)


def test_reduction_does_not_alias() -> None:
    """Stripes finer than the pixels of the reduced image become gray; a mask stays one."""
    image = (torch.arange(64) % 2).float().expand(1, 1, 48, 64)
    small, mask = reduced(image, torch.ones(1, 1, 48, 64, dtype=torch.bool), 2.0)
    assert small.shape == (1, 1, 24, 32)
    assert float((small[..., 2:-2] - 0.5).abs().max()) < 0.05
    assert mask is not None
    assert mask.dtype == torch.bool
    assert bool(mask.all())


@lru_cache
def seen(width: int, height: int, image_pixels: int = 640 * 480) -> Features:
    """The features of a rendered image at another size."""
    frame = resize(open_sequence(WALK), f"{width}x{height}")[0]
    return image_extractor(Config(features=FeaturesConfig(max_image_pixels=image_pixels)))(frame)


@pytest.mark.parametrize("size", [(1280, 960), (1500, 1000)])
def test_a_large_image_has_the_keypoints_of_a_small_one(size: tuple[int, int]) -> None:
    small, large = seen(640, 480), seen(*size)
    matches = match(small, large)
    first, second = matches.indices_1[0][matches.mask[0]], matches.indices_2[0][matches.mask[0]]
    ratio = torch.tensor(size) / torch.tensor([640, 480])
    assert len(first) > 0.6 * int(small.mask.sum())
    off = (large.keypoints[0][second] + 0.5) / ratio - 0.5 - small.keypoints[0][first]
    off = off[off.norm(dim=-1) < 3]
    assert len(off) > 0.55 * int(small.mask.sum())
    assert float(off.mean(0).abs().max()) < 0.06
    assert float(off.norm(dim=-1).median()) < 0.4
    scale = large.scales[0][second] / small.scales[0][first]
    assert float(scale.median()) == pytest.approx(float(ratio.prod().sqrt()), rel=0.01)
    assert bool((large.keypoints[0][:, 0] > 0.9 * size[0]).any())


def test_images_that_are_not_reduced_are_unchanged() -> None:
    assert float(seen(1280, 960, 0).scales.min()) == 1
    assert float(seen(1280, 960).scales[0][seen(1280, 960).mask[0]].min()) == 2


def test_a_mask_applies_to_the_large_image() -> None:
    frame = resize(open_sequence(WALK), "1280x960")[0]
    wanted = (torch.arange(1280) < 333).expand(frame.image.shape)
    found = image_extractor(Config())(replace(frame, mask=wanted))
    x = found.keypoints[found.mask][:, 0]
    assert 300 < float(x.max()) <= 332.5
    assert int(found.mask.sum()) > 300  # the budget goes there


def test_thresholds_grow_with_the_image() -> None:
    small, large = (SLAM(resize(open_sequence(WALK), size).camera) for size in ("640x480", "1280x960"))
    for before, after in zip(thresholds_px(small), thresholds_px(large), strict=True):
        assert after == 2 * before
    assert large.scene_filter.static_overlay.evidence.shape == (121, 161)


def thresholds_px(slam: SLAM) -> tuple[float, ...]:
    start, overlay = slam._state_machine.map_start.initializer, slam.scene_filter.static_overlay
    return (
        start.threshold_px, start.min_motion_px, start.max_static_px, start.turning.threshold_px,
        slam.tracker.localizer.threshold_px, overlay.cell_px, overlay.reduction,
        slam.scene_filter.independent_motion.reduction,
    )  # fmt: skip


def run(size: str) -> Run:
    walk = resize(open_sequence(WALK), size)
    return SLAM(walk.camera).run(walk)


def test_a_trajectory_is_the_same_at_another_image_size() -> None:
    small, large = run("640x480"), run("1920x1440")
    assert all(result.T_cw is not None for result in large.results[5:])
    keyframes = [one.map.num_keyframes for one in (small, large)]
    assert max(keyframes) <= 1.3 * min(keyframes)
    assert large.camera.size == (1920, 1440)
    assert float(large.graph.pixels[:, 0].max()) > 1280


def test_features_of_a_sequence_keep_no_activations() -> None:
    gain = torch.ones((), requires_grad=True)

    def extract(frame: Frame) -> Features:
        features = image_extractor(Config())(frame)
        return replace(features, descriptors=features.descriptors.float() * gain)

    frames = WithFeatures(open_sequence(WALK), extract)
    found, again = frames[0].features, frames.features(0)
    assert found is not None
    assert again is not None
    assert found.mask.any()
    assert not found.descriptors.requires_grad
    assert torch.equal(found.descriptors, again.descriptors)
