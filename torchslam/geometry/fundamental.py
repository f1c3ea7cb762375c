"""Fundamental matrices: refined on the matches of a pair of views, with what the matches leave uncertain.

x_2^T F x_1 = 0 for matches x_1, x_2 in any image coordinates. They should be of order one around the center of the
image, such as pixels from the principal point over the longer side. A matrix is a vector of nine, row by row.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchslam.geometry.estimate_gradients import implicit_step, needs_gradient
from torchslam.geometry.lie import homogeneous
from torchslam.geometry.precision import full_precision
from torchslam.geometry.ransac import ModelState, best_of, levenberg_marquardt
from torchslam.geometry.robust import median_scale, robustify
from torchslam.geometry.two_view import TwoViews, fit_homography, propose_homography, transfer_squared
from torchslam.geometry.two_view_matrices import sampson_errors

_ITERATIONS = 15
"""Of Levenberg-Marquardt, for the matrix and for the homography. Tried at this value only."""
# Thresholds: SIFT keypoints that are exact to a tenth of a pixel are an accident of few matches.
_LEAST_NOISE = 0.1
_FREEDOMS = 7
"""Degrees of freedom of a fundamental matrix: nine numbers less the scale and the rank."""
# Of a homography: random samples of four matches, so that of matches half of which lie on the plane 98 % have a good
# one; deviations of the noise within which it explains a match in both coordinates; and as much wider at first, since
# four matches do not determine it as well as all.
_SAMPLES, _WIDTH, _FIRST_WIDTH = 64, 2.0, 4.0


@dataclass(frozen=True)
class RefinedFundamental:
    """Fundamental matrices that fit the matches of B pairs.

    Attributes:
        F_21: of rank two and norm one, with the sign of the given one; with gradient to the matches.
        covariance: by the noise of the matches, which is estimated from them; without gradient.
        bend: derivative of F_21 by k where the matches move from x to x (1 + k |x|^2); without gradient.
        noise: standard deviation of the Sampson distances, in units of the coordinates; without gradient.
    """

    F_21: Float[Tensor, "B 3 3"]
    covariance: Float[Tensor, "B 9 9"]
    bend: Float[Tensor, "B 9"]
    noise: Float[Tensor, " B"]


@full_precision
def refine_fundamental(
    F_21: Float[Tensor, "B 3 3"],
    x_1: Float[Tensor, "B N 2"],
    x_2: Float[Tensor, "B N 2"],
    mask: Bool[Tensor, "B N"],
    threshold: float,
) -> RefinedFundamental:
    """Minimize the Cauchy cost of the Sampson distances over fundamental matrices, from the given ones.

    Sources: Hartley and Zisserman, "Multiple view geometry", 2004, section 11.4; for the covariance, section 5.2.

    Args:
        F_21: where to start, of any scale; without gradient.
        mask: matches in use, few of them wrong; finite.
        threshold: of the kernel, in units of the coordinates: about the noise of one coordinate or somewhat more.
    """
    x_1, x_2 = (torch.where(mask[..., None], x, 0.0) for x in (x_1, x_2))

    def moved(state: ModelState, step: Float[Tensor, "B 7"]) -> ModelState:
        U, S, Vh = torch.linalg.svd(state[0].nan_to_num())
        return (_displaced(U, S, Vh, step),)

    with torch.no_grad():
        # The nearest matrices of rank two, of norm one; NaN where there is none.
        finite = torch.isfinite(F_21).all(-1).all(-1)[:, None, None]
        U, S, Vh = torch.linalg.svd(torch.where(finite, F_21, 0.0))
        F = (U[:, :, :2] * S[:, None, :2]) @ Vh[:, :2]
        F = F / torch.where(finite, F.flatten(1).norm(dim=1)[:, None, None], torch.nan)
        (F,), _ = levenberg_marquardt(
            (F,), lambda F: _normal_equations(F, x_1, x_2, mask, threshold), moved, _ITERATIONS
        )
        covariance, bend, noise = _uncertainty(F, x_1, x_2, mask, threshold)
    if needs_gradient(x_1, x_2):
        U, S, Vh = (x.detach() for x in torch.linalg.svd(F))

        def objective(step: Float[Tensor, "B 7"]) -> Float[Tensor, " B"]:
            squared = (sampson_errors(_displaced(U, S, Vh, step), x_1, x_2) / threshold).square()
            return torch.where(mask, robustify(squared, "cauchy", squared.new_tensor(1.0)).rho, 0.0).sum(-1)

        F = _displaced(U, S, Vh, implicit_step(objective, F.new_zeros(len(F), _FREEDOMS)))
    return RefinedFundamental(F, covariance, bend, noise)


@full_precision
def homography_share(
    x_1: Float[Tensor, "B N 2"],
    x_2: Float[Tensor, "B N 2"],
    mask: Bool[Tensor, "B N"],
    noise: Float[Tensor, " B"],
) -> Float[Tensor, " B"]:
    """Share of the matches that one homography explains: near one of a plane, and of a camera that only turned.

    Then a fundamental matrix follows the noise in two directions, and its covariance cannot be trusted. Not
    differentiable by design: it serves a decision. The samples are always the same. noise: of `RefinedFundamental`
    """
    with torch.no_grad():
        scale = (1 / (_WIDTH * noise))[:, None].expand(mask.shape)
        x_1, x_2 = (torch.where(mask[..., None], x, 0.0) for x in (x_1, x_2))
        views = TwoViews(x_1, x_2, scale, scale, mask)
        wide = views.in_units(views.scale_1.new_tensor(_FIRST_WIDTH).expand(mask.shape))
        H = propose_homography(wide, _SAMPLES, torch.Generator().manual_seed(0))
        (H,), _ = fit_homography(wide, H, _ITERATIONS)
        (H,), cost = fit_homography(views, H, _ITERATIONS)
        (H,), _ = best_of((H,), cost)
        explained = mask & (transfer_squared(views, H[:, None])[:, 0] < 1)
        return explained.sum(-1).to(x_1.dtype) / mask.sum(-1).clamp_min(1)


def _displaced(
    U: Float[Tensor, "B 3 3"], S: Float[Tensor, "B 3"], Vh: Float[Tensor, "B 3 3"], step: Float[Tensor, "B 7"]
) -> Float[Tensor, "B 3 3"]:
    """Matrices of rank two and norm one next to U diag(S) Vh, along the `_tangents`.

    In the frame of U and V a matrix of rank two is [M c; r (r M^-1 c)] for any M (2, 2), c and r. Unlike angles and
    singular values, these parameters remain independent where the two singular values are equal.
    """
    s_1, s_2 = S[:, 0], S[:, 1]
    a, b, c_1, c_2, r_1, r_2, ratio = step.unbind(-1)
    norm = torch.hypot(s_1, s_2)
    m_11, m_22 = s_1 - ratio * s_2 / norm, s_2 + ratio * s_1 / norm
    determinant = m_11 * m_22 - a * b
    corner = (r_1 * (m_22 * c_1 - a * c_2) + r_2 * (m_11 * c_2 - b * c_1)) / determinant
    block = torch.stack((m_11, a, c_1, b, m_22, c_2, r_1, r_2, corner), dim=-1).unflatten(-1, (3, 3))
    return U @ (block / block.flatten(1).norm(dim=1)[:, None, None]) @ Vh


def _tangents(F: Float[Tensor, "B 3 3"]) -> Float[Tensor, "B 7 9"]:
    """Orthonormal directions in which matrices of rank two and norm one can change."""
    U, S, Vh = torch.linalg.svd(F.nan_to_num())
    products = U.mT[:, :, None, :, None] * Vh[:, None, :, None, :]  # by column of U and row of Vh
    ratio = (S[:, 0, None, None] * products[:, 1, 1] - S[:, 1, None, None] * products[:, 0, 0]) / torch.hypot(
        S[:, 0], S[:, 1]
    )[:, None, None]
    pairs = ((0, 1), (1, 0), (0, 2), (1, 2), (2, 0), (2, 1))
    return torch.stack([*(products[:, i, j] for i, j in pairs), ratio], dim=1).flatten(2)


def _linearized(
    F: Float[Tensor, "B 3 3"],
    x_1: Float[Tensor, "B N 2"],
    x_2: Float[Tensor, "B N 2"],
    mask: Bool[Tensor, "B N"],
    threshold: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Sampson distances, their derivatives along the tangents (B, 7, N) and by the bend; robust weights and costs."""
    h_1, h_2 = homogeneous(x_1), homogeneous(x_2)
    line_2, line_1 = h_1 @ F.mT, h_2 @ F
    flat = line_2.new_tensor((1.0, 1.0, 0.0))
    squared = (line_2 * flat).square().sum(-1) + (line_1 * flat).square().sum(-1)
    inverse = squared.clamp_min(torch.finfo(F.dtype).tiny).rsqrt()
    distance = (h_2 * line_2).sum(-1) * inverse
    # of x_2^T F x_1 / s: the numerator's, less distance / s times that of s^2 / 2
    change = h_2[..., :, None] * h_1[..., None, :]
    change = change - (distance * inverse)[..., None, None] * (
        (line_2 * flat)[..., :, None] * h_1[..., None, :] + h_2[..., :, None] * (line_1 * flat)[..., None, :]
    )
    along = _tangents(F) @ (change.flatten(2) * inverse[..., None]).mT
    moves_1, moves_2 = x_1 * x_1.square().sum(-1, keepdim=True), x_2 * x_2.square().sum(-1, keepdim=True)
    bend = ((line_1[..., :2] * moves_1).sum(-1) + (line_2[..., :2] * moves_2).sum(-1)) * inverse
    robust = robustify((distance / threshold).square(), "cauchy", distance.new_tensor(1.0))
    weight, cost = (torch.where(mask, part, 0.0) for part in (robust.weight, robust.rho))
    return distance, along, bend, weight, cost


