from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st

from torchslam.features.pyramid import plan_pyramid
from torchslam.features.selection import (
    _falling,
    best_per_cell,
    plan_grid,
    prefilter_candidates,
    ranks_within,
    select_evenly,
)

CPU = torch.device("cpu")


@given(st.lists(st.integers(0, 3), max_size=30))
def test_ranks_count_within_groups(groups: list[int]) -> None:
    ranks = ranks_within(torch.tensor(groups, dtype=torch.int64), 4).tolist()
    assert ranks == [groups[:k].count(group) for k, group in enumerate(groups)]


def test_best_of_cells_are_the_highest() -> None:
    cells = torch.tensor([1, 0, 1, 1, 0])
    scores = torch.tensor([5, 9, 7, 200, 9], dtype=torch.uint8)
    assert best_per_cell(cells, scores, 3).tolist() == [False, True, False, True, True]


def test_atlas_levels_do_not_overlap() -> None:
    pyramid = plan_pyramid(123, 201, 1.2, 8)
    taken = torch.zeros(pyramid.rows, pyramid.stride, dtype=torch.int64)
    for (h, w), (top, left) in zip(pyramid.sizes, pyramid.corners, strict=True):
        taken[top : top + h, left : left + w] += 1
    assert taken.max() == 1
    assert taken.sum() == sum(h * w for h, w in pyramid.sizes)


def test_the_budget_is_split_over_the_grid_without_the_border() -> None:
    pyramid = plan_pyramid(240, 320, 1.2, 8)
    grid = plan_grid(pyramid, 500, 8, 19, 7, CPU)
    assert int(grid.budgets.sum()) == 500
    assert (grid.budgets[:-1] >= grid.budgets[1:]).all()
    inside = grid.table.view(pyramid.rows, pyramid.stride) >= 0
    assert inside[19 : 240 - 19, 19 : 320 - 19].all()
    assert not inside[:240, :19].any()
    assert set(grid.floor.tolist()) == {7, 255}


def test_levels_that_are_too_small_get_no_budget() -> None:
    grid = plan_grid(plan_pyramid(60, 60, 1.2, 8), 100, 8, 19, 7, CPU)
    assert grid.budgets.tolist()[-1] == 0
    assert int(grid.budgets.sum()) == 100
    assert int(plan_grid(plan_pyramid(20, 20, 1.2, 8), 100, 8, 19, 7, CPU).budgets.sum()) == 0


def test_the_best_of_each_cell_is_selected_first() -> None:
    pyramid = plan_pyramid(100, 100, 1.2, 1)
    grid = plan_grid(pyramid, 4, 1, 19, 7, CPU)
    assert len(grid.levels) == 4
    scores = torch.tensor([9.0, 8.0, 7.0, 6.0, 1.0, 2.0, 3.0])
    cells = torch.tensor([0, 0, 0, 0, 1, 2, 3])
    everything = torch.ones(7, dtype=torch.bool)
    image = torch.zeros(7, dtype=torch.int64)
    rows, places = select_evenly(scores, everything, cells, image, grid, 1, 4)
    assert rows[places.argsort()].tolist() == [0, 6, 5, 4]
    # Weak corners are taken only as the best of their cell.
    rows, _ = select_evenly(scores, ~everything, cells, image, grid, 1, 7)
    assert sorted(rows.tolist()) == [0, 4, 5, 6]


@given(st.lists(st.floats(-4, 4, width=32) | st.sampled_from([0.0, -0.0, 1.0]), max_size=40))
def test_descending_order_equals_a_stable_sort(values: list[float]) -> None:
    scores = torch.tensor(values, dtype=torch.float32)
    expected = torch.argsort(scores, descending=True, stable=True)
    assert torch.equal(_falling(scores), expected)
    assert torch.equal(_falling(scores.double()), expected)


def test_unused_budget_goes_to_other_levels() -> None:
    pyramid = plan_pyramid(100, 100, 1.2, 2)
    grid = plan_grid(pyramid, 10, 2, 19, 7, CPU)
    level_1 = int((grid.levels == 1).nonzero()[0])
    cells = torch.full((9,), level_1)
    scores = torch.arange(9.0)
    image = torch.zeros(9, dtype=torch.int64)
    rows, _ = select_evenly(scores, scores >= 0, cells, image, grid, 1, 10)
    assert len(rows) == 9


@given(st.integers(0, 2**31), st.integers(1, 90), st.integers(1, 400), st.integers(1, 2), st.integers(1, 40))
def test_non_candidates_are_not_selected(seed: int, count: int, corners: int, batch: int, most: int) -> None:
    draw = torch.Generator().manual_seed(seed)
    grid = plan_grid(plan_pyramid(120, 160, 1.2, 4), count, 8, 19, 7, CPU)
    num_cells = grid.levels.shape[0]
    cells, images = (torch.randint(0, n, (corners,), generator=draw) for n in (num_cells, batch))
    fast = torch.randint(8, 8 + most, (corners,), generator=draw).to(torch.uint8)
    strengths = fast + torch.randint(0, 4, (corners,), generator=draw) / 8
    strong = fast > 20
    best = best_per_cell(images * num_cells + cells, fast, batch * num_cells)

    candidates = strong | best
    fewer = best | (strong & prefilter_candidates(fast, candidates, cells, images, grid, batch, count))
    results = []
    for rows in (candidates.nonzero().squeeze(1), fewer.nonzero().squeeze(1)):
        chosen, places = select_evenly(
            *(x[rows] for x in (strengths, strong, cells, images)), grid, batch, count
        )
        results.append((rows[chosen].tolist(), places.tolist()))
    assert results[0] == results[1]


def test_candidates_are_bounded_where_many_scores_are_equal() -> None:
    grid = plan_grid(plan_pyramid(480, 640, 1.2, 8), 500, 8, 19, 7, CPU)
    cells = torch.randint(0, grid.levels.shape[0], (20_000,), generator=torch.Generator().manual_seed(0))
    fast = (torch.arange(20_000) % 200 + 30).to(torch.uint8)
    candidates, images = fast > 0, torch.zeros(20_000, dtype=torch.int64)
    assert 500 <= int(prefilter_candidates(fast, candidates, cells, images, grid, 1, 500).sum()) < 1500
