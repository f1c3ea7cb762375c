"""A small batched Levenberg-Marquardt, for the local optimisation inside the robust estimators."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import torch
from torch import Tensor

from torchslam.geometry.lie import skew

State = tuple[Tensor, ...]


def minimize(
    state: State,
    evaluate: Callable[..., tuple[Tensor, Tensor]],
    retract: Callable[[State, Tensor], State],
    iterations: int,
    tolerance: float = 1e-7,
) -> tuple[State, Tensor]:
    """Minimises many small problems at once, each with its own damping.

    state:    tensors with leading dimensions (...)
    evaluate: state -> (A, cost): A (..., D + 1, D + 1) is [J r]^T W [J r], and cost (...) what must not grow
    retract:  state, step (..., D) -> state
    Stops early once no problem moves by more than `tolerance`. Returns the state and its cost; problems that
    become singular or NaN keep their last good state.
    """
    A, cost = evaluate(*state)
    damping = torch.full_like(cost, 1e-4)[..., None, None]
    eye = torch.eye(A.shape[-1] - 1, dtype=A.dtype, device=A.device)
    for _ in range(iterations):
        H, g = A[..., :-1, :-1], A[..., :-1, -1]
        step = -torch.linalg.solve_ex(torch.addcmul(H, H * eye, damping), g)[0]
        moved = retract(state, step)
        A_moved, cost_moved = evaluate(*moved)
        better = cost_moved < cost
        state = tuple(_select(better, new, old) for new, old in zip(moved, state, strict=True))
        A, cost = _select(better, A_moved, A), torch.where(better, cost_moved, cost)
        damping = torch.where(better[..., None, None], 0.1 * damping, 10 * damping).clamp(1e-9, 1e6)
        if bool(step.abs().max() < tolerance):
            break
    return state, cost


def _select(condition: Tensor, new: Tensor, old: Tensor) -> Tensor:
    return torch.where(condition.reshape(condition.shape + (1,) * (new.dim() - condition.dim())), new, old)


@lru_cache(maxsize=16)
def generators(dtype: torch.dtype, device: torch.device) -> Tensor:
    """(3, 3, 3) the matrices of the cross products with the axes."""
    return skew(torch.eye(3, dtype=dtype, device=device))


def small_rotation(omega: Tensor) -> Tensor:
    """Cayley's rotation, equal to exp(omega) to second order, and cheaper. (..., 3) -> (..., 3, 3)."""
    half = 0.5 * omega
    W = (half @ generators(omega.dtype, omega.device).flatten(1)).view(*omega.shape, 3)
    factor = 2 / (1 + (half * half).sum(-1))[..., None, None]
    return torch.addcmul(torch.eye(3, dtype=omega.dtype, device=omega.device), factor, W + W @ W)


def retract_pose(pose: State, step: Tensor) -> State:
    """Moves [R t] by [rho, omega] from the left. (..., 3, 4), (..., 6)."""
    moved = small_rotation(step[..., 3:]) @ pose[0]
    return (moved + torch.nn.functional.pad(step[..., :3, None], (3, 0)),)
