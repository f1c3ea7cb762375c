"""The damping of both searches: it falls after steps that bring what they promise, and rises after all others."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from torchslam.optim._core.levenberg_marquardt import (
    DAMPING_DOWN,
    DAMPING_UP,
    INITIAL_DAMPING,
    minimize_batch,
    select_models,
)
from torchslam.optim._core.numpy_backend import minimize_model

PROMISE = 0.1  # reduction of the cost that each step predicts


class Model(NamedTuple):
    cost: Tensor


class Promising:
    """A problem whose steps lower the cost by shares of what they predict."""

    def __init__(self, shares: Sequence[float]) -> None:
        self.shares, self.damping = iter(shares), list[float]()
        self.solvable = torch.ones(1, dtype=torch.bool)

    def evaluate(self, estimate: Tensor, use_curvature: Tensor) -> Model:
        return Model(estimate)

    def step(self, model: Model, damping: Tensor) -> tuple[Tensor, Tensor]:
        self.damping.append(float(damping))
        return model.cost - next(self.shares) * PROMISE, torch.full((1,), PROMISE).double()

    select = staticmethod(select_models)


class PromisingInNumPy:
    """The same for the search by NumPy."""

    def __init__(self, problem: Promising, cost: float) -> None:
        self.problem, self.cost = problem, cost

    def step(self, damping: float, use_curvature: bool) -> tuple[float, float]:
        self.problem.damping.append(damping)
        return self.cost - next(self.problem.shares) * PROMISE, PROMISE


@pytest.mark.parametrize("is_numpy", [False, True])
def test_the_damping_follows_the_share_of_the_promise_that_a_step_brings(is_numpy: bool) -> None:
    shares = [1.0, 0.3, 0.2, 0.0, -0.5, 2.0, 1.0]
    problem = Promising(shares)
    if is_numpy:
        minimize_model(
            PromisingInNumPy(problem, 10.0), lambda cost: PromisingInNumPy(problem, cost), len(shares), 0.0
        )
    else:
        minimize_batch(problem, torch.tensor([10.0]).double(), len(shares), 0.0)
    down, up = DAMPING_DOWN, DAMPING_UP
    factors = [after / before for before, after in zip(problem.damping, problem.damping[1:], strict=False)]
    assert problem.damping[0] == INITIAL_DAMPING
    assert factors == pytest.approx([down, down, up, up, up, down])
