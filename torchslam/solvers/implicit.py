"""Gradients of a minimiser by the implicit function theorem.

At a minimum theta* of a cost with inputs x the gradient g(theta*, x) is zero, so d theta* = -H^-1 (dg/dx) dx with the
exact Hessian H = dg/dtheta. For a loss with gradient v at theta* the gradient to the inputs is therefore
-d/dx [g(theta*, x) . lambda] with H lambda = v: one linear solve and one pass of autograd over a scalar, however many
iterations led to the minimum. Source: Krantz and Parks, "The implicit function theorem", 2002; Gould et al., "Deep
declarative networks", 2021.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal, get_args

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

Backward = Literal["implicit", "unroll", "truncated", "detached"]
"""How gradients pass a minimisation.

"implicit":  the exact gradient at the minimum; memory does not depend on the iterations
"unroll":    through every iteration, also to the start; memory grows with the iterations
"truncated": through one last Gauss-Newton step from the detached minimum; biased with a robust kernel
"detached":  none
"""

Adjoint = Callable[[Sequence[Tensor], Sequence[Tensor]], Tensor]


def check_backward(backward: str) -> None:
    """Raises ValueError unless `backward` is one of the modes."""
    if backward not in get_args(Backward):
        raise ValueError(f"unknown backward mode {backward!r}; known are {', '.join(get_args(Backward))}")


def attach(solution: Sequence[Tensor], inputs: Sequence[Tensor], adjoint: Adjoint) -> tuple[Tensor, ...]:
    """The solution, with its implicit gradient to the inputs.

    adjoint(grad_solution, inputs) solves for lambda and returns the scalar g(theta*, inputs) . lambda, differentiable
    with respect to the inputs. It is called once, in the backward pass.
    """
    return _Implicit.apply(adjoint, len(solution), *solution, *inputs)


class _Implicit(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, adjoint: Adjoint, num_solution: int, *tensors: Tensor) -> tuple[Tensor, ...]:
        ctx.adjoint = adjoint
        ctx.num_solution = num_solution
        ctx.save_for_backward(*tensors[num_solution:])
        return tuple(tensor.view_as(tensor) for tensor in tensors[:num_solution])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_solution: Tensor) -> tuple[Any, ...]:
        needed = ctx.needs_input_grad[2 + ctx.num_solution :]
        inputs = [
            tensor.detach().requires_grad_(need)
            for tensor, need in zip(ctx.saved_tensors, needed, strict=True)
        ]
        with torch.enable_grad():
            loss = -ctx.adjoint(grad_solution, inputs)
        wanted = [tensor for tensor, need in zip(inputs, needed, strict=True) if need]
        grads = iter(torch.autograd.grad(loss, wanted, allow_unused=True))
        none: list[Any] = [None] * (2 + ctx.num_solution)
        return (*none, *(next(grads) if need else None for need in needed))
