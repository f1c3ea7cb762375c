from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchslam.map.table import Column, Table

NUMBER = {"number": Column((), "float", "a number")}
PLACES = {"number": Column((), "int", "a number"), "place": Column((3,), "float", "where it is")}


@given(st.lists(st.integers(0, 50), min_size=1, max_size=12))
def test_rows_come_back_in_the_order_they_went_in(sizes: list[int]) -> None:
    table, expected = Table(PLACES), []
    for size in sizes:
        values = torch.arange(size) + 1000 * len(expected)
        ids = table.append(number=values, place=values[:, None].double().expand(size, 3))
        assert ids.tolist() == list(range(sum(map(len, expected)), len(table)))
        expected.append(values)
    assert torch.equal(table["number"], torch.cat(expected))
    assert table["place"].shape == (len(table), 3)
    assert table["place"].dtype == torch.float64


def test_capacity_grows_by_half_so_most_appends_do_not_move_the_storage() -> None:
    table = Table(NUMBER)
    pointers = set()
    for _ in range(1000):
        table.append(number=torch.ones(1))
        pointers.add(table["number"].data_ptr())
    assert len(pointers) <= 9


def test_stored_tensors_are_detached() -> None:
    table = Table(NUMBER)
    table.append(number=torch.ones(2, requires_grad=True) * 2)
    assert not table["number"].requires_grad


def test_mismatched_columns_are_refused() -> None:
    table = Table(PLACES)
    with pytest.raises(ValueError, match="the columns have 2 to 3 rows"):
        table.append(number=torch.zeros(2, dtype=torch.int64), place=torch.zeros(3, 3))
    with pytest.raises(ValueError, match="missing or unknown columns: place"):
        table.append(number=torch.zeros(2, dtype=torch.int64))
    with pytest.raises(ValueError, match="column place"):
        table.append(number=torch.zeros(2, dtype=torch.int64), place=torch.zeros(2, 4))
    with pytest.raises(ValueError, match="column number"):
        table.append(number=torch.zeros(2), place=torch.zeros(2, 3))


def test_kept_rows_are_in_the_requested_order() -> None:
    table = Table(NUMBER)
    table.append(number=torch.arange(10.0))
    table.keep(torch.tensor([7, 2]))
    assert table["number"].tolist() == [7.0, 2.0]
    assert table.append(number=torch.ones(1)).tolist() == [2]


@pytest.mark.parametrize(("kept", "moves"), [(40, False), (20, True)])
def test_memory_is_released_when_most_rows_are_unused(kept: int, moves: bool) -> None:
    table = Table(NUMBER)
    table.append(number=torch.arange(64.0))
    place = table["number"].data_ptr()
    table.keep(torch.arange(64).flip(0)[:kept])
    assert table["number"].tolist() == list(range(63, 63 - kept, -1))
    assert (table["number"].data_ptr() != place) is moves
    table.append(number=torch.ones(1))
    assert table["number"].tolist()[-2:] == [64.0 - kept, 1.0]


def test_a_table_filled_in_inference_mode_works_with_autograd() -> None:
    table = Table(NUMBER)
    with torch.inference_mode():
        table.append(number=torch.ones(3))
        table.keep(torch.tensor([0]))  # gives back memory
        table.append(number=torch.ones(2))
    table["number"][0] = 4.0
    weight = torch.ones(3, requires_grad=True)
    (weight * table["number"]).sum().backward()
    assert weight.grad is not None
    assert weight.grad.tolist() == [4.0, 1.0, 1.0]
