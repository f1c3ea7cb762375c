"""Matchers of kornia as they are: what they match, by object and by name."""

from __future__ import annotations

import kornia.feature as KF
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from torchslam import load_config, match
from torchslam.errors import ConfigError
from torchslam.features import pack_bits
from torchslam.tracking.learned_matchers import KorniaMatcher
from torchslam.tracking.matcher import make_matcher, run_matcher
from torchslam.types import FrameFeatures

COUNT, NOISE = 40, 0.3
PLAIN = load_config().matching


def views(is_binary: bool = False) -> tuple[FrameFeatures, FrameFeatures]:
    """Two views of the same points, shifted, in another order; a fifth of the rows of each are padding."""
    generator = torch.Generator().manual_seed(0)
    described = torch.randn(COUNT, 256, generator=generator)
    keypoints = 20 + 200 * torch.rand(COUNT, 2, generator=generator, dtype=torch.float64)
    order = torch.randperm(COUNT, generator=generator)
    mask = torch.rand(2, COUNT, generator=generator) < 0.8
    scales = 1 + torch.rand(COUNT, generator=generator, dtype=torch.float64)
    angles = torch.rand(COUNT, generator=generator, dtype=torch.float64)

    def view(index: int, rows: Tensor, shift: float) -> FrameFeatures:
        noisy = described[rows] + NOISE * torch.randn(COUNT, 256, generator=generator)
        seen = pack_bits(noisy > 0) if is_binary else F.normalize(noisy, dim=-1)
        return FrameFeatures(
            index, 0.0, keypoints[rows] + shift, scales[rows], angles[rows], seen, mask[index]
        )

    return view(0, torch.arange(COUNT), 0.0), view(1, order, 5.0)


@pytest.mark.parametrize("mode", ["mnn", "smnn"])
def test_pairs_are_those_of_kornia_in_rows_of_the_views(mode: str) -> None:
    one, two = views()
    module = KF.DescriptorMatcher(mode, 0.9)
    pairs = run_matcher(make_matcher(PLAIN, module), one, two)
    _, expected = module(one.descriptors[one.mask], two.descriptors[two.mask])
    assert len(expected) > COUNT // 3
    rows = [torch.nonzero(view.mask)[:, 0] for view in (one, two)]
    assert torch.equal(pairs.first, rows[0][expected[:, 0]])
    assert torch.equal(pairs.second, rows[1][expected[:, 1]])
    assert pairs.weights is None
    named = make_matcher(load_config(None, ["matching.matcher=kornia:DescriptorMatcher"]).matching)
    assert isinstance(named, KorniaMatcher)
    assert isinstance(named.module, KF.DescriptorMatcher)


def test_of_several_matches_of_one_keypoint_the_best_is_kept() -> None:
    one, two = views()
    found = KorniaMatcher(KF.DescriptorMatcher("nn"))(one, two)
    kept = found.mask[0]
    assert int(kept.sum()) < len(kept) == int(one.mask.sum())  # each of the first finds something
    for row in found.indices_2[0].unique():
        is_of_it = found.indices_2[0] == row
        assert int((kept & is_of_it).sum()) == 1
        assert found.distances[0, kept & is_of_it] == found.distances[0, is_of_it].min()


def test_bits_are_matched_by_their_hamming_distance() -> None:
    one, two = views(is_binary=True)
    pairs = run_matcher(make_matcher(PLAIN, KF.DescriptorMatcher("mnn")), one, two)
    expected = match(one.features, two.features, ratio=None, mutual=True, max_distance=256)
    mask = expected.mask[0]
    assert set(zip(pairs.first.tolist(), pairs.second.tolist(), strict=True)) == set(
        zip(expected.indices_1[0, mask].tolist(), expected.indices_2[0, mask].tolist(), strict=True)
    )


@pytest.mark.parametrize("mode", ["fginn", "adalam"])
def test_regions_are_given_to_those_that_take_them(mode: str) -> None:
    one, two = views()
    module = KF.GeometryAwareDescriptorMatcher(mode)
    pairs = run_matcher(make_matcher(PLAIN, module), one, two)
    assert len(pairs.first) > 5
    shift = two.keypoints[pairs.second] - one.keypoints[pairs.first]
    assert float((shift - 5).abs().median()) < 1e-6
    seen: list[Tensor] = []
    module.register_forward_pre_hook(lambda _, given: seen.extend(given))
    KorniaMatcher(module)(one, two)
    torch.testing.assert_close(KF.get_laf_center(seen[2])[0], one.keypoints[one.mask].float())
    torch.testing.assert_close(KF.get_laf_scale(seen[2])[0, :, 0, 0], 9.6 * one.scales[one.mask].float())
    torch.testing.assert_close(
        KF.get_laf_orientation(seen[2])[0, :, 0].deg2rad(), one.angles[one.mask].float()
    )


def test_lightglue_by_name_has_the_weights_of_the_features(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a network: with weights of chance, which match little; its scores are weights."""
    asked = []
    monkeypatch.setattr(
        "kornia.feature.lightglue.load_state_dict_from_url", lambda url, **_: asked.append(url) or {}
    )
    settings = load_config(None, ["matching.matcher=kornia:LightGlueMatcher"]).matching
    matcher = make_matcher(settings, features="kornia:DISK")
    assert isinstance(matcher, KorniaMatcher)
    assert matcher.weighs
    assert len(asked) == 1
    assert all("disk" in url for url in asked[0])
    # Of width 128, as DISK's descriptors.
    one, two = (
        FrameFeatures(0, 0.0, v.keypoints, v.scales, v.angles, v.descriptors[:, :128], v.mask)
        for v in views()
    )
    matcher.module.matcher.conf.filter_threshold = 0.0
    pairs = run_matcher(matcher, one, two)
    assert pairs.weights is not None
    assert len(pairs.weights) == len(pairs.first) > 0
    with pytest.raises(
        ConfigError, match="LightGlueMatcher: has no weights for the features 'orb', but for aliked"
    ):
        make_matcher(settings, features="orb")
    own = load_config(None, ["matching.matcher=kornia:LightGlueMatcher", "matching.weights=mine"]).matching
    with pytest.raises(ConfigError, match="takes no weights from a file; `lightglue` does"):
        make_matcher(own, features="kornia:DISK")


def test_views_without_keypoints_have_no_matches() -> None:
    one, two = views()
    empty = FrameFeatures(
        0, 0.0, two.keypoints, two.scales, two.angles, two.descriptors, torch.zeros_like(two.mask)
    )
    for pair in ((one, empty), (empty, two)):
        assert len(run_matcher(KorniaMatcher(KF.DescriptorMatcher()), *pair).first) == 0


@pytest.mark.parametrize("module", [KF.LocalFeatureMatcher(nn.Identity(), nn.Identity()), KF.DISK()])
def test_a_module_that_takes_images_is_refused(module: nn.Module) -> None:
    with pytest.raises(ConfigError, match=r"takes \w+.*, not the descriptors of two views"):
        make_matcher(PLAIN, module)
