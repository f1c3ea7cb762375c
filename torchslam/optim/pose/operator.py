"""The minimum of `refine_pose` as one operator of a compiled graph, with its implicit gradient."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchslam.geometry.camera import Camera
from torchslam.geometry.operators import autograd_within, empty, filled, fresh, operator
from torchslam.geometry.precision import full_precision
from torchslam.optim.core.batching import Tensors
from torchslam.optim.core.implicit import Backward, attached_gradient
from torchslam.optim.core.priors import PosePrior
from torchslam.optim.core.residuals import Observations
from torchslam.optim.pose.problem import PoseInputs, PoseMinimization

_STATICS = "str model, int[] size, str kernel, int iterations, float tolerance"


def pose_minimum(minimization: PoseMinimization, tensors: Tensors, backward: Backward) -> Tensors:
    """What `minimum` finds, in a graph. Raises ValueError where the gradient is to pass the iterations."""
    if backward not in ("implicit", "detached"):
        raise ValueError(
            f"backward={backward!r} can not be compiled; torch.compile takes implicit and detached"
        )
    if backward == "detached":
        tensors = tuple(tensor.detach() for tensor in tensors)
    observations = minimization.inputs.observations
    camera = observations.camera
    statics = camera.model, list(camera.size), observations.kernel
    found: Tensors = torch.ops.torchslam.pose_minimum(
        list(tensors), *statics, minimization.iterations, minimization.tolerance
    )
    return found


def _minimization(
    tensors: Sequence[Tensor], model: str, size: Sequence[int], kernel: Any, *limits: Any
) -> PoseMinimization:
    _, points_w, pixels, weights, params, scale, *prior = tensors
    width, height = size
    observations = Observations(pixels, weights, Camera(model, params, (width, height)), kernel, scale)
    return PoseMinimization(PoseInputs(points_w, observations, PosePrior(*prior) if prior else None), *limits)


@full_precision
def _minimum(tensors: Sequence[Tensor], *statics: Any) -> Tensors:
    with torch.no_grad():
        return fresh(_minimization(tensors, *statics).minimize(tuple(tensors)))


def _minimum_like(tensors: Sequence[Tensor], *statics: Any) -> Tensors:
    T_cw = tensors[0]
    kinds = (torch.bool, T_cw.dtype, torch.int64, torch.bool, T_cw.dtype)
    return empty(T_cw.shape, T_cw), *(empty(T_cw.shape[:1], T_cw, dtype) for dtype in kinds)


@full_precision
def _gradient(
    gradient: Tensor, refined: Tensor, success: Tensor, tensors: Sequence[Tensor], *statics: Any
) -> list[Tensor]:
    """The gradients to all tensors; the start has none."""
    needed = [False, *(True for _ in tensors[1:])]
    problem = _minimization(tensors, *statics)
    with autograd_within():
        gradients = attached_gradient(problem, (refined, success), tuple(tensors), (gradient,), needed)
    return list(fresh(filled(gradients, tensors)))


def _gradient_like(
    gradient: Tensor, refined: Tensor, success: Tensor, tensors: Sequence[Tensor], *statics: Any
) -> list[Tensor]:
    return [empty(tensor.shape, tensor) for tensor in tensors]


def _setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensors) -> None:
    tensors, *ctx.statics = inputs
    ctx.save_for_backward(*output[:2], *tensors)


def _backward(ctx: Any, gradient: Tensor, *_: Any) -> tuple[Any, ...]:
    refined, success, *tensors = ctx.saved_tensors
    gradients = torch.ops.torchslam.pose_gradient(gradient, refined, success, tensors, *ctx.statics)
    return gradients, *(None for _ in ctx.statics)


operator(
    "pose_minimum",
    f"(Tensor[] tensors, {_STATICS}) -> (Tensor, Tensor, Tensor, Tensor, Tensor, Tensor)",
    _minimum,
    _minimum_like,
).register_autograd(_backward, setup_context=_setup_context)
operator(
    "pose_gradient",
    f"(Tensor gradient, Tensor refined, Tensor success, Tensor[] tensors, {_STATICS}) -> Tensor[]",
    _gradient,
    _gradient_like,
)
