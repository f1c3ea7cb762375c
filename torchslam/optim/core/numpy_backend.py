"""What `frame_pose` and `window` share: least squares on the host, by numpy and in double precision."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

Array = NDArray[Any]
"""On the host, of doubles where nothing else is said."""

DAMPING, DAMPING_DOWN, DAMPING_UP = 1e-4, 0.1, 10.0
"""At first, after a step that is taken, and after one that is not: as of `levenberg`."""
SLACK = 1 + 1e-13
"""Of the cost: rounding is no reason to refuse a step."""
NEAREST = float(np.finfo(np.float64).eps)
"""Depth in front of which a point counts as behind the camera."""


def on_host(values: Tensor) -> Array:
    """The values of a tensor, without its graph; in the same memory where that can be."""
    array: Array = values.detach().cpu().double().numpy()
    return array


def cauchy(squared: Array, scale: float) -> tuple[Array, Array]:
    """rho and rho' of squared errors (N,), as of `geometry.robust`."""
    share = squared * scale**-2
    return np.log1p(share) * scale**2, 1 / (share + 1)


def huber(squared: Array, scale: float) -> tuple[Array, Array]:
    """rho and rho' of squared errors (N,), as of `geometry.robust`."""
    limit = scale**2
    root = np.sqrt(np.maximum(squared, limit))
    return root * (2 * scale) + np.minimum(squared, limit) - 2 * limit, scale / root


def moved(pose: Array, step: Array) -> Array:
    """A pose (3, 4) moved by [rho, omega] from the left, by Cayley's rotation: as `solvers.tangent.retract`."""
    x, y, z = (0.5 * step[3:]).tolist()
    xx, yy, zz = x * x, y * y, z * z
    f = 2 / (1 + xx + yy + zz)
    turn = np.array(
        (
            (1 - f * (yy + zz), f * (x * y - z), f * (x * z + y)),
            (f * (x * y + z), 1 - f * (xx + zz), f * (y * z - x)),
            (f * (x * z - y), f * (y * z + x), 1 - f * (xx + yy)),
        )
    )
    result: Array = turn @ pose
    result[:, 3] += step[:3]
    return result
