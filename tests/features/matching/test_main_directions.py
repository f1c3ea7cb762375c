"""Nearest float descriptors, chosen by the directions in which descriptors differ most."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from torchslam.features.matching import hamming


def many_units(rows: int, seed: int, dims: int = 128, rank: int = 40) -> Tensor:
    """Unit vectors that differ mostly in `rank` directions, about a common mean as SIFT's."""
    random = torch.Generator().manual_seed(seed)
    basis = torch.randn(rank, dims, generator=torch.Generator().manual_seed(7))
    spread = torch.randn(1, rows, rank, generator=random) @ basis / rank**0.5
    rest = 0.1 * torch.randn(1, rows, dims, generator=random)
    return normalize(1.0 + 0.5 * spread + rest, dim=-1)


def masks_of(rows: int, columns: int) -> tuple[Tensor, Tensor]:
    return torch.ones(1, rows, dtype=torch.bool), torch.ones(1, columns, dtype=torch.bool)


@pytest.mark.parametrize("signed", [False, True])
def test_columns_chosen_by_directions_are_the_nearest(monkeypatch: pytest.MonkeyPatch, signed: bool) -> None:
    """Whatever passes a ratio test passes it with both, at exact distances, also with masks and forbidden pairs."""
    rows, columns, same = 700, 600, 400
    one, other = many_units(rows, 0), many_units(columns, 1)
    if signed:
        one, other = (normalize(x - x.mean(1, keepdim=True), dim=-1) for x in (one, other))
    other[:, :same] = normalize(one[:, :same] + 0.02 * torch.randn(1, same, 128), dim=-1)
    masks = masks_of(rows, columns)
    masks[0][0, 5:9], masks[1][0, 17:20], masks[1][0, 590:] = False, False, False
    allowed = torch.ones(1, rows, columns, dtype=torch.bool)
    allowed[0, 30] = False  # nothing may match it
    allowed[0, 31] = False
    allowed[0, 31, 50] = True  # nothing else
    for given in (None, allowed):
        exact = hamming.nearest_by_cosine(one, other, *masks, given, with_second=True)
        with monkeypatch.context() as patch:
            patch.setattr(hamming, "_DIRECTIONS_FROM", 1)
            found = hamming.nearest_by_cosine(one, other, *masks, given, with_second=True)
            unasked = hamming.nearest_by_cosine(one, other, *masks, given, with_second=False)
        assert unasked.second is None
        assert found.second is not None
        assert exact.second is not None
        # Where nothing is near, another column may be chosen.
        assert not torch.equal(found.column, exact.column)
        assert torch.equal(found.found, exact.found)
        sure = exact.distance < 0.5 * exact.second
        assert int(sure.sum()) > 0.9 * same
        assert torch.equal(found.column[sure], exact.column[sure])
        assert torch.equal(found.mutual[sure], exact.mutual[sure])
        assert torch.equal(found.second[exact.found].isfinite(), exact.second[exact.found].isfinite())
        torch.testing.assert_close(found.distance[sure], exact.distance[sure])
        chosen = other[0][found.column[0]]
        distances = 1 - (one[0] * chosen).sum(-1)
        torch.testing.assert_close(found.distance[exact.found], distances[exact.found[0]])


def test_directions_hold_what_differs() -> None:
    """Coordinates keep distances where few directions hold the variance; where none do, there are no directions."""
    values = many_units(500, 2)[0].double()
    found = hamming._Directions.of(values)
    assert found is not None
    assert found.axes.shape == (128, 64)
    torch.testing.assert_close(found.axes.mT @ found.axes, torch.eye(64, dtype=torch.float64))
    ours, true = ((each[:, None] - each).norm(dim=-1) for each in (found.coordinates(values), values))
    assert float((ours - true).abs().max()) < 0.1 * float(true.max())
    assert float((ours - true).max()) < 1e-12  # a projection lengthens nothing
    random = torch.Generator().manual_seed(3)
    assert hamming._Directions.of(normalize(torch.randn(500, 128, generator=random), dim=-1)) is None


def test_without_main_directions_all_dimensions_count(monkeypatch: pytest.MonkeyPatch) -> None:
    random = torch.Generator().manual_seed(0)
    one, other = (normalize(torch.randn(1, 300, 128, generator=random), dim=-1) for _ in range(2))
    exact = hamming.nearest_by_cosine(one, other, *masks_of(300, 300), None, with_second=True)
    monkeypatch.setattr(hamming, "_DIRECTIONS_FROM", 1)
    found = hamming.nearest_by_cosine(one, other, *masks_of(300, 300), None, with_second=True)
    for ours, true in zip(found, exact, strict=True):
        assert ours is not None
        assert true is not None
        assert torch.equal(ours, true)


@pytest.mark.parametrize("kind", [torch.float64, torch.bfloat16])
def test_any_floats_are_compared(kind: torch.dtype, monkeypatch: pytest.MonkeyPatch) -> None:
    one = many_units(90, 0).to(kind)
    masks = masks_of(90, 90)
    masks[0][0, :30], masks[1][0, :30] = False, False
    monkeypatch.setattr(hamming, "_DIRECTIONS_FROM", 1)
    found = hamming.nearest_by_cosine(one, one.flip(1).flip(1), *masks, None, with_second=True)
    assert found.distance.dtype == kind
    assert torch.equal(found.column[0, 30:], torch.arange(30, 90))
    assert not found.found[0, :30].any()
    # Without strong descriptors there are no directions.
    monkeypatch.setattr(hamming, "_SAMPLE", 10)
    alone = hamming.nearest_by_cosine(one, one, *masks, None, with_second=True)
    assert torch.equal(alone.column[0, 30:], torch.arange(30, 90))


def test_too_many_columns_for_a_key_are_compared_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hamming, "_DIRECTIONS_FROM", 1)
    monkeypatch.setattr(hamming, "_INDEX_BITS", 4)
    monkeypatch.setattr(hamming, "_nearest_by_directions", None)
    found = hamming.nearest_by_cosine(
        many_units(9, 0), many_units(20, 0), *masks_of(9, 20), None, with_second=True
    )
    assert bool(found.found.all())


def test_elements_of_a_batch_are_as_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hamming, "_DIRECTIONS_FROM", 1)
    one = torch.cat([many_units(90, 0), many_units(90, 1, rank=20)])
    other = torch.cat([many_units(80, 2), many_units(80, 3, rank=20)])
    masks = torch.ones(2, 90, dtype=torch.bool), torch.ones(2, 80, dtype=torch.bool)
    masks[0][1, 70:] = False
    together = hamming.nearest_by_cosine(one, other, *masks, None, with_second=True)
    for row in range(2):
        at = slice(row, row + 1)
        alone = hamming.nearest_by_cosine(
            one[at], other[at], *(mask[at] for mask in masks), None, with_second=True
        )
        for ours, true in zip(together, alone, strict=True):
            assert ours is not None
            assert true is not None
            assert torch.equal(ours[at], true)


def test_directions_are_not_used_where_gradients_are_wanted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hamming, "_DIRECTIONS_FROM", 1)
    one, other = many_units(20, 0).requires_grad_(), many_units(30, 1)
    nearest = hamming.nearest_by_cosine(one, other, *masks_of(20, 30), None, with_second=True)
    assert nearest.distance.requires_grad
