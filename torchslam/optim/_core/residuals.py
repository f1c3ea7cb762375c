"""Reprojection errors of points in the camera frame: cost, first and second derivatives, per observation.

Everything that the camera model and the robust kernel contribute to a refinement is here, in terms of the point in the
camera frame (and, where it is free, of the camera's parameters). Poses and world points enter through the chain rule,
in `pose` and in `bundle`.

An observation of a point that cannot be projected (behind the camera, beyond the distortion's range) costs as much as
an error of the image's diagonal and has no gradient: no step gains by pushing a point behind the camera.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from torchslam.geometry.camera import Camera
from torchslam.geometry.gating import is_definite, whitening
from torchslam.geometry.robust import Kernel, robustify


@dataclass(frozen=True)
class ReprojectionData:
    """Pixels that points were seen at, and how errors are weighed.

    Attributes:
        weights: inverse variances, px^-2, or inverse covariances; zero where the observation does not count
        camera: parameters (P,) or (..., P)
        scale: scalar, or with the batch dimensions and a last one of size 1 or N
    """

    pixels: Float[Tensor, "*batch N 2"]
    weights: Float[Tensor, "*batch N"] | Float[Tensor, "*batch N 2 2"]
    camera: Camera
    kernel: Kernel
    scale: Float[Tensor, "..."]

    @property
    def has_matrices(self) -> bool:
        """Whether weights are inverse covariances: residuals and Jacobians then are whitened by them."""
        return self.weights.ndim == self.pixels.ndim + 1

    @property
    def factors(self) -> Float[Tensor, "*batch N"]:
        """Factors of squared residuals: the weights, or one where residuals are whitened."""
        return has_weight(self.weights).to(self.weights.dtype) if self.has_matrices else self.weights


ROUNDINGS = 16.0
"""Bound on the rounding error of a residual, in roundings of the largest coordinate that enters it."""


def rounding_cost(weights: Float[Tensor, "B ..."], params: Float[Tensor, "B C P"]) -> Float[Tensor, " B"]:
    """The cost of exact observations from rounding alone, below which there is nothing to be gained.

    Focal lengths and principal points bound the terms of a pixel's coordinates. Weights are inverse variances, or the
    diagonals of inverse covariances, zero where nothing counts.
    """
    pixels = params.detach()[..., :4].abs().amax((1, 2))
    rounding = ROUNDINGS * torch.finfo(pixels.dtype).eps * pixels
    return 0.5 * weights.detach().flatten(1).sum(1) * rounding.square()


class Linearization(NamedTuple):
    """Reprojection errors and their first derivatives.

    Attributes:
        residual: projected minus observed, px; whitened where weights are matrices
        J: d residual / d points_c, followed by d residual / d camera.params where it is free
        cost: contribution to the objective, half of rho
        weight: weights * rho', zero where the point cannot be projected
        curvature_term: c = 2 * weights^2 * rho''; weight * I + c r r^T is the Hessian of the cost in the residual
    """

    residual: Float[Tensor, "*batch N R"]
    J: Float[Tensor, "*batch N R D"]
    cost: Float[Tensor, "*batch N"]
    weight: Float[Tensor, "*batch N"]
    curvature_term: Float[Tensor, "*batch N"]

    @property
    def gradient_wrt_residual(self) -> Float[Tensor, "*batch N R"]:
        """The gradient of the cost with respect to the residual."""
        return self.weight[..., None] * self.residual


def usable(
    pixels: Float[Tensor, "*batch N 2"],
    points_w: Float[Tensor, "*batch N 3"],
    weights: Float[Tensor, "*batch N"] | Float[Tensor, "*batch N 2 2"],
) -> Bool[Tensor, "*batch N"]:
    """Whether all inputs of an observation are finite and its weight is not negative, or definite."""
    finite = torch.isfinite(pixels).all(-1) & torch.isfinite(points_w).all(-1)
    if weights.ndim == pixels.ndim + 1:
        return finite & torch.isfinite(weights).flatten(-2).all(-1) & is_definite(weights)
    return finite & torch.isfinite(weights) & (weights >= 0)


def only(
    use: Bool[Tensor, "*batch"], weights: Float[Tensor, "*batch"] | Float[Tensor, "*batch 2 2"]
) -> Float[Tensor, "*batch"] | Float[Tensor, "*batch 2 2"]:
    """Weights (..., N) or (..., N, 2, 2), zero outside of `use` (..., N)."""
    return torch.where(use if weights.ndim == use.ndim else use[..., None, None], weights, 0.0)


def has_weight(weights: Float[Tensor, "*batch 2 2"]) -> Bool[Tensor, "*batch"]:
    """Which of the matrices are not zero."""
    return weights.diagonal(dim1=-2, dim2=-1).sum(-1) > 0


def linearize(
    observations: ReprojectionData, points_c: Float[Tensor, "*batch N 3"], free_camera: bool = False
) -> Linearization:
    """Errors and Jacobians of finite points_c; each of (N, 3) may have a camera of its own."""
    if observations.camera.params.ndim == points_c.ndim:
        lin = linearize(_apart(observations), points_c[:, None], free_camera)
        return Linearization(*(part.squeeze(1) for part in lin))
    pixels, valid, J = _project(observations.camera, points_c, free_camera)
    residual = pixels - observations.pixels
    if observations.has_matrices:
        W = whitening(observations.weights)
        residual, J = (W @ residual[..., None]).squeeze(-1), W @ J
    return Linearization(residual, J, *weigh(observations, residual.square().sum(-1), valid))


def _apart(observations: ReprojectionData) -> ReprojectionData:
    """Observations (N,) as a batch of one each; their scale is a scalar or (N,)."""
    scale = observations.scale
    return replace(
        observations,
        pixels=observations.pixels[:, None],
        weights=observations.weights[:, None],
        scale=scale[:, None] if scale.ndim else scale,
    )


def weigh(
    observations: ReprojectionData, squared_px: Float[Tensor, "*batch N"], valid: Bool[Tensor, "*batch N"]
) -> tuple[Tensor, Tensor, Tensor]:
    """`cost`, `weight` and `curvature_term` of a `Linearization` by squared errors, px^2 or whitened; errors that are
    not valid have weight zero."""
    camera, weights = observations.camera, observations.factors
    diagonal: Tensor | float = float(camera.width**2 + camera.height**2)
    if observations.has_matrices:
        diagonal = 0.5 * diagonal * observations.weights.diagonal(dim1=-2, dim2=-1).sum(-1)
    squared = weights * torch.where(valid, squared_px, diagonal)
    rho, slope, curvature = robustify(squared, observations.kernel, observations.scale)
    counted = torch.where(valid, weights, 0.0)
    return 0.5 * rho, counted * slope, 2 * counted * counted * curvature


def _project(camera: Camera, points_c: Tensor, free_camera: bool) -> tuple[Tensor, Tensor, Tensor]:
    """Pixels, validity and Jacobian with respect to points_c and, where it is free, the camera."""
    if camera.model == "pinhole" and not free_camera:
        return _project_pinhole(camera, points_c)
    if not free_camera:
        return camera.project_with_point_jacobians(points_c)
    pixels, valid, J_points, J_camera = camera.project_with_jacobians(points_c)
    return pixels, valid, torch.cat((J_points, J_camera), dim=-1)


def _project_pinhole(camera: Camera, points_c: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Pixels, validity and d pixels / d points_c without distortion: a third of the general path's operations."""
    depth = points_c[..., 2:]
    valid = depth > torch.finfo(depth.dtype).eps
    focal, center = camera.params[..., None, :2], camera.params[..., None, 2:4]
    normalized = points_c[..., :2] / torch.where(valid, depth, 1.0)
    stretch = focal / torch.where(valid, depth, 1.0)
    (fx, fy), (x, y) = stretch.unbind(-1), (-stretch * normalized).unbind(-1)
    zero = torch.zeros_like(x)
    # Entry by entry in memory, as `gauss_newton_expansion` reads them.
    J_points = torch.stack((fx, zero, x, zero, fy, y)).unflatten(0, (2, 3)).movedim((0, 1), (-2, -1))
    return normalized * focal + center, valid[..., 0], J_points


