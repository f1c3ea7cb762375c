"""Errors and fits of what maps homogeneous points to image coordinates: poses, homographies, pure rotations.

All map homogeneous points by P (3, D) to x: D = 4 for scene points, D = 3 for image points. Errors are in thresholds,
of which `scale` go into one unit of x, in each direction or in both; rows outside `mask` do not count.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchslam.geometry.lie import cayley_rotation, generators
from torchslam.geometry.ransac import ModelState, in_chunks, levenberg_marquardt, retract_pose


def squared_projections(
    P: Float[Tensor, "B K 3 D"],
    homogeneous: Float[Tensor, "B D N"],
    x: Float[Tensor, "B N 2"],
    scale: Float[Tensor, "B N _"],
) -> Float[Tensor, "B K N"]:
    """Squared errors of many mappings, infinite or NaN where the depth is negative."""
    K = P.shape[1]
    u, v, w = (P.transpose(1, 2).flatten(1, 2) @ homogeneous).unflatten(1, (3, K)).unbind(1)
    du = torch.addcmul(u, x[:, None, :, 0], w, value=-1)
    dv = torch.addcmul(v, x[:, None, :, 1], w, value=-1)
    inverse, scale = w.clamp_min_(0.0).reciprocal_(), scale.to(w.dtype)[:, None]
    du, dv = du.mul_(inverse).mul_(scale[..., 0]), dv.mul_(inverse).mul_(scale[..., -1])
    return du.square_().addcmul_(dv, dv)


@dataclass(frozen=True)
class Tangent:
    """Derivatives and retraction of a mapping P (3, D) with T local parameters."""

    constant: Float[
        Tensor, " entries"
    ]  # the 3 (T + 1) D of T derivatives of P and of P itself, where P is zero
    linear: Float[Tensor, "_ entries"]  # their derivatives with respect to the entries of P
    retract: Callable[[ModelState, Tensor], ModelState]  # (P,), step (B, T) -> (P,)

    @staticmethod
    def of(
        derivatives: Callable[[Tensor], Tensor],
        retract: Callable[[ModelState, Tensor], ModelState],
        columns: int,
        dtype: torch.dtype,
        device: torch.device,
    ) -> Tangent:
        """From the derivatives, an affine function of P: (3, D) -> (T, 3, D)."""

        def entries(P: Float[Tensor, "3 D"]) -> Float[Tensor, " entries"]:
            return torch.cat((derivatives(P), P[None])).flatten()

        constant = entries(torch.zeros(3, columns, dtype=dtype, device=device))
        units = torch.eye(3 * columns, dtype=dtype, device=device).unflatten(-1, (3, columns))
        return Tangent(constant, torch.stack([entries(unit) - constant for unit in units]), retract)


@lru_cache(maxsize=16)
def pose_tangent(dtype: torch.dtype, device: torch.device) -> Tangent:
    """Tangent of poses [R t], by [rho, omega] from the left."""
    axes = generators(dtype, device)
    translation = torch.nn.functional.pad(torch.eye(3, dtype=dtype, device=device)[..., None], (3, 0))
    return Tangent.of(lambda P: torch.cat((translation, axes @ P)), retract_pose, 4, dtype, device)


@lru_cache(maxsize=16)
def rotation_tangent(dtype: torch.dtype, device: torch.device) -> Tangent:
    """Tangent of rotations, by omega from the left."""
    axes = generators(dtype, device)
    return Tangent.of(lambda R: axes @ R, lambda R, step: (cayley_rotation(step) @ R[0],), 3, dtype, device)


@lru_cache(maxsize=16)
def homography_tangent(dtype: torch.dtype, device: torch.device) -> Tangent:
    """Tangent of homographies whose last entry stays one, by the other eight."""
    entries = torch.eye(8, 9, dtype=dtype, device=device).unflatten(-1, (3, 3))

    def retract(H: ModelState, step: Tensor) -> ModelState:
        return (H[0] + torch.nn.functional.pad(step, (0, 1)).unflatten(-1, (3, 3)),)

    return Tangent.of(lambda H: entries, retract, 3, dtype, device)


def fit_projections(
    P: Float[Tensor, "B K 3 D"],
    tangent: Tangent,
    homogeneous: Float[Tensor, "B D N"],
    x: Float[Tensor, "B N 2"],
    scale: Float[Tensor, "B N _"],
    mask: Bool[Tensor, "B N"],
    iterations: int,
    width: float = 1.0,
) -> tuple[Float[Tensor, "B K 3 D"], Float[Tensor, "B K"]]:
    """Mappings of least squared error near the given ones, truncated at `width` thresholds, and their costs."""
    K, D, N = P.shape[1], P.shape[-1], x.shape[1]
    T = len(tangent.constant) // (3 * D) - 1

    def fit(P: Tensor, homogeneous: Tensor, x: Tensor, scale: Tensor) -> tuple[Tensor, Tensor]:
        B = len(P)
        x, scale = x.mT[:, None], scale.mT[:, None].contiguous()

        def evaluate(P: Tensor) -> tuple[Tensor, Tensor]:
            rows = torch.addmm(tangent.constant, P.view(B * K, 3 * D), tangent.linear)
            mapped = torch.bmm(rows.view(B, K * 3 * (T + 1), D), homogeneous).view(B, K, T + 1, 3, N)
            numerator, depth = mapped.split((2, 1), dim=3)
            inverse = depth[:, :, -1].clamp_min(1e-9).reciprocal_()
            image = numerator[:, :, -1] * inverse
            # d(u / w) = (du - (u / w) dw) / w; the row of the mapping itself becomes the residual
            rows = torch.addcmul(numerator, image[:, :, None], depth, value=-1)
            torch.sub(image, x, out=rows[:, :, -1]).div_(inverse)
            rows.mul_((inverse * scale)[:, :, None])
            squared = rows[:, :, -1].square().sum(2)
            cost = squared.clamp_max(width * width).sum(-1)
            rows = rows.mul_((squared < width * width)[:, :, None, None]).view(B * K, T + 1, 2 * N)
            return torch.bmm(rows, rows.mT), cost.view(-1)

        (P,), cost = levenberg_marquardt((P.reshape(B * K, 3, D),), evaluate, tangent.retract, iterations)
        return P.view(B, K, 3, D), cost.view(B, K)

    P, cost = in_chunks(fit, K * 3 * (T + 1) * N, P, homogeneous, x, scale * mask[..., None])
    return P, cost
