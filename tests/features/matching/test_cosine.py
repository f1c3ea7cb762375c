"""Nearest float descriptors, chosen by the directions in which descriptors differ most."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from torchslam.features.matching import cosine


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
def test_mutual_neighbors_along_directions_are_the_nearest(
    monkeypatch: pytest.MonkeyPatch, signed: bool
) -> None:
    """Whatever passes a ratio test passes it with both, at exact distances, also with masks; nothing else is found."""
    rows, columns, same = 700, 600, 400
    one, other = many_units(rows, 0), many_units(columns, 1)
    if signed:
        one, other = (normalize(x - x.mean(1, keepdim=True), dim=-1) for x in (one, other))
    other[:, :same] = normalize(one[:, :same] + 0.02 * torch.randn(1, same, 128), dim=-1)
    masks = masks_of(rows, columns)
    masks[0][0, 5:9], masks[1][0, 17:20], masks[1][0, 590:] = False, False, False
    exact = cosine.nearest_by_cosine(one, other, *masks, None, with_second=True)
    monkeypatch.setattr(cosine, "_DIRECTIONS_FROM", 1)
    found = cosine.nearest_by_cosine(one, other, *masks, None, True, mutual_within=0.1)
    assert torch.equal(found.found, found.mutual)
    assert not found.found[0, 5:9].any()
    assert found.second is not None
    assert exact.second is not None
    sure = exact.mutual & (exact.distance < 0.5 * exact.second) & (exact.distance < 0.1)
    assert int(sure.sum()) > 0.9 * same
    assert bool(found.found[sure].all())
    assert torch.equal(found.column[sure], exact.column[sure])
    torch.testing.assert_close(found.distance[sure], exact.distance[sure])
    chosen = other[0][found.column[0]]
    distances = 1 - (one[0] * chosen).sum(-1)
    torch.testing.assert_close(found.distance[found.found], distances[found.found[0]])
    assert bool((found.second > found.distance)[sure].all())
    # Where any neighbor, or no second one, is wanted, the columns are exact.
    for arguments in (
        (None, True, None),
        (None, False, 0.1),
        (torch.ones(1, rows, columns).bool(), True, 0.1),
    ):
        given, with_second, within = arguments
        other_way = cosine.nearest_by_cosine(one, other, *masks, given, with_second, within)
        assert torch.equal(other_way.column, exact.column)
        assert torch.equal(other_way.distance, exact.distance)


def sorted_pair(rows: int, columns: int) -> tuple[cosine.SortedDescriptors, cosine.SortedDescriptors]:
    """Two images, of which those of the second are a permutation of the first's with little noise, and some more."""
    one = many_units(rows, 0)[0]
    order = torch.randperm(rows, generator=torch.Generator().manual_seed(1))
    other = torch.cat((one[order] + 0.01 * torch.randn(rows, 128), many_units(columns - rows, 2)[0]))
    other = normalize(other, dim=-1)
    masks = torch.ones(rows, dtype=torch.bool), torch.ones(columns, dtype=torch.bool)
    directions = cosine.Directions.of_images([one, other], list(masks))
    assert directions is not None
    return directions.sort(one, masks[0]), directions.sort(other, masks[1])


def test_sorted_descriptors_ascend_and_give_distances() -> None:
    one, other = sorted_pair(300, 310)
    for each in (one, other):
        assert bool((each.first[1:] >= each.first[:-1]).all())
        assert torch.equal(each.first, each.left[:, 0])
    products = one.left @ other.right.mT
    true = 1 - 0.5 * (one.all[one.row][:, None] - other.all[other.row]).square().sum(-1)
    assert float((products - true).abs().max()) < 0.03
    assert float((true - products).max()) < 1e-5  # a projection lengthens nothing


def test_columns_outside_the_band_are_not_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    """The width is that of _BAND root mean squares of a coordinate, about all rows that are compared together."""
    one, other = sorted_pair(300, 310)
    asked: list[tuple[Tensor, Tensor]] = []

    def near(rows: Tensor, columns: Tensor) -> Tensor:
        asked.append((rows, columns))
        return torch.ones(len(rows), len(columns), dtype=torch.bool)

    monkeypatch.setattr(cosine, "_SORTED_AT_ONCE", 50)
    found = cosine.nearest_of_sorted(one, other, 0.02, near)
    assert int(found.found.sum()) > 290
    assert torch.equal(torch.cat([rows for rows, _ in asked]), one.row)
    width = 3.2 * (2 * 0.02 / 128) ** 0.5
    place = {int(row): at for at, row in enumerate(other.row)}
    for start, (rows, columns) in zip(range(0, 300, 50), asked, strict=True):
        ends = float(one.first[start]) - width, float(one.first[start + len(rows) - 1]) + width
        inside = (other.first >= ends[0]) & (other.first <= ends[1])
        assert [place[int(column)] for column in columns] == torch.nonzero(inside)[:, 0].tolist()
        assert len(columns) < 0.8 * 310