def flat_along(
    weight: Float[Tensor, "*batch"],
    curvature_term: Float[Tensor, "*batch"],
    squared: Float[Tensor, "*batch"],
    use_curvature: Shaped[Tensor, "*#use"],
) -> Float[Tensor, "*batch"]:
    """The curvature term (..., N) that `gauss_newton_expansion` takes for residuals of these squares, px^2."""
    flat = -weight / torch.where(squared > 0, squared, 1.0)
    return torch.maximum(curvature_term, flat) * use_curvature


class Expansion(NamedTuple):
    """The second-order expansion of the cost in points_c, D = 3, and where it is free camera.params, D = 3 + P."""

    gradient: Float[Tensor, "*batch N D"]
    hessian: Float[Tensor, "*batch N D D"]

    def along(self, columns: Float[Tensor, "*#batch D n"]) -> Expansion:
        """The expansion in the coefficients of columns (..., D, n)."""
        gradient = (self.gradient[..., None, :] @ columns).squeeze(-2)
        return Expansion(gradient, columns.mT @ self.hessian @ columns)


def gauss_newton_expansion(
    lin: Linearization, J: Float[Tensor, "2 D *batch"], use_curvature: Shaped[Tensor, "*#use"]
) -> Expansion:
    """Gradient (D, ..., N) and Hessian (D, D, ..., N) of the cost, for pixels with Jacobians J (2, D, ..., N).

    The curvature of the projection is left out.

    `use_curvature`, broadcastable to (..., N), selects where the kernel's curvature counts. Across the residual of an
    outlier the Hessian is positive, along it negative: the negative part then counts as flat, which keeps the matrix
    positive semi-definite and converges several times faster close to the optimum. Elsewhere the curvature counts as
    zero (iteratively reweighted least squares), which descends from afar.
    Source: Triggs et al., "Bundle adjustment: a modern synthesis", 1999, section 4.3.
    """
    squared = lin.residual.square().sum(-1)
    return _expansion(lin, J, flat_along(lin.weight, lin.curvature_term, squared, use_curvature))