def _normal_equations(F: Tensor, *matches: Any) -> tuple[Float[Tensor, "B 8 8"], Float[Tensor, " B"]]:
    """[J r]^T W [J r] and the cost, as `levenberg_marquardt` wants them; lengths in thresholds."""
    distance, along, _, weight, cost = _linearized(F, *matches)
    rows = torch.cat((along, distance[:, None]), dim=1) / matches[-1]
    return (rows * weight[:, None]) @ rows.mT, cost.sum(-1)


def _uncertainty(
    F: Float[Tensor, "B 3 3"],
    x_1: Float[Tensor, "B N 2"],
    x_2: Float[Tensor, "B N 2"],
    mask: Bool[Tensor, "B N"],
    threshold: float,
) -> tuple[Float[Tensor, "B 9 9"], Float[Tensor, "B 9"], Float[Tensor, " B"]]:
    """The covariance of F, its derivative by the bend, and the noise of the distances."""
    distance, along, bend, weight, _ = _linearized(F, x_1, x_2, mask, threshold)
    count = mask.sum(-1).to(F.dtype)
    middle = median_scale(distance.abs(), mask=mask)
    # The fit follows the noise of as many matches as it has parameters.
    noise = middle * (count / (count - _FREEDOMS).clamp_min(1.0)).sqrt()
    noise = noise.nan_to_num(threshold).clamp_min(_LEAST_NOISE * threshold)
    information = (along * weight[:, None]) @ along.mT
    # Of a plane or a rotating camera, two directions have none: their covariance shall be large, not infinite.
    least = 1e-12 * information.diagonal(dim1=1, dim2=2).mean(-1).clamp_min(1.0)
    information = information + torch.diag_embed(least[:, None].expand(-1, _FREEDOMS))
    tangents = _tangents(F)
    both = torch.cat((tangents, (along * weight[:, None] @ bend[..., None])), dim=2)
    solved = torch.linalg.solve_ex(information, both)[0]
    covariance = noise[:, None, None].square() * (tangents.mT @ solved[..., :9])
    return covariance, -(tangents.mT @ solved[..., 9:]).squeeze(-1), noise
