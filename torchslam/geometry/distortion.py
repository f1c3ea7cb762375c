"""Lens distortions: maps between undistorted (x/z, y/z) and distorted image coordinates at focal length one.

Each model has its map, the map's Jacobians, its inverse, and the limit up to which it is monotone. The
inverses are solved by Newton's method without a graph; their gradient comes from two differentiable Newton
steps at the solution, so it is exact up to the third order and costs the same however many steps were needed.
Coefficients are (..., 1 or N, K) against points (..., N, 2).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.geometry.estimate_gradients import needs_gradient
from torchslam.utils.torch_internals import in_transform

_NEWTON_STEPS, _GRAPH_STEPS = 12, 2
"""Of the inverse map, tried at this value only; and those from the solution on that gradients pass: one gives the first
derivative, two give three."""


@dataclass(frozen=True)
class Distortion:
    """One model, as functions of undistorted coordinates xy and coefficients k."""

    coefficients: tuple[str, ...]  # names, in OpenCV's order
    distort: Callable[[Tensor, Tensor], Tensor]  # (xy, k) -> distorted coordinates (..., N, 2)
    slope: Callable[[Tensor, Tensor], Tensor]  # (xy, k) -> d distorted / d xy (..., N, 2, 2)
    coefficient_slope: Callable[[Tensor, Tensor], Tensor]  # (xy, k) -> d distorted / d k (..., N, 2, K)
    undistort: Callable[[Tensor, Tensor, Tensor], Tensor]  # (distorted, k, limit) -> xy
    limit: Callable[[Tensor], Tensor]  # (k) -> up to which `coordinate` the map is monotone (...)
    coordinate: Callable[[Tensor], Tensor]  # undistorted radius -> what the limit limits


def first_positive_root(coefficients: Float[Tensor, "*batch D"]) -> Float[Tensor, "*batch"]:
    """Smallest positive root of 1 + c_1 u + ... + c_K u^K, infinity where there is none.

    The largest real eigenvalue 1/u of the companion matrix of the reversed polynomial, which stays monic.
    """
    degree = coefficients.shape[-1]
    first = -torch.where(torch.isfinite(coefficients), coefficients, 0.0)[..., None, :]
    shift = torch.eye(degree, dtype=first.dtype, device=first.device)[:-1]
    companion = torch.cat((first, shift.expand(*first.shape[:-2], degree - 1, degree)), dim=-2)
    inverse = torch.linalg.eigvals(companion)
    real = inverse.imag.abs() <= 1e-6 * inverse.abs()
    largest = torch.where(real, inverse.real, 0.0).amax(-1)
    return torch.where(largest > 1e-12, 1 / largest.clamp_min(1e-12), torch.inf)


def _converged(step: Tensor) -> bool:
    """Test whether the next Newton step, about the square of the largest one, would have no effect."""
    if in_transform():  # where no decision may depend on values
        return False
    return step.numel() == 0 or float(step.abs().max()) < torch.finfo(step.dtype).eps ** 0.5


def _implicit_step(
    J: Float[Tensor, "*#batch 2 2"], residual: Float[Tensor, "*#batch 2"]
) -> Float[Tensor, "*#batch 2"]:
    """-J^-1 residual for 2x2 systems."""
    (a, b), (c, d) = J[..., 0, :].unbind(-1), J[..., 1, :].unbind(-1)
    determinant = a * d - b * c
    determinant = torch.where(determinant.abs() < 1e-12, 1e-12, determinant)
    x, y = residual.unbind(-1)
    return -_stack_columns(d * x - b * y, a * y - c * x) / determinant[..., None]


def length(xy: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch"]:
    """Length of vectors, not differentiable at zero; faster than `norm` if a coordinate is in one piece of memory."""
    x, y = xy.unbind(-1)
    return (x * x + y * y).sqrt()


def _stack_columns(*columns: Tensor) -> Tensor:
    """(..., n) of n tensors (...), each in one piece of memory: whoever reads or writes one of them streams."""
    return torch.stack(columns).movedim(0, -1)


# --- radial and tangential (Brown, 1966); rational: the radial factor over 1 + k4 r^2 + k5 r^4 + k6 r^6 (Claus and
# Fitzgibbon, 2005, as in OpenCV), where there are eight coefficients ---


def _radial_factor(r2: Tensor, k: Tensor) -> Tensor:
    radial = 1 + r2 * (k[..., 0] + r2 * (k[..., 1] + r2 * k[..., 4]))
    return radial / _denominator(r2, k) if k.shape[-1] > 5 else radial


def _denominator(r2: Tensor, k: Tensor) -> Tensor:
    return 1 + r2 * (k[..., 5] + r2 * (k[..., 6] + r2 * k[..., 7]))


def _brown(xy: Tensor, k: Tensor) -> Tensor:
    x, y = xy.unbind(-1)
    p1, p2 = k[..., 2], k[..., 3]
    r2, xy2 = x * x + y * y, 2 * x * y
    radial = _radial_factor(r2, k)
    return _stack_columns(
        x * radial + p1 * xy2 + p2 * (r2 + 2 * x * x), y * radial + p2 * xy2 + p1 * (r2 + 2 * y * y)
    )


def _brown_slope(xy: Tensor, k: Tensor) -> Tensor:
    x, y = xy.unbind(-1)
    k1, k2, p1, p2, k3, *below = k.unbind(-1)
    r2 = x * x + y * y
    radial = _radial_factor(r2, k)
    slope = k1 + r2 * (2 * k2 + r2 * 3 * k3)
    if below:
        k4, k5, k6 = below
        slope = 2 * (slope - radial * (k4 + r2 * (2 * k5 + r2 * 3 * k6))) / _denominator(r2, k)
    else:
        slope = 2 * slope  # d radial / d x = slope x
    cross = slope * x * y + 2 * (p1 * x + p2 * y)
    xx = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
    yy = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
    return _stack_columns(xx, cross, cross, yy).unflatten(-1, (2, 2))


def _brown_coefficient_slope(xy: Tensor, k: Tensor) -> Tensor:
    x, y = xy.unbind(-1)
    xx, yy, xy2 = x * x, y * y, 2 * x * y
    r2 = xx + yy
    powers: tuple[Tensor, ...] = (r2, r2 * r2, r2 * r2 * r2)
    if k.shape[-1] > 5:
        below, radial = _denominator(r2, k), _radial_factor(r2, k)
        powers = tuple(power / below for power in powers)
    columns = []
    for u, tangential in ((x, (xy2, r2 + 2 * xx)), (y, (r2 + 2 * yy, xy2))):
        a, b, c = (u * power for power in powers)
        columns += [a, b, *tangential, c]
        if k.shape[-1] > 5:
            columns += [-radial * a, -radial * b, -radial * c]
    return _stack_columns(*columns).unflatten(-1, (2, k.shape[-1]))


def _invert(
    distort: Callable[[Tensor, Tensor], Tensor],
    slope: Callable[[Tensor, Tensor], Tensor],
    distorted: Tensor,
    k: Tensor,
    limit: Tensor,
) -> Tensor:
    """Undistorted coordinates by Newton's method, for a model whose limit is a radius."""
    with torch.no_grad():
        xy = distorted / length(distorted)[..., None].clamp_min(1.0)  # no start far outside
        edge = torch.where(torch.isfinite(limit), 0.999 * limit, 1e3)[..., None]
        for _ in range(_NEWTON_STEPS):
            step = _implicit_step(slope(xy, k), distort(xy, k) - distorted)
            xy = xy + step
            xy = xy * (edge / length(xy)[..., None].clamp_min(1e-12)).clamp_max(1.0)
            if _converged(step):
                break
    if not needs_gradient(distorted, k):
        return xy
    clamped = length(xy)[..., None] >= edge * (1 - 1e-9)
    for _ in range(_GRAPH_STEPS):
        step = _implicit_step(slope(xy, k), distort(xy, k) - distorted)
        xy = xy + torch.where(clamped, 0.0, step - step.detach())
    return xy