def newton_expansion(lin: Linearization, J: Float[Tensor, "2 D *batch"]) -> Expansion:
    """As `gauss_newton_expansion`, with the whole curvature of the kernel: close to the minimum alone."""
    return _expansion(lin, J, lin.curvature_term)


def _expansion(lin: Linearization, J: Float[Tensor, "2 D *batch"], curvature_term: Tensor) -> Expansion:
    """Gradient (D, ..., N) and Hessian (D, D, ..., N) of the cost, without the curvature of the projection."""
    pulled = (J[0] * lin.residual[..., 0]).addcmul(J[1], lin.residual[..., 1])  # J^T r
    weighted = lin.weight * J
    hessian = (weighted[0][:, None] * J[0]).addcmul(weighted[1][:, None], J[1])
    return Expansion(lin.weight * pulled, hessian.addcmul((curvature_term * pulled)[:, None], pulled))


def exact_expansion(
    observations: ReprojectionData, points_c: Float[Tensor, "*batch N 3"], free_camera: bool = False
) -> Expansion:
    """Exact gradient and Hessian of the cost per observation, with the curvature of kernel and projection; cameras as
    in `linearize`.

    The projection's own second derivative is that of J^T g with the gradient g in the residual fixed: autograd of the
    analytic Jacobian.
    """
    if observations.camera.params.ndim == points_c.ndim:
        expansion = exact_expansion(_apart(observations), points_c[:, None], free_camera)
        return Expansion(*(part.squeeze(1) for part in expansion))
    lin = linearize(observations, points_c, free_camera)
    gradient, hessian = _expansion(lin, lin.J.movedim((-2, -1), (0, 1)), lin.curvature_term)
    pull = lin.gradient_wrt_residual[..., None]
    if observations.has_matrices:
        pull = whitening(observations.weights).mT @ pull
    curvature = _projection_curvature(observations.camera, points_c, pull.detach(), free_camera)
    return Expansion(gradient.movedim(0, -1), hessian.movedim((0, 1), (-2, -1)) + curvature)


