from __future__ import annotations

import math
from contextlib import nullcontext
from dataclasses import replace

import cv2
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import Tensor

from tests.accelerator import simulated_accelerator
from tests.conftest import HAS_SIMULATED_ACCELERATOR
from torchslam.features import expand_runs, hamming, match, match_pairs, match_projected
from torchslam.features.matching.radius_search import nearest_bits, window_pairs
from torchslam.types import Features, Matches

WIDTH, HEIGHT = 320, 240


def features(batch: int, count: int, seed: int = 0, floats: int | None = None) -> Features:
    """Random keypoints, some of them masked."""
    g = torch.Generator().manual_seed(seed)
    keypoints = torch.rand(batch, count, 2, generator=g) * torch.tensor([WIDTH, HEIGHT])
    level = torch.randint(0, 3, (batch, count), generator=g)
    if floats is None:
        descriptors = torch.randint(0, 256, (batch, count, 32), dtype=torch.uint8, generator=g)
    else:
        descriptors = torch.nn.functional.normalize(torch.randn(batch, count, floats, generator=g), dim=-1)
    return Features(
        keypoints=keypoints,
        scores=torch.rand(batch, count, generator=g),
        scales=1.2**level,
        angles=(torch.rand(batch, count, generator=g) * 2 - 1) * math.pi,
        descriptors=descriptors,
        mask=torch.rand(batch, count, generator=g) < 0.9,
    )


def disturbed(first: Features, seed: int, flips: int = 30) -> Features:
    """The same features in another order, with some bits flipped (floats: some noise)."""
    g = torch.Generator().manual_seed(seed)
    order = torch.randperm(first.mask.shape[1], generator=g)
    second = first.rows(order)
    d = second.descriptors
    if d.dtype == torch.uint8:
        noise = torch.rand(*d.shape, 8, generator=g) < flips / 256
        d = d ^ (noise * 2 ** torch.arange(8)).sum(-1).to(torch.uint8)
    else:
        d = torch.nn.functional.normalize(d + 0.1 * torch.randn(d.shape, generator=g), dim=-1)
    return replace(second, descriptors=d)


def pairs(matches: Matches, row: int = 0) -> dict[int, int]:
    kept = matches.mask[row]
    return dict(
        zip(matches.indices_1[row][kept].tolist(), matches.indices_2[row][kept].tolist(), strict=True)
    )


def distances_between(first: Features, second: Features) -> Tensor:
    if first.descriptors.dtype == torch.uint8:
        return hamming(first.descriptors, second.descriptors).float()
    return 1 - first.descriptors @ second.descriptors.mT


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
def test_pairs_that_are_not_allowed_count_as_infinitely_far(
    floats: int | None, seed: int, ratio: float, limited: bool
) -> None:
    first = features(2, 30, seed, floats)
    second = disturbed(first, seed + 1)
    allowed = torch.rand(2, 30, 30, generator=torch.Generator().manual_seed(seed)) < 0.5
    allowed[:, 3] = False  # one that may match nobody
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
    # Of several nearest neighbours at one distance OpenCV may take another.
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
def test_match_of_nothing(rows: int) -> None:
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


