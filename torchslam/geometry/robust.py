"""Robust kernels: how much a residual costs once it is larger than noise explains.

A kernel is a function rho of the squared whitened residual s = weight * |r|^2 with rho(0) = 0 and rho'(0) = 1, so
that every kernel agrees with least squares for small residuals. `scale` is the residual, in whitened units, at which
they begin to part. The cost of a problem is half the sum of rho. Sources: Black and Rangarajan, "On the unification
of line processes, outlier rejection, and robust statistics", 1996; Barron, "A general and adaptive robust loss
function", 2019.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal, NamedTuple, TypeVar, get_args

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchslam.utils.torch_internals import in_transform

Model = TypeVar("Model")
Kernel = Literal["none", "huber", "cauchy", "geman_mcclure", "truncated"]
"""Robust kernels, by the cost of a residual beyond the scale.

"none":          its square, as before it: least squares
"huber":         its length
"cauchy":        the logarithm of its square
"geman_mcclure": ever less, at most the square of the scale
"truncated":     no more than at the scale: beyond it there is no gradient
"""


class Robustified(NamedTuple):
    """A kernel and its derivatives with respect to the squared residual.

    Attributes:
        rho: the cost, twice the contribution of the residual to the objective.
        weight: rho', of the residual in iteratively reweighted least squares, in [0, 1].
        curvature: rho'', never positive.
    """

    rho: Float[Tensor, "*batch"]
    weight: Float[Tensor, "*batch"]
    curvature: Float[Tensor, "*batch"]


def _none(s: Tensor, scale: Tensor) -> Robustified:
    return Robustified(s, torch.ones_like(s), torch.zeros_like(s))


def _huber(s: Tensor, scale: Tensor) -> Robustified:
    c2 = scale * scale
    inside = s <= c2
    root = torch.where(inside, c2, s).sqrt()
    weight = torch.where(inside, 1.0, scale / root)
    rho = torch.where(inside, s, 2 * scale * root - c2)
    return Robustified(rho, weight, torch.where(inside, 0.0, -0.5 * weight / root.square()))


def _cauchy(s: Tensor, scale: Tensor) -> Robustified:
    c2 = scale * scale
    u = s / c2
    weight = 1 / (1 + u)
    return Robustified(c2 * torch.log1p(u), weight, -weight * weight / c2)


def _geman_mcclure(s: Tensor, scale: Tensor) -> Robustified:
    c2 = scale * scale
    shrink = c2 / (c2 + s)
    weight = shrink * shrink
    return Robustified(s * shrink, weight, -2 * weight * shrink / c2)


def _truncated(s: Tensor, scale: Tensor) -> Robustified:
    inside = s <= scale * scale
    return Robustified(torch.minimum(s, scale * scale), inside.to(s.dtype), torch.zeros_like(s))


_KERNELS: dict[str, Callable[[Tensor, Tensor], Robustified]] = {
    "none": _none,
    "huber": _huber,
    "cauchy": _cauchy,
    "geman_mcclure": _geman_mcclure,
    "truncated": _truncated,
}


def kernel_scale(
    scale: Float[Tensor, "*scale"] | float, like: Float[Tensor, "..."]
) -> Float[Tensor, "*scale"]:
    """The scale of a kernel, with the dtype and on the device of a tensor. Raises ValueError if not above zero."""
    if not in_transform() and not (bool((scale > 0).all()) if isinstance(scale, Tensor) else scale > 0):
        given = scale.tolist() if isinstance(scale, Tensor) else scale
        raise ValueError(f"scale must be above zero, not {given}")
    return torch.as_tensor(scale, dtype=like.dtype, device=like.device)


def robustify(
    squared: Float[Tensor, "*#batch"], kernel: Kernel, scale: Float[Tensor, "*#batch"]
) -> Robustified:
    """Return rho, rho' and rho'' of squared whitened residuals, for a positive scale.

    Differentiable in both, except on the boundary of "huber" (rho'') and "truncated". Raises ValueError for an unknown
    kernel.
    """
    if kernel not in _KERNELS:
        raise ValueError(f"unknown kernel {kernel!r}; known are {', '.join(get_args(Kernel))}")
    return _KERNELS[kernel](squared, scale)


NORMAL_MEDIAN, NORMAL_MEDIAN_3D = 0.6745, 1.54
"""Medians of the absolute value of a standard normal number, and of the length of three of them."""
NORMAL_SQUARED_MEDIAN_2D = 2 * math.log(2)
"""Median of the squared length of a standard normal 2-vector."""
TAIL_SCALE = 4.0
"""Scale of Cauchy's kernel for observations of a run, in standard deviations of the middle of their errors.

