"""What the study of the limits of aggregation measures with: minima of a cost, and borders."""

from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st

from experiments.dense.limits import BORDER_PX, at_borders, lowest_minima
from torchslam.dense.cost_volume import find_minimum


def test_the_lowest_minima_come_first_and_lie_between_the_hypotheses() -> None:
    steps = torch.arange(12.0)
    two = torch.minimum((steps - 2.25) ** 2, (steps - 8.5) ** 2 + 0.5)[:, None, None]
    found = lowest_minima(two, 3).flatten()
    torch.testing.assert_close(found[:2], torch.tensor([2.25, 8.5]))
    assert found[2].isnan()


def test_a_minimum_at_the_end_has_no_parabola() -> None:
    assert lowest_minima(torch.arange(5.0)[:, None, None], 2).flatten()[0] == 0


@given(st.integers(0, 1000))
def test_the_lowest_one_is_that_of_the_estimation(seed: int) -> None:
    cost = torch.rand(9, 4, 5, generator=torch.Generator().manual_seed(seed))
    torch.testing.assert_close(lowest_minima(cost, 1)[0], find_minimum(cost).position)


def test_borders_are_where_known_depth_jumps() -> None:
    depth = torch.ones(1, 40, 40)
    depth[..., 20:] = 2
    depth[:, :5] = 0
    expected = torch.zeros(1, 40, 40, dtype=torch.bool)
    expected[:, 5:, 20 - BORDER_PX : 20 + BORDER_PX] = True
    assert torch.equal(at_borders(depth), expected)
