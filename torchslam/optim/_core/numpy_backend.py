"""Least squares by NumPy in double precision, for the two problems that every run solves again and again.

They are the pose of a frame (`optim.frame_pose`) and the local map of a keyframe (`optim.bundle.dense_numpy`).
With a few hundred values, the overhead of a call dominates, and a NumPy call costs about a third of a PyTorch call.
There are no gradients: `optim.run_graph`, which solves the graph of a finished run, has them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, Protocol, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchslam.optim._core.levenberg_marquardt import (
    CURVATURE_BELOW,
    DAMPING_DOWN,
    DAMPING_UP,
    INITIAL_DAMPING,
    TRUSTED,
)
from torchslam.optim._core.linear import smallest_pivot

Array = NDArray[Any]
"""A NumPy array, of float64 unless stated otherwise."""

RobustKernel = Literal["cauchy", "huber"]
"""Kernels that exist in NumPy, as in `geometry.robust`."""

MIN_DEPTH = float(np.finfo(np.float64).eps)
"""A point at a smaller depth counts as behind the camera."""


class LocalModel(Protocol):
    """A quadratic model of the cost around a state."""

    @property
    def cost(self) -> float: ...

    def step(self, damping: float, use_curvature: bool) -> tuple[Any, float] | None:
        """The state at the minimum of the damped model and the predicted reduction of the cost; None if singular."""
        ...


M = TypeVar("M", bound=LocalModel)


def minimize_model(model: M, evaluate: Callable[[Any], M], iterations: int, tolerance: float) -> M:
    """Run Levenberg-Marquardt from `model` and return the model at the last accepted state.

    `evaluate` makes the model at a state that `LocalModel.step` returned. The search ends after a step with a predicted
    reduction of at most the share `tolerance` of the cost.
    """
    damping, use_curvature = INITIAL_DAMPING, False
    for _ in range(iterations):
        proposal = model.step(damping, use_curvature)
        if proposal is None:
            damping *= DAMPING_UP
            continue
        state, predicted_reduction = proposal
        trial = evaluate(state)
        converged = not predicted_reduction > tolerance * model.cost
        accepted = trial.cost <= (1 + 1e-13) * model.cost  # an increase by rounding does not reject a step
        trusted = accepted and model.cost - trial.cost > TRUSTED * predicted_reduction
        if accepted:
            use_curvature = predicted_reduction < CURVATURE_BELOW * model.cost
            model = trial
        if converged:
            break
        damping *= DAMPING_DOWN if trusted else DAMPING_UP
    return model


def to_numpy(values: Tensor) -> Array:
    """The detached values as float64, in the same memory where possible."""
    array: Array = values.detach().cpu().double().numpy()
    return array


def cauchy(squared: Array, scale: float) -> tuple[Array, Array]:
    """rho and rho' of squared errors (N,), as in `geometry.robust`."""
    share = squared * scale**-2
    return np.log1p(share) * scale**2, 1 / (share + 1)


def huber(squared: Array, scale: float) -> tuple[Array, Array]:
    """rho and rho' of squared errors (N,), as in `geometry.robust`."""
    limit = scale**2
    root = np.sqrt(np.maximum(squared, limit))
    return root * (2 * scale) + np.minimum(squared, limit) - 2 * limit, scale / root


def retract_pose(pose: Array, step: Array) -> Array:
    """A pose (3, 4) moved by a left perturbation [rho, omega] (6,), as in `_core.tangent.retract`."""
    x, y, z = (0.5 * step[3:]).tolist()
    xx, yy, zz = x * x, y * y, z * z
    f = 2 / (1 + xx + yy + zz)
    rotation = np.array(
        (
            (1 - f * (yy + zz), f * (x * y - z), f * (x * z + y)),
            (f * (x * y + z), 1 - f * (xx + zz), f * (y * z - x)),
            (f * (x * z - y), f * (y * z + x), 1 - f * (xx + yy)),
        )
    )
    result: Array = rotation @ pose
    result[:, 3] += step[:3]
    return result


def variance_factor(
    squared: Array, influence: Array, weights: Array, kernel: RobustKernel, scale: float, num_parameters: int
) -> float:
    """Variance of unit weight from residuals of two components, as in `_core.residuals.variance_factor`.

    Of weighted squared errors (N,), the kernel's rho' of them, and weights, zero where an error does not count.
    """
    counted = (weights > 0).astype(np.float64)
    across = influence * counted
    if kernel == "huber":  # the slope of psi along the error: one, or zero beyond the scale
        along = (squared <= scale**2) * counted
    else:
        along = across * (2 * influence - 1)
    psi = across * across
    sums = np.stack((counted, across, along, psi, along * along, psi * squared)).sum(1).tolist()
    count, across_sum, along_sum, across_2, along_2, psi_2 = sums
    components = 2 * count
    slope = (across_sum + along_sum) / max(components, 1.0)
    if components <= num_parameters or slope <= 0:
        return 1.0
    spread = (across_2 + along_2) / components / slope**2 - 1
    correction = 1 + num_parameters / components * spread
    variance = psi_2 / (components - num_parameters)
    factor: float = correction**2 * variance * (2 * across_sum / components) / slope**2
    return factor


def cross_columns(u: Array, columns: Array, out: Array) -> None:
    """u x every column, written to `out`: (3, N), (3, n, N) -> (3, n, N)."""
    for k, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        np.multiply(u[i], columns[j], out=out[k])
        out[k] -= u[j] * columns[i]


def solve_symmetric(matrix: Array, right: Array) -> Array | None:
    """matrix^-1 right; None where the matrix is not positive definite."""
    factor = _scaled_cholesky(matrix)
    if factor is None:
        return None
    scale, scaled, _ = factor
    try:
        solution: Array = scale * np.linalg.solve(scaled, scale * right)
    except np.linalg.LinAlgError:
        return None
    return solution


def is_definite(matrix: Array) -> bool:
    """Whether a matrix is clearly positive definite, whatever its units, as in `_core.linear.factorize`."""
    factor = _scaled_cholesky(matrix)
    return factor is not None and bool(factor[2].diagonal().min() > smallest_pivot(torch.float64))


def _scaled_cholesky(matrix: Array) -> tuple[Array, Array, Array] | None:
    """Scale (D,), the matrix scaled to a unit diagonal, and its Cholesky factor; None if not positive definite."""
    diagonal = matrix.diagonal()
    if not (diagonal > 0).all():
        return None
    scale = diagonal**-0.5
    scaled = scale[:, None] * matrix * scale
    try:
        return scale, scaled, np.linalg.cholesky(scaled)
    except np.linalg.LinAlgError:
        return None
