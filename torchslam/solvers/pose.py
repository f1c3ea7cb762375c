"""Refinement of camera poses against known points: batched, robust, differentiable."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import torch
from torch import Tensor

from torchslam.geometry.camera import Camera
from torchslam.geometry.lie import transform
from torchslam.solvers.implicit import Backward, attach, check_backward
from torchslam.solvers.levenberg import Convergence, minimize
from torchslam.solvers.linear import factorize
from torchslam.solvers.pose_expansion import PoseModel, PoseObservations
from torchslam.solvers.prior import PosePrior, prior_expansion, prior_hessian
from torchslam.solvers.residuals import (
    Observations,
    exact_expansion,
    linearize,
    usable,
    variance_factor,
)
from torchslam.solvers.robust import Kernel
from torchslam.solvers.tangent import move, point_jacobian, pull_back, retract

_MIN_POINTS = 3


@dataclass(frozen=True)
class RefinedPose:
    """Poses at the minimum of their robust reprojection error.

    T_cw:        (B, 4, 4) world to camera; the start, without gradient, where `success` is False
    cost:        (B,) half the sum of robustified squared whitened residuals, detached
    success:     (B,) bool, the usable points (at least three) or the prior determine the pose
    convergence: iterations and convergence per element
    """

    T_cw: Tensor
    cost: Tensor
    success: Tensor
    convergence: Convergence
    _problem: _PoseProblem = field(repr=False)

    @cached_property
    def covariance(self) -> Tensor:
        """(B, 6, 6) of the left perturbation (translation, rotation), detached; zero where `success` is False.

        Calibrated by the residuals themselves, so the weights need to be right only up to a factor.
        """
        with torch.no_grad():
            return torch.where(self.success[:, None, None], self._problem.covariance(self.T_cw), 0.0)


def refine_pose(
    T_cw: Tensor,
    points_w: Tensor,
    pixels: Tensor,
    camera: Camera,
    weights: Tensor | None = None,
    mask: Tensor | None = None,
    kernel: Kernel = "cauchy",
    scale: Tensor | float = 1.0,
    prior: PosePrior | None = None,
    backward: Backward = "implicit",
    iterations: int = 20,
    tolerance: float = 1e-10,
) -> RefinedPose:
    """Minimise robust reprojection errors over poses by Levenberg-Marquardt, many problems at once.

    T_cw:      (B, 4, 4) start
    points_w:  (B, N, 3), pixels: (B, N, 2); points or pixels of a batch of one broadcast
    weights:   (B, N) inverse variances in px^-2, one if None
    mask:      (B, N) bool, all if None; rows that are not finite are left out in any case
    scale:     of the kernel, in units of the whitened residual: a number, a scalar tensor or (B,)
    prior:     a Gaussian on the poses, in the same units
    backward:  how gradients reach points, pixels, weights, camera.params, scale and prior, see `implicit.Backward`
    tolerance: stop where a step promises to lower the cost by less than this share of it

    An element that fails (too few points, pose not determined) has `success` False and a zero gradient. The implicit
    gradient is zero as well where the exact Hessian is not positive definite, that is, not at a strict minimum.
    Raises ValueError for shapes that do not fit and for unknown names.
    """
    check_backward(backward)
    inputs = _Inputs.sanitized(T_cw, points_w, pixels, camera, weights, mask, kernel, scale, prior)
    identity = torch.eye(4, dtype=T_cw.dtype, device=T_cw.device)
    start = torch.where(torch.isfinite(T_cw).flatten(1).all(-1)[:, None, None], T_cw, identity)

    with torch.set_grad_enabled(torch.is_grad_enabled() and backward == "unroll"):
        problem = _PoseProblem(inputs)
        model, convergence = minimize(problem, start, iterations, tolerance)
    with torch.no_grad():
        success = problem.solvable & factorize(model.hessian).definite
    good = success[:, None, None]
    refined = torch.where(good, model.T_cw, start.detach())

    if backward == "implicit" and torch.is_grad_enabled():
        minimum = refined

        def adjoint(grad_solution: Sequence[Tensor], tensors: Sequence[Tensor]) -> Tensor:
            return _PoseProblem(inputs.replaced(tensors)).adjoint(minimum, grad_solution[0], success)

        (refined,) = attach((minimum,), inputs.tensors(), adjoint)
    elif backward == "truncated":
        problem = _PoseProblem(inputs)
        last, _ = problem.step(problem.evaluate(refined, ~success), torch.zeros_like(convergence.cost))
        refined = torch.where(good, last, refined)
    return RefinedPose(refined, convergence.cost, success, convergence, problem)


@dataclass(frozen=True)
class _Inputs:
    """What a pose problem is made of: finite tensors, rows that do not count having weight zero."""

    points_w: Tensor
    observations: Observations
    prior: PosePrior | None

    @staticmethod
    def sanitized(
        T_cw: Tensor,
        points_w: Tensor,
        pixels: Tensor,
        camera: Camera,
        weights: Tensor | None,
        mask: Tensor | None,
        kernel: Kernel,
        scale: Tensor | float,
        prior: PosePrior | None,
    ) -> _Inputs:
        if T_cw.shape[1:] != (4, 4) or points_w.ndim != 3 or pixels.ndim != 3:
            raise ValueError(
                "T_cw, points_w and pixels must be (B, 4, 4), (B, N, 3) and (B, N, 2), not "
                f"{tuple(T_cw.shape)}, {tuple(points_w.shape)} and {tuple(pixels.shape)}"
            )
        batch, count = T_cw.shape[0], points_w.shape[1]
        points_w, pixels = points_w.expand(batch, count, 3), pixels.expand(batch, count, 2)
        weights = torch.ones_like(pixels[..., 0]) if weights is None else weights.expand(batch, count)
        use = usable(pixels, points_w, weights)
        use = use if mask is None else use & mask
        rows = use[..., None]
        scale = torch.as_tensor(scale, dtype=T_cw.dtype, device=T_cw.device)
        observations = Observations(
            torch.where(rows, pixels, 0.0), torch.where(use, weights, 0.0), camera, kernel, scale[..., None]
        )
        return _Inputs(torch.where(rows, points_w, 0.0), observations, prior)

    def tensors(self) -> list[Tensor]:
        """All that gradients may flow to."""
        prior = () if self.prior is None else (self.prior.T_cw, self.prior.information)
        return [self.points_w, *self.observations.tensors(), *prior]

    def replaced(self, tensors: Sequence[Tensor]) -> _Inputs:
        """The same problem with other tensors, in the order of `tensors`."""
        points_w, *rest = tensors
        prior = None if self.prior is None else PosePrior(*rest[4:])
        return _Inputs(points_w, self.observations.replaced(rest[:4]), prior)


class _PoseProblem:
    """The least-squares problem of `refine_pose`: for `minimize`, and what follows from its minimum."""

    def __init__(self, inputs: _Inputs) -> None:
        self.points_w, self.observations, self.prior = inputs.points_w, inputs.observations, inputs.prior
        self.laid_out = PoseObservations(inputs.points_w, inputs.observations)
        self.eye = torch.eye(6, dtype=self.points_w.dtype, device=self.points_w.device)
        counted = (self.observations.weights > 0).sum(-1)
        self.solvable = counted >= (_MIN_POINTS if self.prior is None else 0)

    def evaluate(self, T_cw: Tensor, near: Tensor) -> PoseModel:
        model = self.laid_out.expand(T_cw, near)
        if self.prior is None:
            return model
        cost, gradient, hessian = prior_expansion(self.prior, T_cw)
        return model._replace(
            cost=model.cost + cost, gradient=model.gradient + gradient, hessian=model.hessian + hessian
        )

    def step(self, model: PoseModel, damping: Tensor) -> tuple[Tensor, Tensor]:
        # Elements without any weight stay solvable: their step is zero.
        grow, floor = 1 + damping[:, None, None] * self.eye, torch.finfo(damping.dtype).tiny ** 0.5 * self.eye
        damped = (model.hessian + model.bend) * grow + floor
        factor, failed = torch.linalg.cholesky_ex(damped)
        if failed.any():
            damped = torch.where((failed > 0)[:, None, None], model.hessian * grow + floor, damped)
            factor, _ = torch.linalg.cholesky_ex(damped)
        xi = -torch.cholesky_solve(model.gradient[..., None], factor).squeeze(-1)
        return retract(model.T_cw, xi), -0.5 * (xi * model.gradient).sum(-1)

    def select(self, accept: Tensor, new: PoseModel, old: PoseModel) -> PoseModel:
        if accept.all():
            return new
        matrix, vector = accept[:, None, None], accept[:, None]
        return PoseModel(
            torch.where(matrix, new.T_cw, old.T_cw),
            torch.where(accept, new.cost, old.cost),
            torch.where(vector, new.gradient, old.gradient),
            torch.where(matrix, new.hessian, old.hessian),
            torch.where(matrix, new.bend, 0.0),
        )

    def covariance(self, T_cw: Tensor) -> Tensor:
        """Covariances (B, 6, 6) at minima, zero where the pose is not determined."""
        lin = linearize(self.observations, transform(T_cw, self.points_w))
        factor = variance_factor(self.observations, lin, num_parameters=6)[:, None, None]
        information = self.laid_out.expand(T_cw, torch.zeros_like(self.solvable)).hessian
        if self.prior is not None:  # in absolute units, which the residuals do not calibrate
            information = information + factor * prior_expansion(self.prior, T_cw)[2]
        return factor * factorize(information).solve(self.eye.expand_as(information))

    def adjoint(self, T_cw: Tensor, grad_T_cw: Tensor, success: Tensor) -> Tensor:
        """g(T_cw, inputs) . lambda with H lambda = the loss's gradient in xi, for `implicit.attach`."""
        with torch.no_grad():
            grad_xi = torch.where(success[:, None], pull_back(T_cw, grad_T_cw), 0.0)
            direction = factorize(self.hessian(T_cw)).solve(grad_xi[..., None]).squeeze(-1)
        points_c = transform(T_cw, self.points_w)
        lin = linearize(self.observations, points_c)
        velocity = lin.J @ move(points_c, direction[:, None])[..., None]
        slope = (lin.force[..., None, :] @ velocity).sum()
        if self.prior is not None:
            slope = slope + (prior_expansion(self.prior, T_cw)[1] * direction).sum()
        return slope

    def hessian(self, T_cw: Tensor) -> Tensor:
        """The exact Hessian (B, 6, 6) of the cost in xi."""
        points_c = transform(T_cw, self.points_w)
        gradient, hessian = exact_expansion(self.observations, points_c)
        G = point_jacobian(points_c)
        result = G.flatten(-3, -2).mT @ (hessian @ G).flatten(-3, -2)
        # The bend of the rotation itself: half of gradient . (omega x (omega x p)).
        outer = gradient.mT @ points_c
        bend = (
            0.5 * (outer + outer.mT)
            - outer.diagonal(dim1=-2, dim2=-1).sum(-1)[:, None, None] * self.eye[:3, :3]
        )
        result = result + torch.nn.functional.pad(bend, (3, 0, 3, 0))
        return result if self.prior is None else result + prior_hessian(self.prior, T_cw)
