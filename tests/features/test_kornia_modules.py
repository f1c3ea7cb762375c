"""Feature extractors of kornia as they are: by name, as an object, and what they become."""

from __future__ import annotations

from pathlib import Path

import kornia.feature as KF
import pytest
import torch
from kornia.filters import GaussianBlur2d
from safetensors.torch import save_file

from torchslam import SLAM, ClipSLAM, Config, evaluate, open_sequence
from torchslam.data.sequence import Sequence
from torchslam.errors import ConfigError
from torchslam.features.kornia_modules import KorniaFeatures, is_kornia_module
from torchslam.plugins import load_feature_extractor
from torchslam.system.front_end import image_extractor


@pytest.fixture(scope="module")
def sequence() -> Sequence:
    return open_sequence("synthetic:room", resize_to="320x240", stride=2, limit=12)


def test_sift_by_name_finds_what_kornia_finds(sequence: Sequence) -> None:
    image = sequence.image(0)
    found = load_feature_extractor("kornia:SIFTFeature", 300, None)(image)
    lafs, scores, descriptors = KF.SIFTFeature(300)(image)
    order = scores[0].argsort(descending=True, stable=True)[: int(KF.laf_is_filled(lafs).sum())]
    count = int(found.mask.sum())
    assert count == len(order) <= 300
    torch.testing.assert_close(found.keypoints[0, :count], KF.get_laf_center(lafs)[0, order])
    torch.testing.assert_close(found.scores[0, :count], scores[0, order])
    cosines = (found.descriptors[0, :count] * descriptors[0, order]).sum(-1) / descriptors[0, order].norm(
        dim=-1
    )
    torch.testing.assert_close(cosines, torch.ones(count))
    scales = (
        KF.get_laf_scale(lafs)[0, order, 0, 0] / 9.6
    )  # of regions of 6 sigma, with a sigma of 1.6 at the finest level
    torch.testing.assert_close(found.scales[0, :count], scales.clamp_min(1.0))
    assert bool((found.scales > 2).any())
    angles = torch.deg2rad(KF.get_laf_orientation(lafs)[0, order, 0])
    torch.testing.assert_close(found.angles[0, :count], angles)


def test_a_run_with_a_feature_extractor_and_a_matcher_of_kornia(sequence: Sequence) -> None:
    matcher, sequence = KF.DescriptorMatcher("mnn"), sequence.part(0, 9)
    run = SLAM(sequence.camera, extractor=KF.SIFTFeature(400), matcher=matcher).run(sequence)
    assert len(run.trajectory) == len(sequence)
    assert sequence.groundtruth is not None
    assert evaluate(run.trajectory, sequence.groundtruth).ate_m < 0.05


@pytest.mark.parametrize("size", [(96, 128), (90, 120)])
def test_disk_has_gradients_and_stays_inside_of_images_of_any_size(size: tuple[int, int]) -> None:
    torch.manual_seed(0)
    extractor = KorniaFeatures(KF.DISK(), 80)
    images = torch.rand(2, 1, *size, requires_grad=True)
    found = extractor(images)
    assert found.keypoints.shape == (2, 80, 2)
    assert bool((found.keypoints[found.mask] <= torch.tensor((size[1] - 1, size[0] - 1))).all())
    assert bool((found.scores.diff(dim=1)[found.mask[:, 1:]] <= 0).all())
    torch.testing.assert_close(found.descriptors[found.mask].norm(dim=-1), torch.ones(int(found.mask.sum())))
    found.descriptors.sum().backward()
    assert images.grad is not None
    assert float(images.grad.abs().sum()) > 0


def test_a_batch_is_as_its_images_one_by_one() -> None:
    torch.manual_seed(0)
    extractor, images = KorniaFeatures(KF.DISK(), 50), torch.rand(2, 1, 64, 64)
    together = extractor(images)
    for row in range(2):
        alone = extractor(images[row : row + 1])
        torch.testing.assert_close(together.keypoints[row], alone.keypoints[0])
        torch.testing.assert_close(together.descriptors[row], alone.descriptors[0])


def test_weights_from_a_file(tmp_path: Path) -> None:
    torch.manual_seed(0)
    module, image = KF.DISK(), torch.rand(1, 1, 64, 64)
    save_file(module.state_dict(), tmp_path / "disk.safetensors")
    found = load_feature_extractor("kornia:DISK", 40, str(tmp_path / "disk.safetensors"))(image)
    torch.testing.assert_close(found.descriptors, KorniaFeatures(module, 40)(image).descriptors)
    save_file({"wrong": torch.zeros(1)}, tmp_path / "wrong.safetensors")
    with pytest.raises(ConfigError, match=r"wrong\.safetensors: no weights of kornia's DISK"):
        load_feature_extractor("kornia:DISK", 40, str(tmp_path / "wrong.safetensors"))


def test_a_module_that_finds_no_keypoints_is_refused(sequence: Sequence) -> None:
    extractor = GaussianBlur2d((3, 3), (1.0, 1.0))
    assert is_kornia_module(extractor)
    extract = image_extractor(Config(), extractor=extractor)
    with pytest.raises(ConfigError, match="GaussianBlur2d: must return one object per image, not Tensor"):
        extract(sequence[0])


def test_an_unknown_name_is_refused() -> None:
    with pytest.raises(ConfigError, match="no 'NoSuchThing'"):
        load_feature_extractor("kornia:NoSuchThing", 40, None)


def test_clips_take_them_too() -> None:
    assert isinstance(ClipSLAM(KF.SIFTFeature(100)).extractor, KorniaFeatures)
