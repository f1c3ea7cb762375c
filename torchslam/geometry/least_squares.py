"""A small batched Levenberg-Marquardt, for the local optimisation inside the robust estimators."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import torch
from torch import Tensor

from torchslam.geometry.lie import skew

State = tuple[Tensor, ...]

_NUMBERS_AT_ONCE = 300_000


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
    eye = torch.eye(A.shape[-1] - 1, dtype=A.dtype, device=A.device)
    for _ in range(iterations):
        H, g = A[:, :-1, :-1], A[:, :-1, -1]
        step = torch.linalg.solve_ex(torch.addcmul(H, H * eye, damping), g)[0].neg_()
        moved = retract(state, step)
        gain = (g * step).sum(-1).abs()
        if bool((gain <= 1e-11 * cost).all()):  # too little to be worth a check
            return tuple(
                _select(gain < torch.inf, new, old) for new, old in zip(moved, state, strict=True)
            ), cost
        A_moved, cost_moved = evaluate(*moved)
        better = cost_moved < cost
        state = tuple(_select(better, new, old) for new, old in zip(moved, state, strict=True))
        A, cost = _select(better, A_moved, A), torch.where(better, cost_moved, cost)
        damping = (damping * torch.where(better, 0.1, 10.0)[:, None, None]).clamp(1e-9, 1e6)
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


def _select(condition: Tensor, new: Tensor, old: Tensor) -> Tensor:
    return torch.where(condition.view(-1, *(1,) * (new.dim() - 1)), new, old)


@lru_cache(maxsize=16)
def generators(dtype: torch.dtype, device: torch.device) -> Tensor:
    """(3, 3, 3) the matrices of the cross products with the axes."""
    return skew(torch.eye(3, dtype=dtype, device=device))


def small_rotation(omega: Tensor) -> Tensor:
    """Cayley's rotation, equal to exp(omega) to second order, and cheaper. (P, 3) -> (P, 3, 3)."""
    W = (omega @ generators(omega.dtype, omega.device).view(3, 9)).view(-1, 3, 3)
    factor = 1 / (1 + 0.25 * (omega * omega).sum(-1))[:, None, None]
    turned = torch.baddbmm(W, W, W, alpha=0.5)  # W + W^2 / 2
    return torch.addcmul(torch.eye(3, dtype=omega.dtype, device=omega.device), factor, turned)


def retract_pose(pose: State, step: Tensor) -> State:
    """Moves [R t] by [rho, omega] from the left. (P, 3, 4), (P, 6)."""
    turn = small_rotation(step[:, 3:])
    return (torch.baddbmm(torch.nn.functional.pad(step[:, :3, None], (3, 0)), turn, pose[0]),)
