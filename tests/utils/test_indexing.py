from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchslam.utils.indexing import between_rows, distinct, is_among, ranks_among, row_mask, true_indices

IDS = st.lists(st.integers(-20, 200), max_size=60)


@given(st.lists(st.booleans(), max_size=60))
def test_true_indices_equal_nonzero(values: list[bool]) -> None:
    mask = torch.tensor(values, dtype=torch.bool)
    assert torch.equal(true_indices(mask), mask.nonzero().squeeze(1))


@given(IDS)
def test_distinct_values_and_ranks_equal_unique(values: list[int]) -> None:
    ids = torch.tensor(values, dtype=torch.int64)
    expected, ranks = torch.unique(ids, return_inverse=True)
    assert torch.equal(distinct(ids), expected)
    assert torch.equal(ranks_among(ids, expected), ranks)


@given(IDS, IDS)
def test_membership_equals_isin(values: list[int], others: list[int]) -> None:
    ids, among = (torch.tensor(each, dtype=torch.int64) for each in (values, others))
    before = ids.clone()
    assert torch.equal(is_among(ids, among), torch.isin(ids, among))
    assert torch.equal(ids, before)


def test_masks_on_any_device(device: torch.device) -> None:
    ids = torch.tensor([7, 3, 3, 9], device=device)
    assert distinct(ids).tolist() == [3, 7, 9]
    assert true_indices(ids == 3).tolist() == [1, 2]
    assert is_among(ids, ids[:1]).tolist() == [True, False, False, False]


def test_row_masks_of_ones_and_zeros_are_no_row_numbers() -> None:
    like = torch.zeros(1, 4)
    assert row_mask("fixed", [0, -1], like).tolist() == [[True, False, False, True]]
    assert row_mask("fixed", torch.tensor([2], dtype=torch.int32), like).tolist() == [
        [False, False, True, False]
    ]
    assert not row_mask("fixed", (), like).any()
    for rows, message in (
        (torch.tensor([1, 0, 0, 0]), "fixed names a row twice: row numbers differ, and a mask must be bool"),
        (torch.tensor([1, 0, 0, 0], dtype=torch.uint8), "not torch.uint8"),
        (
            torch.tensor([1.0, 0.0, 0.0, 0.0]),
            r"must be a mask of bool, or row numbers \(n,\), int64, not torch.float32",
        ),
        (torch.tensor([[True], [False], [True], [True]]), r"must have shape \(4,\), not \(4, 1\)"),
        (torch.tensor([[1], [2]]), r"not torch.int64 \(2, 1\)"),
        ([4], r"fixed must lie in 0 \.\.\. 3"),
        ([-5], r"fixed must lie in 0 \.\.\. 3"),
    ):
        with pytest.raises(ValueError, match=message):
            row_mask("fixed", rows, like)


def test_values_are_found_between_rows_and_beyond_the_ends() -> None:
    times = torch.tensor([0.0, 1.0, 3.0], dtype=torch.float64)
    values = torch.tensor([[-1.0, 0.0, 0.5], [1.0, 3.0, 5.0]], dtype=torch.float64)
    left, share = between_rows(times, values)
    assert left.tolist() == [[0, 0, 0], [1, 1, 1]]
    assert share.tolist() == [[-1.0, 0.0, 0.5], [0.0, 1.0, 2.0]]