def _radial_tangential_limit(k: Tensor) -> Tensor:
    """Where r (1 + k1 r^2 + k2 r^4 + k3 r^6) stops growing."""
    return first_positive_root(torch.stack((3 * k[..., 0], 5 * k[..., 1], 7 * k[..., 4]), dim=-1)).sqrt()


def _rational_limit(k: Tensor) -> Tensor:
    """The radius at which r N / D, with N and D polynomials in u = r^2, stops growing, or D vanishes.

    Its derivative is (N D + 2 u (N' D - N D')) / D^2.
    """
    one = torch.ones_like(k[..., :1])
    above = torch.cat((one, k[..., :2], k[..., 4:5]), dim=-1)
    below = torch.cat((one, k[..., 5:]), dim=-1)
    terms: list[Tensor] = [torch.zeros_like(k[..., 0]) for _ in range(7)]
    for i in range(4):
        for j in range(4):
            terms[i + j] = terms[i + j] + (1 + 2 * (i - j)) * above[..., i] * below[..., j]
    turning = first_positive_root(torch.stack(terms[1:], dim=-1))
    return torch.minimum(turning, first_positive_root(below[..., 1:])).sqrt()


# --- fisheye (Kannala and Brandt, 2006) ---


def _safe_radius(xy: Tensor) -> tuple[Tensor, Tensor]:
    """(radius, is zero); the radius is one where it is zero, so that its gradient stays finite."""
    r2 = (xy * xy).sum(-1)
    zero = r2 < torch.finfo(xy.dtype).tiny ** 0.5
    return torch.where(zero, 1.0, r2).sqrt(), zero