def test_pairs_that_are_not_allowed_do_not_match() -> None:
    one, other = sorted_pair(300, 310)
    free = cosine.nearest_of_sorted(one, other, 0.02)
    banned = free.column[0, 7]

    def near(rows: Tensor, columns: Tensor) -> Tensor:
        return ~((rows == 7)[:, None] & (columns == banned))

    found = cosine.nearest_of_sorted(one, other, 0.02, near)
    assert bool(free.found[0, 7])
    assert int(found.column[0, 7]) != int(banned)
    rest = free.found.clone()
    rest[0, 7] = False
    assert torch.equal(found.column[rest], free.column[rest])
    nothing = cosine.nearest_of_sorted(
        one, other, 0.02, lambda rows, columns: torch.zeros(len(rows), len(columns)) > 0
    )
    assert not nothing.found.any()


def test_images_without_descriptors_have_no_neighbors() -> None:
    one, other = sorted_pair(300, 310)
    empty = other._replace(
        row=other.row[:0], first=other.first[:0], left=other.left[:0], right=other.right[:0]
    )
    for pair, count in (((one, empty), 300), ((empty, one), 310)):
        found = cosine.nearest_of_sorted(*pair, 0.2)
        assert found.found.shape == (1, count)
        assert not found.found.any()


def test_directions_hold_what_differs() -> None:
    """Coordinates keep distances where few directions hold the variance; where none do, there are no directions."""
    values = many_units(500, 2)[0]
    found = cosine.Directions.of(values)
    assert found is not None
    assert found.axes.shape == (128, 64)
    torch.testing.assert_close(found.axes.mT @ found.axes, torch.eye(64), atol=1e-5, rtol=0)
    ordered = found.sort(values, torch.ones(500, dtype=torch.bool))
    along, values = ordered.left[:, :64], values[ordered.row]
    assert bool((along.var(0)[:-1] >= along.var(0)[1:]).all())
    ours, true = ((each[:, None] - each).norm(dim=-1) for each in (along, values))
    assert float((ours - true).abs().max()) < 0.1 * float(true.max())
    assert float((ours - true).max()) < 1e-5  # a projection lengthens nothing
    random = torch.Generator().manual_seed(3)
    assert cosine.Directions.of(normalize(torch.randn(500, 128, generator=random), dim=-1)) is None


def test_without_main_directions_all_dimensions_count(monkeypatch: pytest.MonkeyPatch) -> None:
    random = torch.Generator().manual_seed(0)
    one, other = (normalize(torch.randn(1, 300, 128, generator=random), dim=-1) for _ in range(2))
    exact = cosine.nearest_by_cosine(one, other, *masks_of(300, 300), None, with_second=True)
    monkeypatch.setattr(cosine, "_DIRECTIONS_FROM", 1)
    found = cosine.nearest_by_cosine(one, other, *masks_of(300, 300), None, True, 0.2)
    for ours, true in zip(found, exact, strict=True):
        assert ours is not None
        assert true is not None
        assert torch.equal(ours, true)


@pytest.mark.parametrize("kind", [torch.float64, torch.bfloat16])
def test_any_floats_are_compared(kind: torch.dtype, monkeypatch: pytest.MonkeyPatch) -> None:
    one = many_units(90, 0).to(kind)
    masks = masks_of(90, 90)
    masks[0][0, :30], masks[1][0, :30] = False, False
    monkeypatch.setattr(cosine, "_DIRECTIONS_FROM", 1)
    found = cosine.nearest_by_cosine(one, one.flip(1).flip(1), *masks, None, True, 0.1)
    assert found.distance.dtype == kind
    assert torch.equal(found.column[0, 30:], torch.arange(30, 90))
    assert not found.found[0, :30].any()
    # Without strong descriptors there are no directions.
    monkeypatch.setattr(cosine, "_SAMPLE", 10)
    alone = cosine.nearest_by_cosine(one, one, *masks, None, True, 0.1)
    assert torch.equal(alone.column[0, 30:], torch.arange(30, 90))


def test_too_many_columns_for_a_key_are_compared_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cosine, "_DIRECTIONS_FROM", 1)
    monkeypatch.setattr(cosine, "INDEX_BITS", 4)
    monkeypatch.setattr(cosine, "nearest_of_sorted", None)
    found = cosine.nearest_by_cosine(many_units(9, 0), many_units(20, 0), *masks_of(9, 20), None, True, 0.2)
    assert bool(found.found.all())


def test_elements_of_a_batch_are_as_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cosine, "_DIRECTIONS_FROM", 1)
    one = torch.cat([many_units(90, 0), many_units(90, 1, rank=20)])
    other = torch.cat([many_units(80, 2), many_units(80, 3, rank=20)])
    masks = torch.ones(2, 90, dtype=torch.bool), torch.ones(2, 80, dtype=torch.bool)
    masks[0][1, 70:] = False
    together = cosine.nearest_by_cosine(one, other, *masks, None, True, 0.2)
    for row in range(2):
        at = slice(row, row + 1)
        alone = cosine.nearest_by_cosine(one[at], other[at], *(mask[at] for mask in masks), None, True, 0.2)
        for ours, true in zip(together, alone, strict=True):
            assert ours is not None
            assert true is not None
            assert torch.equal(ours[at], true)


def test_directions_are_not_used_where_gradients_are_wanted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cosine, "_DIRECTIONS_FROM", 1)
    one, other = many_units(20, 0).requires_grad_(), many_units(30, 1)
    nearest = cosine.nearest_by_cosine(one, other, *masks_of(20, 30), None, True, 0.2)
    assert nearest.distance.requires_grad