def test_soft_weights_and_distances_have_right_gradients() -> None:
    base = features(1, 6, 7, 5)
    first, second = base.descriptors.double(), disturbed(base, 8).descriptors.double()

    def outputs(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
        pair = replace(base, descriptors=a), replace(disturbed(base, 8), descriptors=b)
        matches = match(*pair, None, True, None, temperature=0.2)
        assert matches.weights is not None
        return matches.distances, matches.weights

    assert torch.autograd.gradcheck(outputs, (first.requires_grad_(), second.requires_grad_()))


def naive_projected(
    query: Features,
    pixels: Tensor,
    radius: Tensor,
    second: Features,
    row: int,
    ratio: float,
    limit: float,
    guided: bool,
) -> dict[int, int]:
    d = distances_between(query, second)[row]
    claims: dict[int, tuple[float, int]] = {}
    for i in range(d.shape[0]):
        if not query.mask[row, i]:
            continue
        candidates = []
        for j in range(d.shape[1]):
            apart = (second.keypoints[row, j] - pixels[row, i]).norm()
            factor = float(second.scales[row, j] / query.scales[row, i])
            turn = float((second.angles[row, j] - query.angles[row, i] + math.pi) % (2 * math.pi) - math.pi)
            fits = not guided or (1 / 1.3 <= factor <= 1.3 and abs(turn) <= 0.5)
            if second.mask[row, j] and apart <= radius[row, i] and fits:
                candidates.append((float(d[i, j]), j))
        if not candidates:
            continue
        nearest, j = min(candidates)
        same_scale = [c for c, k in candidates if k != j and second.scales[row, k] == second.scales[row, j]]
        good = nearest <= limit and nearest < ratio * min(same_scale, default=math.inf)
        if good and (nearest, i) < claims.get(j, (math.inf, -1)):
            claims[j] = (nearest, i)
    return {i: j for j, (_, i) in claims.items()}


@pytest.mark.parametrize("floats", [None, 16])
@pytest.mark.parametrize("guided", [True, False])
@given(seed=st.integers(0, 1000), size=st.sampled_from([5.0, 40.0, 400.0]))
@settings(max_examples=10, deadline=None)
def test_match_projected_equals_the_loop(floats: int | None, guided: bool, seed: int, size: float) -> None:
    query = features(2, 25, seed, floats)
    second = disturbed(query, seed + 1)
    g = torch.Generator().manual_seed(seed + 2)
    pixels = query.keypoints + torch.randn(2, 25, 2, generator=g) * 4
    pixels[0, 0], pixels[1, 0], pixels[1, 1] = -1e4, 1e30, math.nan
    radius = size * torch.rand(2, 25, generator=g)
    limit = 60 if floats is None else 0.3
    extras = {"scales": query.scales, "angles": query.angles} if guided else {}
    matches = match_projected(
        query.descriptors,
        pixels,
        radius,
        second,
        query.mask,
        ratio=0.9,
        max_distance=limit,
        scale_tolerance=1.3,
        angle_tolerance=0.5,
        **extras,
    )
    for row in range(2):
        assert pairs(matches, row) == naive_projected(query, pixels, radius, second, row, 0.9, limit, guided)


def test_match_projected_with_one_radius_and_no_limits() -> None:
    first = features(1, 30, 9)
    matches = match_projected(
        first.descriptors, first.keypoints, 1e-3, first, first.mask, ratio=None, max_distance=None
    )
    valid = first.mask[0].nonzero()[:, 0].tolist()
    assert pairs(matches) == {i: i for i in valid}


@pytest.mark.parametrize(("rows", "columns"), [(0, 5), (5, 0), (0, 0)])
def test_match_projected_of_nothing(rows: int, columns: int) -> None:
    query = features(1, rows)
    matches = match_projected(query.descriptors, query.keypoints, 10.0, features(1, columns))
    assert matches.mask.shape == (1, rows)
    assert not matches.mask.any()


def test_match_projected_with_nothing_in_the_windows() -> None:
    first = features(1, 10)
    matches = match_projected(first.descriptors, first.keypoints + 1000, 5.0, first)
    assert not matches.mask.any()
    assert matches.distances.isfinite().all()


def test_match_projected_distances_carry_gradients() -> None:
    base = features(1, 8, 11, 5)

    def distances(a: Tensor, b: Tensor) -> Tensor:
        found = match_projected(
            a, base.keypoints, 50.0, replace(base, descriptors=b), base.mask, max_distance=None
        )
        return found.distances

    a, b = (base.descriptors.double().clone().requires_grad_() for _ in range(2))
    assert torch.autograd.gradcheck(distances, (a, b))


def test_matching_moves_to_the_device(device: torch.device) -> None:
    first = features(2, 40, 12)
    second = disturbed(first, 13)
    expected = match(first, second)
    found = match(first.to(device), second.to(device))
    assert torch.equal(found.indices_2.cpu(), expected.indices_2)
    moved = first.to(device)
    projected = match_projected(moved.descriptors, moved.keypoints, 30.0, second.to(device))
    assert projected.mask.device.type == device.type


@given(
    seed=st.integers(0, 1000),
    batch=st.integers(1, 3),
    spread=st.sampled_from([1.0, 20.0, 1e5]),
    largest=st.sampled_from([0.0, 25.0, 400.0]),
)
@settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)  # of the fixture nothing is kept
def test_windows_hold_what_is_near(
    device: torch.device, seed: int, batch: int, spread: float, largest: float
) -> None:
    """Wherever keypoints are, in front of the first cell and behind the last one too."""
    first, second = features(batch, 60, seed), features(batch, 70, seed + 1)
    places, keypoints = ((view.keypoints.double() - 100) * spread + 100 for view in (first, second))
    keypoints[:, :20] = places[:, :20]  # within a radius of nothing
    radius = largest * torch.rand(batch, 60, generator=torch.Generator().manual_seed(seed)).double()
    inputs = (places, radius, first.mask, keypoints, second.mask)
    row, column = (found.cpu() for found in window_pairs(*(tensor.to(device) for tensor in inputs)))
    squared = (places[:, :, None] - keypoints[:, None]).square().sum(-1)
    near = (squared <= radius.square()[..., None]) & first.mask[..., None] & second.mask[:, None]
    b, i, j = near.nonzero(as_tuple=True)
    assert (row.diff() >= 0).all()
    assert sorted(zip(row.tolist(), column.tolist(), strict=True)) == list(
        zip((b * 60 + i).tolist(), (b * 70 + j).tolist(), strict=True)
    )


