"""A small batched Levenberg-Marquardt, for the local optimisation inside the robust estimators.

For least squares of one's own, with gradients: `solvers.least_squares`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import torch
from torch import Tensor

from torchslam.geometry.lie import skew

State = tuple[Tensor, ...]

_NUMBERS_AT_ONCE = 300_000
_LEAST_ITERATIONS = 2  # before it may stop


def minimize(
    state: State,
    evaluate: Callable[..., tuple[Tensor, Tensor]],
    retract: Callable[[State, Tensor], State],
    iterations: int,
) -> tuple[State, Tensor]:
    """Minimises many small problems at once, each with its own damping.

    state:    tensors with one leading dimension (P), the problems
    evaluate: state -> (A, cost): A (P, D + 1, D + 1) is [J r]^T W [J r], and cost (P,) what must not grow
    retract:  state, step (P, D) -> state
    Stops once no problem can gain more than 1e-11 of its cost. Returns the state and its cost; problems that become
    singular or NaN keep their last good state.
    """
    A, cost = evaluate(*state)
    damping = torch.full_like(cost, 1e-4)[:, None, None]
    eye = identity(A.shape[-1] - 1, A.dtype, A.device)
    for iteration in range(iterations):
        H, g = A[:, :-1, :-1], A[:, :-1, -1]
        step = torch.linalg.solve_ex(torch.addcmul(H, H * eye, damping), g)[0].neg_()
        moved = retract(state, step)
        if iteration >= _LEAST_ITERATIONS:
            gain = (g * step).sum(-1).abs()
            if bool((gain <= 1e-11 * cost).all()):  # too little to be worth a check
                return _select(gain < torch.inf, moved, state), cost
        A_moved, cost_moved = evaluate(*moved)
        better = cost_moved < cost
        A, cost, *rest = _select(better, (A_moved, cost_moved, *moved), (A, cost, *state))
        state = tuple(rest)
        damping = damping * torch.where(better, 0.1, 10.0)[:, None, None]
    return state, cost


def in_parts(
    function: Callable[..., tuple[Tensor, ...]], numbers: int, *tensors: Tensor
) -> tuple[Tensor, ...]:
    """function(*tensors) for a few of the problems at a time, so that what it computes stays in the cache.

    numbers: how many of them the function's largest intermediate result holds per problem.
    """
    size = max(1, _NUMBERS_AT_ONCE // numbers)
    if len(tensors[0]) <= size:
        return function(*tensors)
    parts = [function(*part) for part in zip(*(x.split(size) for x in tensors), strict=True)]
    return tuple(torch.cat(x) for x in zip(*parts, strict=True))


def best_of(state: State, cost: Tensor) -> tuple[State, Tensor]:
    """The candidate of least cost of each problem. (B, K, ...), (B, K) -> (B, ...), (B,)."""
    cost, best = cost.nan_to_num(torch.inf).min(dim=1)
    index = torch.arange(len(best), device=best.device)
    return tuple(x[index, best] for x in state), cost


def _select(condition: Tensor, new: State, old: State) -> State:
    """New values where the condition holds. All batched over the first dimension."""
    return tuple(
        torch.where(condition.view(-1, *(1,) * (x.dim() - 1)), x, y) for x, y in zip(new, old, strict=True)
    )


@lru_cache(maxsize=16)
def identity(size: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """(size, size)."""
    return torch.eye(size, dtype=dtype, device=device)


@lru_cache(maxsize=16)
def generators(dtype: torch.dtype, device: torch.device) -> Tensor:
    """(3, 3, 3) the matrices of the cross products with the axes."""
    return skew(torch.eye(3, dtype=dtype, device=device))


def small_rotation(omega: Tensor) -> Tensor:
    """Cayley's rotation, equal to exp(omega) to second order, and cheaper. (P, 3) -> (P, 3, 3)."""
    W = (omega @ generators(omega.dtype, omega.device).view(3, 9)).view(-1, 3, 3)
    factor = 1 / (1 + 0.25 * (omega * omega).sum(-1))[:, None, None]
    turned = torch.baddbmm(W, W, W, alpha=0.5)  # W + W^2 / 2
    return torch.addcmul(identity(3, omega.dtype, omega.device), factor, turned)


def retract_pose(pose: State, step: Tensor) -> State:
    """Moves [R t] by [rho, omega] from the left. (P, 3, 4), (P, 6)."""
    turn = small_rotation(step[:, 3:])
    return (torch.baddbmm(torch.nn.functional.pad(step[:, :3, None], (3, 0)), turn, pose[0]),)