def _projection_curvature(
    camera: Camera,
    points_c: Float[Tensor, "*batch N 3"],
    gradient_wrt_residual: Float[Tensor, "*batch N 2 1"],
    free_camera: bool,
) -> Float[Tensor, "*batch N D D"]:
    """sum_k force_k * Hessian of pixel_k in (points_c, camera.params)."""
    if camera.model == "pinhole" and not free_camera:  # written out: a tenth of the time
        depth = points_c[..., 2:]
        inverse = torch.where(depth > torch.finfo(depth.dtype).eps, depth, 1.0).reciprocal()
        pulls = gradient_wrt_residual[..., 0] * camera.params[..., None, :2] * inverse.square()
        along = 2 * (pulls * points_c[..., :2] * inverse).sum(-1)
        (x, y), zero = (-pulls).unbind(-1), torch.zeros_like(along)
        rows = torch.stack((zero, zero, x, zero, zero, y, x, y, along)).unflatten(0, (3, 3))
        return rows.movedim((0, 1), (-2, -1))
    with torch.enable_grad():
        points = points_c.detach().clone().requires_grad_()
        variables = [points]
        if free_camera:  # a camera for each observation, which then has a gradient of its own
            params = camera.params.detach()[..., None, :].expand(*points.shape[:-1], -1)
            variables.append(params.clone().requires_grad_())
            camera, points = camera.with_params(variables[1]), points[..., None, :]
        J = _project(camera, points, free_camera)[2]
        J = J.reshape(*points_c.shape[:-1], *J.shape[-2:])
        gradient = (J.mT @ gradient_wrt_residual).squeeze(-1)
        entries = torch.eye(gradient.shape[-1], dtype=J.dtype, device=J.device)
        entries = entries.expand(*gradient.shape, -1).movedim(-1, 0)
        rows = torch.autograd.grad(gradient, variables, entries, is_grads_batched=True)
    return torch.cat(rows, dim=-1).movedim(0, -2)


def variance_factor(
    observations: ReprojectionData, linearization: Linearization, num_parameters: int | Int[Tensor, "*batch"]
) -> Float[Tensor, "*batch"]:
    """What to multiply the inverse reweighted normal matrix with to get the covariance of the estimate.

    From the residuals at the minimum: mean psi^2 times mean weight over the squared mean slope of psi, psi = rho' r,
    with Huber's correction for small samples; for least squares this is the variance of unit weight. One where there is
    no redundancy. Source: Huber, "Robust statistics", 1981, section 7.6.
    """
    across, along, variance, components = _slopes(observations, linearization)
    squared = linearization.residual.square().sum(-1)
    mean_slope = (across + along).sum(-1) / components
    redundant = (components > num_parameters) & (mean_slope > 0)
    mean_slope = torch.where(redundant, mean_slope, 1.0)
    spread = (across.square() + along.square()).sum(-1) / components / mean_slope.square() - 1
    correction = 1 + num_parameters / components.float() * spread
    psi_squared = (linearization.weight.square() * squared * variance).sum(-1)
    psi_squared = psi_squared / torch.where(redundant, components - num_parameters, 1)
    mean_weight = 2 * across.sum(-1) / components
    factor = correction.square() * psi_squared * mean_weight / mean_slope.square()
    return torch.where(redundant, factor, 1.0)


def flatness(observations: ReprojectionData, linearization: Linearization) -> Float[Tensor, "*batch"]:
    """Mean weight over the mean slope of psi = rho' r: how much flatter the cost is than its reweighted normal matrix.

    1 for least squares, more under a robust kernel, whose weights fall with the residual. The inverse reweighted normal
    matrix, multiplied with it, is that of the expected Hessian. Source: as of `variance_factor`.
    """
    across, along, _, components = _slopes(observations, linearization)
    mean_slope = (across + along).sum(-1) / components
    determined = (components > 0) & (mean_slope > 0)
    mean_weight = 2 * across.sum(-1) / components
    return torch.where(determined, mean_weight / torch.where(determined, mean_slope, 1.0), 1.0)


def _slopes(
    observations: ReprojectionData, linearization: Linearization
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The slope of psi across each residual (*batch, N) and along it, the stated variances, and how many components
    count (*batch,)."""
    weights = observations.factors
    counted = (linearization.weight > 0) & (weights > 0)
    variance = torch.where(counted, 1 / torch.where(counted, weights, 1.0), 0.0)
    across = linearization.weight * variance
    along = across + linearization.curvature_term * linearization.residual.square().sum(-1) * variance
    return across, along, variance, 2 * counted.sum(-1)