@given(
    seed=st.integers(0, 1000), ratio=st.sampled_from([None, 0.5, 0.9]), pairs=st.sampled_from([0, 1, 40, 400])
)
@settings(max_examples=60, deadline=None)
def test_the_nearest_of_pairs(seed: int, ratio: float | None, pairs: int) -> None:
    """As one finds it pair by pair, on the CPU and elsewhere, with many ties."""
    generator = torch.Generator().manual_seed(seed)
    key = torch.randperm(30 * 20, generator=generator)[:pairs].sort().values
    row, column = key // 20, key % 20
    distance = torch.randint(0, 12, (len(key),), generator=generator)
    scales = 1.2 ** torch.randint(0, 3, (20,), generator=generator).double()
    wanted: dict[int, tuple[int, int, int]] = {}
    for i in range(30):
        of_row = sorted((int(d), int(c)) for r, c, d in zip(row, column, distance, strict=True) if r == i)
        if not of_row or of_row[0][0] > 9:
            continue
        nearest, chosen = of_row[0]
        others = [d for d, c in of_row[1:] if scales[c] == scales[chosen]]
        if ratio is not None and others and not nearest < ratio * min(others):
            continue
        wanted[chosen] = min(wanted.get(chosen, (99, 0, 0)), (nearest, i, chosen))
    expected = sorted((i, c, d) for d, i, c in wanted.values())
    with simulated_accelerator() if HAS_SIMULATED_ACCELERATOR else nullcontext(torch.device("cpu")) as other:
        for where in (torch.device("cpu"), other):
            inputs = (tensor.to(where) for tensor in (row, column, distance))
            found = [x.tolist() for x in nearest_bits(*inputs, 30, scales.to(where), ratio, 9)]
            assert list(zip(*found, strict=True)) == expected


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
        match_projected(spoilt, torch.zeros(1, 5, 2), 5.0, features)
    with pytest.raises(ValueError, match=words):
        match_pairs(descriptors[0], spoilt[0], torch.arange(5), torch.arange(5), 0.5)


def test_descriptors_of_half_precision_and_of_no_keypoint_are_none() -> None:
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


def test_runs_are_expanded(device: torch.device) -> None:
    run, number = expand_runs(torch.tensor([3, 7, 0], device=device), torch.tensor([5, 7, 3], device=device))
    assert run.tolist() == [0, 0, 2, 2, 2]
    assert number.tolist() == [3, 4, 0, 1, 2]