def _bent(angle: Tensor, k: Tensor) -> Tensor:
    """Distorted angle theta (1 + k1 theta^2 + ... + k4 theta^8)."""
    u = angle * angle
    return angle * (1 + u * (k[..., 0] + u * (k[..., 1] + u * (k[..., 2] + u * k[..., 3]))))


def _bent_slope(angle: Tensor, k: Tensor) -> Tensor:
    u = angle * angle
    return 1 + u * (3 * k[..., 0] + u * (5 * k[..., 1] + u * (7 * k[..., 2] + u * 9 * k[..., 3])))


def _fisheye(xy: Tensor, k: Tensor) -> Tensor:
    radius, zero = _safe_radius(xy)
    factor = _bent(torch.atan(radius), k) / radius
    return xy * torch.where(zero, 1.0, factor)[..., None]


def _fisheye_slope(xy: Tensor, k: Tensor) -> Tensor:
    """d distorted / d xy: one factor along the radius, one across. (..., 2, 2)."""
    radius, zero = _safe_radius(xy)
    angle = torch.atan(radius)
    across = torch.where(zero, 1.0, _bent(angle, k) / radius)
    along = torch.where(zero, 1.0, _bent_slope(angle, k) / (1 + radius * radius))
    direction = xy / radius[..., None]
    outer = direction[..., :, None] * direction[..., None, :]
    eye = torch.eye(2, dtype=xy.dtype, device=xy.device)
    return across[..., None, None] * eye + (along - across)[..., None, None] * outer


def _fisheye_coefficient_slope(xy: Tensor, k: Tensor) -> Tensor:
    radius, zero = _safe_radius(xy)
    angle = torch.atan(torch.where(zero, 0.0, radius))
    u = angle * angle
    powers = angle[..., None] * torch.stack((u, u * u, u * u * u, u * u * u * u), dim=-1)
    return (xy / radius[..., None])[..., None] * powers[..., None, :]


def _fisheye_undistort(distorted: Tensor, k: Tensor, limit: Tensor) -> Tensor:
    bent, zero = _safe_radius(distorted)
    with torch.no_grad():
        edge = limit.clamp_max(0.5 * math.pi - 1e-3)  # x/z has no meaning at 90 degrees and beyond
        angle = torch.minimum(bent, edge)
        for _ in range(_NEWTON_STEPS):
            slope = _bent_slope(angle, k).clamp_min(1e-3)
            before = angle
            angle = torch.minimum((angle - (_bent(angle, k) - bent) / slope).clamp_min(0.0), edge)
            if _converged(angle - before):
                break
        clamped = angle >= edge
    for _ in range(_GRAPH_STEPS if needs_gradient(distorted, k) else 0):
        step = -(_bent(angle, k) - bent) / _bent_slope(angle, k).clamp_min(1e-3)
        angle = angle + torch.where(clamped, 0.0, step - step.detach())
    factor = torch.tan(angle) / bent
    return distorted * torch.where(zero, 1.0, factor)[..., None]


def _fisheye_limit(k: Tensor) -> Tensor:
    """The ray angle at which the distorted angle stops growing, at most 90 degrees."""
    scale = k.new_tensor((3.0, 5.0, 7.0, 9.0))
    return first_positive_root(k * scale).sqrt().clamp_max(0.5 * math.pi)


MODELS = {
    "pinhole": Distortion(
        (),
        lambda xy, k: xy,
        lambda xy, k: torch.eye(2, dtype=xy.dtype, device=xy.device).expand(*xy.shape, 2),
        lambda xy, k: xy.new_zeros(*xy.shape, 0),
        lambda xy, k, limit: xy,
        lambda k: k.new_full(k.shape[:-1], torch.inf),
        torch.abs,
    ),
    **{
        name: Distortion(
            coefficients,
            _brown,
            _brown_slope,
            _brown_coefficient_slope,
            partial(_invert, _brown, _brown_slope),
            limit,
            torch.abs,
        )
        for name, coefficients, limit in (
            ("radial_tangential", ("k1", "k2", "p1", "p2", "k3"), _radial_tangential_limit),
            ("rational", ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), _rational_limit),
        )
    },
    "fisheye": Distortion(
        ("k1", "k2", "k3", "k4"),
        _fisheye,
        _fisheye_slope,
        _fisheye_coefficient_slope,
        _fisheye_undistort,
        _fisheye_limit,
        torch.atan,
    ),
}
"""The camera models by name."""
