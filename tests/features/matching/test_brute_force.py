from __future__ import annotations

import math
from dataclasses import replace

import cv2
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from tests.features.matching.random_features import distances_between, disturbed, features, pairs
from torchslam.features import hamming, match, match_by_projection, match_pairs
from torchslam.types import Features


def reference(
    d: Tensor, first: Tensor, second: Tensor, ratio: float, mutual: bool, limit: float
) -> dict[int, int]:
    """Matching of one pair of sets, one row after the other, from the matrix of distances."""
    d = d.clone()
    d[~first], d[:, ~second] = math.inf, math.inf
    claims: dict[int, tuple[float, int]] = {}
    for i in range(d.shape[0]):
        if not first[i] or not second.any():
            continue
        j = int(d[i].argmin())
        nearest = float(d[i, j])
        others = torch.cat([d[i, :j], d[i, j + 1 :]])
        rival = float(others.min()) if len(others) else math.inf
        good = (
            nearest <= limit and nearest < ratio * rival and (not mutual or nearest <= float(d[:, j].min()))
        )
        if good and (nearest, i) < claims.get(j, (math.inf, -1)):
            claims[j] = (nearest, i)
    return {i: j for j, (_, i) in claims.items()}


@pytest.mark.parametrize("floats", [None, 16])
@pytest.mark.parametrize("mutual", [True, False])
@given(seed=st.integers(0, 1000), ratio=st.sampled_from([0.7, 0.9, math.inf]))
@settings(max_examples=15, deadline=None)
def test_match_equals_brute_force(floats: int | None, mutual: bool, seed: int, ratio: float) -> None:
    first = features(2, 30, seed, floats)
    second = disturbed(first, seed + 1)
    limit = 40 if floats is None else 0.2
    matches = match(first, second, None if ratio == math.inf else ratio, mutual, limit)
    d = distances_between(first, second)
    for row in range(2):
        expected = reference(d[row], first.mask[row], second.mask[row], ratio, mutual, limit)
        assert pairs(matches, row) == expected
        kept = matches.mask[row]
        i, j = matches.indices_1[row][kept], matches.indices_2[row][kept]
        torch.testing.assert_close(matches.distances[row][kept], d[row][i, j])
    assert not matches.indices_1[~matches.mask].any()
    assert not matches.indices_2[~matches.mask].any()


@pytest.mark.parametrize("floats", [None, 16])
@given(seed=st.integers(0, 1000), ratio=st.sampled_from([0.9, math.inf]), limited=st.booleans())
@settings(max_examples=15, deadline=None)
def test_forbidden_pairs_have_infinite_distance(
    floats: int | None, seed: int, ratio: float, limited: bool
) -> None:
    first = features(2, 30, seed, floats)
    second = disturbed(first, seed + 1)
    allowed = torch.rand(2, 30, 30, generator=torch.Generator().manual_seed(seed)) < 0.5
    allowed[:, 3] = False  # a column without allowed pairs
    limit = (40 if floats is None else 0.2) if limited else None
    matches = match(first, second, None if ratio == math.inf else ratio, True, limit, allowed=allowed)
    d = distances_between(first, second).masked_fill(~allowed, math.inf)
    for row in range(2):
        possible = first.mask[row] & (allowed[row] & second.mask[row]).any(1)
        expected = reference(d[row], possible, second.mask[row], ratio, True, limit or 1e9)
        assert pairs(matches, row) == expected


def test_match_agrees_with_opencv() -> None:
    first = features(1, 500, 3)
    first = replace(first, mask=torch.ones_like(first.mask))
    second = disturbed(first, 4, flips=60)
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
    found = matcher.match(first.descriptors[0].numpy(), second.descriptors[0].numpy())
    ours = match(first, second, ratio=None, max_distance=None)
    # Of several nearest neighbors at one distance OpenCV may take another.
    d = hamming(first.descriptors, second.descriptors)[0]
    unique = {
        i
        for i in range(500)
        if (d[i] == d[i].min()).sum() == 1 and (d[:, d[i].argmin()] == d[i].min()).sum() == 1
    }
    expected = {m.queryIdx: m.trainIdx for m in found if m.queryIdx in unique}
    assert {i: j for i, j in pairs(ours).items() if i in unique} == expected
    assert len(expected) > 400


def test_equal_descriptors_are_used_once() -> None:
    one = features(1, 4)
    same = replace(one, descriptors=torch.zeros_like(one.descriptors), mask=torch.ones_like(one.mask))
    assert pairs(match(same, same, ratio=None)) == {0: 0}
    assert pairs(match(same, same, ratio=0.8)) == {}


