"""First derivatives of estimates, by the implicit function theorem; of any order: `torchslam.optim._core.implicit`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.utils.torch_internals import in_forward_mode, in_transform


def needs_gradient(*tensors: Tensor) -> bool:
    """Test whether a graph is being recorded for any of the tensors, or may be by forward mode."""
    recorded = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)
    return recorded or in_transform() or in_forward_mode()


def with_zero_gradient(tensor: Float[Tensor, "*batch"], *inputs: Tensor) -> Float[Tensor, "*batch"]:
    """The tensor, with a gradient of zero to the inputs: without a graph, `backward` would raise an error."""
    never = torch.zeros((), dtype=torch.bool, device=tensor.device)
    for each in inputs:
        if needs_gradient(each):
            tensor = tensor + torch.where(never, each.sum(), 0.0)
    return tensor


def refuse_transforms(name: str) -> None:
    """Raise RuntimeError within a transform of `torch.func`, for an estimator that chooses among random samples."""
    if in_transform():
        raise RuntimeError(
            f"{name} chooses among random samples, which torch.func cannot transform: call it outside, on a batch in "
            "place of vmap, and differentiate with backward; solve_pose and solve_bundle can be transformed"
        )


def first_order(tensor: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """The tensor, whose first derivatives are right while the second are not: to take these raises RuntimeError."""
    result: Tensor = _FirstOrder.apply(tensor)
    return result


class _FirstOrder(torch.autograd.Function):
    generate_vmap_rule = True

    @staticmethod
    def forward(tensor: Tensor) -> Tensor:
        return tensor.view_as(tensor)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor], output: Tensor) -> None:
        ctx.save_for_backward(*inputs)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        # The input makes the gradient depend on what it depends on, also where the loss is linear.
        return _Last.apply(gradient, *ctx.saved_tensors) if torch.is_grad_enabled() else gradient

    @staticmethod
    def jvp(ctx: Any, change: Tensor) -> Tensor:
        return change.view_as(change)


class _Last(torch.autograd.Function):
    generate_vmap_rule = True

    @staticmethod
    def forward(gradient: Tensor, _: Tensor) -> Tensor:
        return gradient.view_as(gradient)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: Tensor) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Any:
        raise RuntimeError("the second derivative of an estimate by RANSAC or of an alignment is not known")


def implicit_step(
    objective: Callable[[Tensor], Tensor], template: Float[Tensor, "B D"]
) -> Float[Tensor, "B D"]:
    """A step of value zero that carries the gradient of the minimizer with respect to the data.

    It is -H^-1 (gradient - its value) with the exact Hessian; where H is not positive definite, the gradient is zero.
    It has no second derivative, see `first_order`.

    Args:
        objective: (B, D) -> (B,), a function of the local parameters, zero at the minimizer, that is also a
            function of data with a graph; the problems of the batch must be independent.
        template: for shape and dtype.
    """
    at = torch.zeros_like(template).requires_grad_()
    with torch.enable_grad():
        (gradient,) = torch.autograd.grad(objective(at).sum(), at, create_graph=True)
    columns = [
        torch.autograd.grad(gradient[:, i].sum(), at, retain_graph=True)[0] for i in range(template.shape[-1])
    ]
    H = torch.stack(columns, dim=-1)
    factor, info = torch.linalg.cholesky_ex(0.5 * (H + H.mT).nan_to_num())
    definite = (info == 0)[:, None]
    factor = torch.where(definite[..., None], factor, torch.eye(H.shape[-1], dtype=H.dtype, device=H.device))
    change = torch.where(definite, gradient - gradient.detach(), 0.0)
    return first_order(-torch.cholesky_solve(change[..., None], factor).squeeze(-1))
