from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor

from torchslam.optim._core.levenberg_marquardt import minimize_batch


@dataclass(frozen=True)
class Model:
    x: Tensor
    cost: Tensor


class Rosenbrock:
    """Half of (1 - x)^2 + 100 (y - x^2)^2, per element."""

    def __init__(self, batch: int) -> None:
        self.solvable = torch.ones(batch, dtype=torch.bool)

    def residual(self, x: Tensor) -> Tensor:
        return torch.stack((1 - x[:, 0], 10 * (x[:, 1] - x[:, 0] ** 2)), -1)

    def evaluate(self, estimate: Tensor, use_curvature: Tensor) -> Model:
        return Model(estimate, 0.5 * self.residual(estimate).square().sum(-1))

    def step(self, model: Model, damping: Tensor) -> tuple[Tensor, Tensor]:
        x, zero = model.x[:, 0], torch.zeros_like(model.cost)
        J = torch.stack((-torch.ones_like(x), zero, -20 * x, zero + 10), -1).view(-1, 2, 2)
        H = J.mT @ J
        H = H + torch.diag_embed(damping[:, None] * H.diagonal(dim1=-2, dim2=-1))
        gradient = (J.mT @ self.residual(model.x)[..., None]).squeeze(-1)
        step = torch.linalg.solve(H, gradient)
        return model.x - step, 0.5 * (step * gradient).sum(-1)

    def select(self, accept: Tensor, new: Model, old: Model) -> Model:
        return Model(torch.where(accept[:, None], new.x, old.x), torch.where(accept, new.cost, old.cost))


STARTS = torch.tensor([[-1.2, 1.0], [2.0, -3.0], [1.0, 1.0]], dtype=torch.float64)


def test_the_minimum_is_found_and_reported():
    model, report = minimize_batch(Rosenbrock(3), STARTS, iterations=60, tolerance=1e-14)
    torch.testing.assert_close(model.x, torch.ones_like(STARTS))
    assert report.converged.all()
    assert (report.cost <= report.initial_cost).all()
    assert report.iterations[2] == 1
    assert (report.iterations < 60).all()


def test_elements_of_a_batch_are_independent():
    together, report = minimize_batch(Rosenbrock(3), STARTS, iterations=7, tolerance=1e-14)
    for row in range(3):
        alone, one = minimize_batch(Rosenbrock(1), STARTS[row : row + 1], iterations=7, tolerance=1e-14)
        assert torch.equal(alone.x[0], together.x[row])
        assert one.iterations[0] == report.iterations[row]


def test_cost_never_rises():
    costs = [minimize_batch(Rosenbrock(3), STARTS, iterations=n, tolerance=0.0)[0].cost for n in range(12)]
    for before, after in pairwise(costs):
        assert (after <= before * (1 + 1e-12)).all()


def test_unsolvable_elements_stay_at_their_start():
    problem = Rosenbrock(3)
    problem.solvable = torch.tensor([True, False, True])
    model, report = minimize_batch(problem, STARTS, iterations=60, tolerance=1e-14)
    assert torch.equal(model.x[1], STARTS[1])
    assert report.iterations[1] == 0


def test_progress_is_reported_before_each_iteration():
    reported = []
    _, report = minimize_batch(
        Rosenbrock(3), STARTS, 60, tolerance=1e-14, progress=lambda *now: reported.append(now)
    )
    assert reported == [(iteration, 60) for iteration in range(int(report.iterations.max()))]


class Uphill(Rosenbrock):
    """Every step of some elements is too long, however much it is damped."""

    def __init__(self, uphill: list[bool]) -> None:
        super().__init__(len(uphill))
        self.uphill = torch.tensor(uphill)

    def step(self, model: Model, damping: Tensor) -> tuple[Tensor, Tensor]:
        moved, predicted = super().step(model, damping)
        return torch.where(self.uphill[:, None], model.x + 100, moved), predicted + self.uphill


def test_an_element_without_a_step_that_is_short_enough_ends_alone_and_unconverged():
    """After 13 rejected steps, from a damping of 1e-4 to 1e8; others go on."""
    together, report = minimize_batch(Uphill([True, False, False]), STARTS, iterations=60, tolerance=1e-14)
    alone, one = minimize_batch(Uphill([True]), STARTS[:1], iterations=60, tolerance=1e-14)
    assert report.converged.tolist() == [False, True, True]
    assert (int(report.iterations[0]), int(one.iterations[0]), one.converged.tolist()) == (13, 13, [False])
    assert torch.equal(together.x[0], STARTS[0])
    assert torch.equal(alone.x[0], STARTS[0])
    torch.testing.assert_close(together.x[1:], torch.ones_like(STARTS[1:]))