def test_many_columns_need_wider_keys(monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = features(1, 40, 1), features(1, 50, 2)
    expected = match(first, second, max_distance=None)
    # The last of 9000 keypoints has the index that would not fit.
    far = 9000
    grown = second.rows(torch.arange(far) % 50)
    mask = torch.zeros_like(grown.mask)
    mask[:, -50:] = second.mask
    matches = match(first, replace(grown, mask=mask), max_distance=None)
    assert {i: j - far + 50 for i, j in pairs(matches).items()} == pairs(expected)
    # Who may match is said by a mask of pairs as well.
    allowed = mask[:, None].expand(1, 40, far)
    matches = match(first, replace(grown, mask=torch.ones_like(mask)), max_distance=None, allowed=allowed)
    assert {i: j - far + 50 for i, j in pairs(matches).items()} == pairs(expected)


@pytest.mark.parametrize("rows", [0, 5])
def test_match_of_empty_sets(rows: int) -> None:
    matches = match(features(2, rows), features(2, 0))
    assert matches.mask.shape == (2, rows)
    assert not matches.mask.any()


def test_match_of_masked_sets() -> None:
    first = features(1, 10)
    empty = replace(first, mask=torch.zeros_like(first.mask))
    for pair in ((first, empty), (empty, first)):
        matches = match(*pair)
        assert not matches.mask.any()
        assert matches.distances.isfinite().all()


def test_a_lone_candidate_passes_the_ratio_test() -> None:
    first = features(1, 1)
    first = replace(first, mask=torch.ones_like(first.mask))
    assert pairs(match(first, first)) == {0: 0}


@pytest.mark.usefixtures("without_shape_checks")
def test_match_refuses_descriptors_of_two_kinds() -> None:
    with pytest.raises(ValueError, match="descriptors"):
        match(features(1, 4), features(1, 4, floats=32))
    with pytest.raises(ValueError, match="descriptors"):
        match(features(1, 4), features(2, 4))


@pytest.mark.parametrize("floats", [None, 8])
def test_soft_weights_are_a_dual_softmax(floats: int | None) -> None:
    first = features(2, 12, 5, floats)
    second = disturbed(first, 6)
    temperature = 10.0 if floats is None else 0.1
    matches = match(first, second, None, True, None, temperature=temperature)
    assert matches.weights is not None
    logits = -distances_between(first, second) / temperature
    logits = logits.masked_fill(~(first.mask[:, :, None] & second.mask[:, None]), -torch.inf)
    both = (logits.softmax(2).nan_to_num() * logits.softmax(1).nan_to_num()).gather(
        2, matches.indices_2[..., None]
    )
    torch.testing.assert_close(matches.weights, both[..., 0] * matches.mask)
    allowed = torch.rand(2, 12, 12, generator=torch.Generator().manual_seed(7)) < 0.5
    matches = match(first, second, None, True, None, temperature, allowed)
    logits = logits.masked_fill(~allowed, -torch.inf)
    both = logits.softmax(2).nan_to_num() * logits.softmax(1).nan_to_num()
    assert matches.weights is not None
    chosen = both.gather(2, matches.indices_2[..., None])[..., 0]
    torch.testing.assert_close(matches.weights, chosen * matches.mask)


def test_soft_weights_and_distances_pass_gradcheck() -> None:
    base = features(1, 6, 7, 5)
    first, second = base.descriptors.double(), disturbed(base, 8).descriptors.double()

    def outputs(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
        pair = replace(base, descriptors=a), replace(disturbed(base, 8), descriptors=b)
        matches = match(*pair, None, True, None, temperature=0.2)
        assert matches.weights is not None
        return matches.distances, matches.weights

    assert torch.autograd.gradcheck(outputs, (first.requires_grad_(), second.requires_grad_()))


def test_matching_moves_to_the_device(device: torch.device) -> None:
    first = features(2, 40, 12)
    second = disturbed(first, 13)
    expected = match(first, second)
    found = match(first.to(device), second.to(device))
    assert torch.equal(found.indices_2.cpu(), expected.indices_2)
    moved = first.to(device)
    projected = match_by_projection(moved.descriptors, moved.keypoints, 30.0, second.to(device))
    assert projected.mask.device.type == device.type


@pytest.mark.parametrize("wrong", [1.1, 0.5, torch.nan, torch.inf])
def test_descriptors_of_another_length_are_an_error(wrong: float) -> None:
    generator = torch.Generator().manual_seed(0)
    descriptors = torch.nn.functional.normalize(torch.randn(1, 5, 8, generator=generator), dim=-1)
    ones = torch.ones(1, 5)
    features = Features(torch.zeros(1, 5, 2), ones, ones, 0 * ones, descriptors, ones > 0)
    spoilt = descriptors.clone()
    spoilt[0, 3] *= wrong
    words = r"unit length.*normalize\(descriptors, dim=-1\)"
    with pytest.raises(ValueError, match=words):
        match(features, replace(features, descriptors=spoilt))
    with pytest.raises(ValueError, match=words):
        match_by_projection(spoilt, torch.zeros(1, 5, 2), 5.0, features)
    with pytest.raises(ValueError, match=words):
        match_pairs(descriptors[0], spoilt[0], torch.arange(5), torch.arange(5), 0.5)


def test_half_precision_and_missing_descriptors_are_refused() -> None:
    generator = torch.Generator().manual_seed(0)
    descriptors = torch.nn.functional.normalize(torch.randn(1, 5, 8, generator=generator), dim=-1)
    descriptors = descriptors.bfloat16().float()
    ones = torch.ones(1, 5)
    mask = torch.tensor([[True, True, True, True, False]])
    described = torch.where(mask[..., None], descriptors, 0.0)
    features = Features(torch.zeros(1, 5, 2), ones, ones, 0 * ones, described, mask)
    assert match(features, features, ratio=None, max_distance=0.5).mask.tolist() == mask.tolist()


@pytest.mark.parametrize("floats", [None, 16])
@given(seed=st.integers(0, 1000), share=st.sampled_from([0.0, 0.3, 1.0]))
@settings(max_examples=15, deadline=None)
def test_pairs_match_as_all_against_all_where_only_they_are_allowed(
    floats: int | None, seed: int, share: float
) -> None:
    first = features(1, 30, seed, floats)
    second = disturbed(first, seed + 1)
    limit = 40 if floats is None else 0.2
    allowed = torch.rand(30, 30, generator=torch.Generator().manual_seed(seed)) < share
    allowed &= first.mask[0, :, None] & second.mask[0]
    wanted = match(first, second, None, max_distance=limit, allowed=allowed[None])
    rows, columns = match_pairs(
        first.descriptors[0], second.descriptors[0], *allowed.nonzero(as_tuple=True), limit
    )
    assert pairs(wanted) == dict(zip(rows.tolist(), columns.tolist(), strict=True))
    assert (rows.diff() > 0).all()