Their tails are those of Student's t with 2 to 2.5 degrees of freedom, of which Cauchy's kernel at the root of that is
the negative logarithm. Final trajectories are as good or better from 2 on; with less than 3 their adjustment takes two
to five times as many steps, and some get worse. With 5 the gain is a third smaller."""


def middle_variance(squared: Float[Tensor, " O"], redundancy: float) -> float:
    """The variance of the middle of whitened errors in the plane, by the median of their squares at a minimum.

    In units of the stated one; that one where there is no redundancy, the share of the errors that the unknowns cannot
    follow.
    """
    if len(squared) == 0 or not redundancy > 0:
        return 1.0
    variance = float(median_scale(squared, NORMAL_SQUARED_MEDIAN_2D)) / redundancy
    # Exact pixels are rounded somewhere, and what is larger is not noise. No run came near either.
    return min(max(variance, 1e-3), 4.0)


def median_scale(
    magnitudes: Float[Tensor, "*batch N"],
    expected: float = NORMAL_MEDIAN,
    mask: Bool[Tensor, "*batch N"] | None = None,
) -> Float[Tensor, "*batch"]:
    """The scale of normal errors by the median of their magnitudes, which up to half of them may exceed by anything.

    Args:
        magnitudes: absolute values or lengths of errors, for a standard deviation, or squares, for a variance; NaN does
            not count, and where nothing counts the result is NaN.
        expected: median of these magnitudes for a standard deviation of one.
    """
    if mask is not None:
        magnitudes = magnitudes.masked_fill(~mask, torch.nan)
    return magnitudes.nanmedian(dim=-1).values / expected


def median_with_error(values: Float[np.ndarray, " N"]) -> tuple[float, float, float]:
    """The median of numbers, their standard deviation about it without outliers, and its standard error."""
    middle = float(np.median(values))
    std = float(np.median(np.abs(values - middle))) / NORMAL_MEDIAN
    # The variance of a median is pi / 2 times that of a mean.
    return middle, std, math.sqrt(math.pi / 2 / len(values)) * std


def weighted_median(values: Float[Tensor, " N"], weights: Float[Tensor, " N"]) -> float:
    """The lowest value with at least half of the weight at or below it; NaN if nothing has a weight."""
    order = values.argsort()
    passed = weights[order].cumsum(0)
    if len(values) == 0 or float(passed[-1]) == 0:
        return math.nan
    return float(values[order][(passed >= 0.5 * passed[-1]).nonzero()[0, 0]])


def fit_inliers(
    model: Model,
    find_inliers: Callable[[Model], Bool[Tensor, " N"]],
    fit: Callable[[Model, Bool[Tensor, " N"]], Model | None],
    rounds: int,
) -> tuple[Model, Bool[Tensor, " N"]] | None:
    """Fit a model to the data that agree with the previous one, until these stay the same.

    Args:
        find_inliers: data that agree with a model.
        fit: fits a model to these, starting from the previous one; None where they do not determine it.
        rounds: maximum number of fits.

    Returns:
        The model and the data that it was fitted to; None where they do not determine it.
    """
    before: Tensor | None = None
    for _ in range(rounds):
        inliers = find_inliers(model)
        found = fit(model, inliers)
        if found is None:
            return None
        model = found
        if bool(inliers.all()) if before is None else torch.equal(inliers, before):
            break
        before = inliers
    return model, inliers
