"""Keypoints only where they are wanted."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from torchslam.config import Config
from torchslam.data import open_sequence
from torchslam.errors import FrameError
from torchslam.features import ORB, extractor
from torchslam.features.contract import apply_mask
from torchslam.system.front_end import check_size, image_extractor
from torchslam.types import Features

LEFT = torch.arange(640) < 320


@pytest.fixture(scope="module")
def image() -> torch.Tensor:
    return open_sequence("synthetic:room?frames=2").image(0)


@pytest.mark.parametrize("kind", ["orb", "opencv-orb", "sift"])
def test_masked_areas_have_no_keypoints_and_the_budget_goes_elsewhere(image: torch.Tensor, kind: str) -> None:
    extract, mask = extractor(kind, 300), LEFT.expand(image.shape)
    free, masked = extract(image), extract(image, mask)
    assert bool((free.keypoints[free.mask][:, 0] > 330).any())
    assert float(masked.keypoints[masked.mask][:, 0].max()) < 321
    left = int((free.keypoints[free.mask][:, 0] < 320).sum())
    assert int(masked.mask.sum()) > 1.3 * left
    everything = extract(image, torch.ones_like(mask))
    for name in ("keypoints", "descriptors", "mask"):
        assert torch.equal(getattr(everything, name), getattr(free, name))


def test_each_image_of_a_batch_has_its_own_mask(image: torch.Tensor) -> None:
    extract = ORB(200)
    mask = torch.stack([LEFT.expand(image.shape)[0], ~LEFT.expand(image.shape)[0]])
    both = extract(image.expand(2, -1, -1, -1), mask)
    for row in range(2):
        alone = extract(image, mask[row : row + 1])
        assert torch.equal(both.keypoints[row], alone.keypoints[0])
        assert torch.equal(both.descriptors[row], alone.descriptors[0])


def test_a_mask_that_excludes_everything_gives_no_keypoints(image: torch.Tensor) -> None:
    assert not ORB(100)(image, torch.zeros_like(image, dtype=torch.bool)).mask.any()


@pytest.mark.usefixtures("without_shape_checks")
def test_feature_extractor_passes_the_mask_on(image: torch.Tensor) -> None:
    frame = open_sequence("synthetic:room?frames=2")[0]
    mask = LEFT.expand(image.shape)
    found = image_extractor(Config())(replace(frame, mask=mask))
    assert float(found.keypoints[found.mask][:, 0].max()) < 319.5
    camera = open_sequence("synthetic:room?frames=2").camera
    with pytest.raises(FrameError, match="mask of another shape"):
        check_size(replace(frame, mask=mask[..., :100]), camera)


def test_keypoints_outside_the_mask_are_removed() -> None:
    keypoints = torch.tensor([[[0.4, 0.0], [1.0, 0.6], [2.6, 1.4], [-3.0, 9.0], [0.0, 0.0]]])
    mask = torch.tensor([[True, True, True, True, False]])
    features = Features(keypoints, mask * 1.0, mask * 1.0, mask * 0.0, torch.zeros(1, 5, 32), mask)
    image_mask = torch.tensor([[True, False, False, False], [True, False, False, True]])[None, None]
    assert apply_mask(features, image_mask).mask.tolist() == [[True, False, True, True, False]]


@pytest.mark.parametrize("wrong", [torch.ones(1, 1, 4, 4), torch.ones(1, 1, 8, 4, dtype=torch.bool)])
@pytest.mark.usefixtures("without_shape_checks")
def test_invalid_masks_are_rejected(wrong: torch.Tensor) -> None:
    with pytest.raises(ValueError, match="a mask must be bool"):
        ORB(10)(torch.zeros(1, 1, 8, 8), wrong)
