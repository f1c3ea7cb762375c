from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st

from torchslam.utils.indexing import distinct, is_among, ranks_among, true_indices

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
