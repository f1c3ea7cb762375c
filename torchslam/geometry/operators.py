"""Operators for compiled graphs: what `torch.compile(fullgraph=True)` takes as one piece, and runs as eager does.

An estimator asks its data how long to go on, which no graph can. As an operator it is that of the eager program, bit
for bit; its gradient is a second operator.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch._C import _dispatch_tls_local_exclude_set as _excluded_keys
from torch._C import _dispatch_tls_local_include_set as _included_keys
from torch._C import _ForceDispatchKeyGuard

_AUTOGRAD_KEYS = [
    key
    for name, key in torch._C.DispatchKey.__members__.items()
    if name.startswith("Autograd") or name == "ADInplaceOrView"
]


@contextmanager
def autograd_within() -> Iterator[None]:
    """Gradients as usual within an operator, which torch calls below autograd."""
    excluded = _excluded_keys()
    for key in _AUTOGRAD_KEYS:
        excluded = excluded.remove(key)
    with _ForceDispatchKeyGuard(_included_keys(), excluded), torch.enable_grad():
        yield


def operator(
    name: str, schema: str, function: Callable[..., Any], like: Callable[..., Any]
) -> torch.library.CustomOpDef:
    """The operator `torchslam::name` for a function, and for its shapes `like`, which has the same arguments.

    No tensor that the function returns may share memory with another, or with an argument.
    """
    defined = torch.library.custom_op(f"torchslam::{name}", function, mutates_args=(), schema=schema)
    defined.register_fake(like)
    return defined


def fresh(tensors: Sequence[Tensor]) -> tuple[Tensor, ...]:
    """Copies that share no memory, contiguous."""
    return tuple(tensor.detach().clone(memory_format=torch.contiguous_format) for tensor in tensors)


def empty(shape: Sequence[int | torch.SymInt], like: Tensor, dtype: torch.dtype | None = None) -> Tensor:
    """What an operator returns, as far as its shape tells."""
    return torch.empty(tuple(shape), dtype=dtype or like.dtype, device=like.device)


def filled(gradients: Sequence[Tensor | None], tensors: Sequence[Tensor]) -> list[Tensor]:
    """Gradients as an operator returns them: zero where there is none."""
    return [
        torch.zeros_like(tensor, memory_format=torch.contiguous_format) if gradient is None else gradient
        for gradient, tensor in zip(gradients, tensors, strict=True)
    ]


def attaching(name: str, statics: str, attach: Callable[..., Tensor]) -> None:
    """The operator `torchslam::name`: (value, inputs, others, *statics) -> the value, which has now a gradient.

    attach: the same arguments -> the value as a function of `inputs` under autograd. Second derivatives raise.
    """
    given = f"Tensor value, Tensor[] inputs, Tensor[] others, {statics}"

    def forward(value: Tensor, *_: Any) -> Tensor:
        return fresh([value])[0]

    def forward_like(value: Tensor, *_: Any) -> Tensor:
        return empty(value.shape, value)

    def backward(
        gradient: Tensor, value: Tensor, inputs: Sequence[Tensor], others: Sequence[Tensor], *given: Any
    ) -> list[Tensor]:
        with autograd_within():
            leaves = [x.detach().requires_grad_() for x in inputs]
            attached = attach(value, leaves, others, *given)
            gradients = torch.autograd.grad(attached, leaves, gradient, allow_unused=True)
        return list(fresh(filled(gradients, inputs)))

    def backward_like(gradient: Tensor, value: Tensor, inputs: Sequence[Tensor], *_: Any) -> list[Tensor]:
        return [empty(x.shape, x) for x in inputs]

    def save(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        value, attached_to, others, *ctx.statics = inputs
        ctx.count = len(attached_to)
        ctx.save_for_backward(value, *attached_to, *others)

    def pull_back(ctx: Any, gradient: Tensor) -> tuple[Any, ...]:
        value, *rest = ctx.saved_tensors
        gradients = getattr(torch.ops.torchslam, f"{name}_gradient")(
            gradient, value, rest[: ctx.count], rest[ctx.count :], *ctx.statics
        )
        none_of_others = [None] * (len(rest) - ctx.count)
        return None, gradients, none_of_others, *(None for _ in ctx.statics)

    forwards = operator(name, f"({given}) -> Tensor", forward, forward_like)
    forwards.register_autograd(pull_back, setup_context=save)
    operator(f"{name}_gradient", f"(Tensor gradient, {given}) -> Tensor[]", backward, backward_like)
