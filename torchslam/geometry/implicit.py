"""Gradients of a minimiser with respect to the data, by the implicit function theorem."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor


def needs_gradient(*tensors: Tensor) -> bool:
    """Whether a graph is being recorded for any of the tensors."""
    return torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)


def implicit_step(objective: Callable[[Tensor], Tensor], template: Tensor) -> Tensor:
    """A step of value zero that carries the gradient of the minimiser with respect to the data.

    objective: (B, D) -> (B,), a function of the local parameters, zero at the minimiser, that is also a function
    of data with a graph; the problems of the batch must be independent. template: (B, D), for shape and dtype.
    Returns (B, D): -H^-1 (gradient - its value) with the exact Hessian. Where the Hessian is not positive
    definite, the gradient is zero.
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
    return -torch.cholesky_solve(change[..., None], factor).squeeze(-1)
