"""Refinement of camera poses against known points: batched, robust, differentiable.

In the local quadratic models, which take most of the time, rows of Jacobians run along the observations, (B, D, N): one
matrix product per problem makes Hessian and gradient, and every operation before it streams through contiguous memory.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchslam.geometry.camera import Camera
from torchslam.geometry.lie import transform
from torchslam.geometry.precision import check_dtypes, full_precision
from torchslam.geometry.robust import Kernel, kernel_scale
from torchslam.optim._core.implicit import Ndims, Tensors, find_minimum
from torchslam.optim._core.levenberg_marquardt import (
    Convergence,
    SolverReason,
    check_minimum,
    minimize_batch,
    select_models,
)
from torchslam.optim._core.linear import diagonal_floor, factorize
from torchslam.optim._core.options import POSE_OPTIONS, SolverOptions
from torchslam.optim._core.residuals import (
    ReprojectionData,
    Weighed,
    exact_expansion,
    linearize,
    only,
    usable,
    variance_factor,
    weigh,
)
from torchslam.optim._core.tangent import (
    PosePrior,
    move,
    point_jacobian,
    prior_expansion,
    prior_hessian,
    pull_back,
    push,
    retract,
)


class PoseModel(NamedTuple):
    """The local model of the cost at poses T_cw (B, 4, 4): cost (B,), gradient (B, 6), hessian (B, 6, 6) in xi.

    Attributes:
        hessian: of iteratively reweighted least squares, positive semi-definite, for steps far from the optimum
        curvature_term: curvature of the kernel near the optimum, never positive: the steps become
            Newton steps, several times as effective; zero elsewhere
    """

    T_cw: Float[Tensor, "B 4 4"]
    cost: Float[Tensor, " B"]
    gradient: Float[Tensor, "B 6"]
    hessian: Float[Tensor, "B 6 6"]
    curvature_term: Float[Tensor, "B 6 6"]


class PoseObservations:
    """Observations (B, N) of known points, laid out for expansions at many poses."""

    def __init__(self, points_w: Float[Tensor, "B N 3"], observations: ReprojectionData) -> None:
        """points_w: (B, N, 3)"""
        self.observations = observations
        camera = observations.camera
        self.points_w = points_w.mT.contiguous()
        self.pinhole = camera.model == "pinhole" and not observations.has_matrices
        self.metric = camera.params.new_ones(1, 1)  # what turns products of rows into those of pixels
        if self.pinhole:
            focal, center = camera.params[..., :2, None], camera.params[..., 2:4, None]
            self.normalized = ((observations.pixels.mT - center) / focal).contiguous()
            self.metric = focal.square()  # (2, 1) or (B, 2, 1)

    def expand(self, T_cw: Float[Tensor, "B 4 4"], use_curvature: Bool[Tensor, " B"]) -> PoseModel:
        """The model at T_cw (B, 4, 4); `use_curvature` (B,) selects where to add the curvature term."""
        points_c = torch.baddbmm(T_cw[:, :3, 3:], T_cw[:, :3, :3], self.points_w)
        rows, (cost, weight, curvature_term) = (
            self._pinhole(points_c) if self.pinhole else self._general(points_c)
        )
        moments = (rows * (weight[:, None] * self.metric)[:, None]).flatten(2) @ rows.flatten(2).mT
        hessian, gradient = moments[:, :6, :6], moments[:, :6, 6]
        if use_curvature.any():
            pulls = (rows[:, :6] * (self.metric[..., None, :, :] * rows[:, 6:])).sum(2)
            added = (pulls * (curvature_term * use_curvature[:, None])[:, None]) @ pulls.mT
        else:
            added = torch.zeros_like(hessian)
        return PoseModel(T_cw, cost.sum(-1), gradient, hessian, added)

    def _pinhole(self, points_c: Tensor) -> tuple[Tensor, Weighed]:
        """Rows (B, 7, 2, N) of d residual / d xi and of the residual, in units of the focal length."""
        depth = points_c[:, 2:]
        valid = depth > torch.finfo(depth.dtype).eps
        inverse = torch.where(valid, depth, 1.0).reciprocal()
        xy = points_c[:, :2] * inverse
        residual = xy - self.normalized
        squared_px = (self.metric * residual.square()).sum(1)

        inverse = inverse[:, 0]
        u, v = xy.unbind(1)
        zero, product = torch.zeros_like(u), u * v
        # d(u, v) / d(translation), then / d(rotation): each line is a column of the Jacobian.
        columns = (
            *(inverse, zero),
            *(zero, inverse),
            *(-inverse * u, -inverse * v),
            *(-product, -1 - v * v),
            *(1 + u * u, product),
            *(-v, u),
            *residual.unbind(1),
        )
        rows = torch.stack(columns, dim=1).unflatten(1, (7, 2))
        return rows, weigh(self.observations, squared_px, valid[:, 0])

    def _general(self, points_c: Tensor) -> tuple[Tensor, Weighed]:
        """As `_pinhole`, for any camera; rows are in pixels."""
        points_c = points_c.mT
        lin = linearize(self.observations, points_c)
        J_rotation = torch.linalg.cross(points_c[..., None, :].expand_as(lin.J), lin.J)
        rows = torch.cat((lin.J, J_rotation, lin.residual[..., None]), dim=-1)
        return rows.permute(0, 3, 2, 1), Weighed(lin.cost, lin.weight, lin.curvature_term)


_MIN_POINTS = 3
"""Points that determine a pose, by two equations each for six unknowns."""


@dataclass(frozen=True)
class PoseInputs:
    """What a pose problem is made of: finite tensors, rows that do not count having weight zero."""

    points_w: Tensor
    observations: ReprojectionData
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
    ) -> PoseInputs:
        if T_cw.shape[1:] != (4, 4) or points_w.ndim != 3 or pixels.ndim != 3:
            raise ValueError(
                "T_cw, points_w and pixels must be (B, 4, 4), (B, N, 3) and (B, N, 2), not "
                f"{tuple(T_cw.shape)}, {tuple(points_w.shape)} and {tuple(pixels.shape)}"
            )
        prior_T, information = (None, None) if prior is None else (prior.T_cw, prior.information)
        check_dtypes(
            T_cw=T_cw,
            points_w=points_w,
            pixels=pixels,
            weights=weights,
            camera_params=camera.params,
            prior_T_cw=prior_T,
            prior_information=information,
        )
        batch, count = T_cw.shape[0], points_w.shape[1]
        shapes = [(size, count, *matrix) for size in (batch, 1) for matrix in ((), (2, 2))]
        if weights is not None and weights.shape not in shapes:
            raise ValueError(
                f"weights must be (B, N) = {(batch, count)} or (B, N, 2, 2), not {tuple(weights.shape)}"
            )
        points_w, pixels = points_w.expand(batch, count, 3), pixels.expand(batch, count, 2)
        weights = torch.ones_like(pixels[..., 0]) if weights is None else weights
        weights = weights.expand(batch, *weights.shape[1:])
        use = usable(pixels, points_w, weights)
        use = use if mask is None else use & mask
        rows = use[..., None]
        scale = kernel_scale(scale, T_cw)
        if prior is not None:
            prior = PosePrior(prior.T_cw.expand(batch, 4, 4), prior.information.expand(batch, 6, 6))
        # A copy, as of the others: parameters may move in place before the covariance is asked for.
        camera = camera.with_params(camera.params.clone())
        observations = ReprojectionData(
            torch.where(rows, pixels, 0.0), only(use, weights), camera, kernel, scale[..., None]
        )
        return PoseInputs(torch.where(rows, points_w, 0.0), observations, prior)

    def tensors(self) -> list[Tensor]:
        """All that gradients may flow to."""
        prior = () if self.prior is None else (self.prior.T_cw, self.prior.information)
        return [self.points_w, *self.observations.tensors(), *prior]

    def replaced(self, tensors: Sequence[Tensor]) -> PoseInputs:
        """The same problem with other tensors, in the order of `tensors`."""
        points_w, *rest = tensors
        prior = None if self.prior is None else PosePrior(*rest[4:])
        return PoseInputs(points_w, self.observations.replaced(rest[:4]), prior)


class PoseProblem:
    """The least-squares problem of `solve_pose` for `minimize_batch`, with covariances and the exact Hessian."""

    def __init__(self, inputs: PoseInputs) -> None:
        self.points_w, self.observations, self.prior = inputs.points_w, inputs.observations, inputs.prior
        self.laid_out = PoseObservations(inputs.points_w, inputs.observations)
        self.eye = torch.eye(6, dtype=self.points_w.dtype, device=self.points_w.device)
        counted = (self.observations.factors > 0).sum(-1)
        self.solvable = counted >= (_MIN_POINTS if self.prior is None else 0)

    def evaluate(self, T_cw: Tensor, use_curvature: Tensor) -> PoseModel:
        model = self.laid_out.expand(T_cw, use_curvature)
        if self.prior is None:
            return model
        cost, gradient, hessian = prior_expansion(self.prior, T_cw)
        return model._replace(
            cost=model.cost + cost, gradient=model.gradient + gradient, hessian=model.hessian + hessian
        )

    def step(self, model: PoseModel, damping: Tensor) -> tuple[Tensor, Tensor]:
        # Elements without any weight stay solvable: their step is zero.
        grow, floor = 1 + damping[:, None, None] * self.eye, diagonal_floor(damping.dtype) * self.eye
        damped = (model.hessian + model.curvature_term) * grow + floor
        factor, failed = torch.linalg.cholesky_ex(damped)
        if failed.any():
            damped = torch.where((failed > 0)[:, None, None], model.hessian * grow + floor, damped)
            factor, _ = torch.linalg.cholesky_ex(damped)
        xi = -torch.cholesky_solve(model.gradient[..., None], factor).squeeze(-1)
        return retract(model.T_cw, xi), -0.5 * (xi * model.gradient).sum(-1)

    def select(self, accept: Tensor, new: PoseModel, old: PoseModel) -> PoseModel:
        return select_models(accept, new, old._replace(curvature_term=torch.zeros_like(old.curvature_term)))

    def covariance(self, T_cw: Float[Tensor, "B 4 4"]) -> Float[Tensor, "B 6 6"]:
        """Covariances (B, 6, 6) at minima, zero where the pose is not determined."""
        lin = linearize(self.observations, transform(T_cw, self.points_w))
        factor = variance_factor(self.observations, lin, num_parameters=6)[:, None, None]
        information = self.laid_out.expand(T_cw, torch.zeros_like(self.solvable)).hessian
        if self.prior is not None:  # in absolute units, which the residuals do not calibrate
            information = information + factor * prior_expansion(self.prior, T_cw)[2]
        return factor * factorize(information).solve(self.eye.expand_as(information))

    def hessian(self, T_cw: Float[Tensor, "B 4 4"]) -> Float[Tensor, "B 6 6"]:
        """The exact Hessian (B, 6, 6) of the cost in xi."""
        points_c = transform(T_cw, self.points_w)
        gradient, hessian = exact_expansion(self.observations, points_c)
        G = point_jacobian(points_c)
        result = G.flatten(-3, -2).mT @ (hessian @ G).flatten(-3, -2)
        # The curvature of the rotation itself: half of gradient . (omega x (omega x p)).
        outer = gradient.mT @ points_c
        curvature_term = (
            0.5 * (outer + outer.mT)
            - outer.diagonal(dim1=-2, dim2=-1).sum(-1)[:, None, None] * self.eye[:3, :3]
        )
        result = result + torch.nn.functional.pad(curvature_term, (3, 0, 3, 0))
        return result if self.prior is None else result + prior_hessian(self.prior, T_cw)


class PoseMinimization:
    """`solve_pose` for `find_minimum`: found are the poses, and `success`, `cost` and how it went."""

    num_unknowns = 1
    num_vectors = 1

    def __init__(self, inputs: PoseInputs, iterations: int, tolerance: float) -> None:
        self.inputs, self.iterations, self.tolerance = inputs, iterations, tolerance
        prior = () if inputs.prior is None else (2, 2)
        weights = inputs.observations.weights.ndim - 1
        self.ndims: tuple[Ndims, Ndims, Ndims] | None = (
            (1,),
            (2, 0, 0, 0, 0, 0),
            (2, 2, 2, weights, 1, 1, *prior),
        )

    def minimize(self, inputs: Tensors) -> Tensors:
        T_cw, problem = inputs[0], PoseProblem(self.inputs.replaced(inputs[1:]))
        finite = torch.isfinite(T_cw).flatten(1).all(-1)
        identity = torch.eye(4, dtype=T_cw.dtype, device=T_cw.device)
        start = torch.where(finite[:, None, None], T_cw, identity)
        model, convergence = minimize_batch(problem, start, self.iterations, self.tolerance)
        with torch.no_grad():
            success = problem.solvable & factorize(model.hessian).definite & finite
        refined = torch.where(success[:, None, None], model.T_cw, start.detach())
        how = convergence.iterations, convergence.converged, convergence.initial_cost
        return refined, success, convergence.cost, *how

    def factorized(self, found: Tensors, inputs: Tensors) -> Callable[[Tensors], Tensors]:
        T_cw, success, *_ = found
        with torch.no_grad():
            factor = factorize(PoseProblem(self.inputs.replaced(inputs[1:])).hessian(T_cw))

        def solve(right: Tensors) -> Tensors:
            right_of_successes = torch.where(success[:, None], right[0], 0.0)
            return (factor.solve(right_of_successes[..., None]).squeeze(-1),)

        return solve

    def slope(self, found: Tensors, inputs: Tensors, direction: Tensors) -> Tensor:
        T_cw, (xi,), problem = found[0], direction, self.inputs.replaced(inputs[1:])
        points_c = transform(T_cw, problem.points_w)
        lin = linearize(problem.observations, points_c)
        velocity = lin.J @ move(points_c, xi[:, None])[..., None]
        slope = (lin.gradient_wrt_residual[..., None, :] @ velocity).sum()
        if problem.prior is not None:
            slope = slope + (prior_expansion(problem.prior, T_cw)[1] * xi).sum()
        return slope

    def retracted(self, found: Tensors, direction: Tensors) -> Tensors:
        return retract(found[0], direction[0]), *found[1:]

    def push(self, found: Tensors, direction: Tensors) -> Tensors:
        return (push(found[0], direction[0]),)

    def pull_back(self, found: Tensors, gradient: Tensors) -> Tensors:
        return (pull_back(found[0], gradient[0]),)


@dataclass(frozen=True)
class RefinedPose:
    """Poses at the minimum of their robust reprojection error.

    Attributes:
        T_cw: world to camera; the start, without gradient, where `success` is False.
        cost: half the sum of robustified squared whitened residuals, detached.
        success: the start is finite, and the usable points (at least three) or the prior determine the pose.
        convergence: iterations and convergence per element.
    """

    T_cw: Float[Tensor, "B 4 4"]
    cost: Float[Tensor, " B"]
    success: Bool[Tensor, " B"]
    convergence: Convergence
    _inputs: PoseInputs = field(repr=False)

    @property
    def converged(self) -> Bool[Tensor, " B"]:
        """The search ended at a minimum. Elsewhere the gradient may be wrong by any factor, `success` or not."""
        return self.convergence.converged.view_as(self.success)

    @property
    def reasons(self) -> list[SolverReason]:
        """How the search ended, for each pose."""
        return self.convergence.reasons(self.success)

    @cached_property
    def covariance(self) -> Float[Tensor, "B 6 6"]:
        """Covariance of the left perturbation (translation, rotation), detached; zero where `success` is False.

        Calibrated by the residuals themselves, so the weights need to be right only up to a factor.
        """
        with torch.no_grad():
            covariance = PoseProblem(self._inputs).covariance(self.T_cw)
            return torch.where(self.success[:, None, None], covariance, 0.0)


@full_precision
def solve_pose(
    points_w: Float[Tensor, "#B N 3"],
    pixels: Float[Tensor, "#B N 2"],
    *,
    T_cw: Float[Tensor, "B 4 4"],
    camera: Camera,
    weights: Float[Tensor, "#B N"] | Float[Tensor, "#B N 2 2"] | None = None,
    mask: Bool[Tensor, "#B N"] | None = None,
    prior: PosePrior | None = None,
    options: SolverOptions = POSE_OPTIONS,
) -> RefinedPose:
    """Minimize robust reprojection errors over poses by Levenberg-Marquardt, many problems at once.

    Args:
        points_w: known points.
        pixels: where they are seen.
        T_cw: world to camera, the start.
        camera: of all problems, params (P,), or of one each, (B, P).
        weights: inverse variances in px^-2, or (B, N, 2, 2) inverse covariances, which count where they are
            positive definite; one if None.
        mask: the observations that count, all if None. Observations that are not finite never count.
        prior: Gaussian prior on the poses, in the same units.
        options: how to minimize; gradients reach points, pixels, weights, camera.params, scale and prior.

    Returns:
        The poses. Where `success` is False (too few points, or a pose that they do not determine), the gradient is
        zero. The implicit gradient is also zero where the exact Hessian is not positive definite.

    Raises:
        ValueError: a shape does not fit, or a name is unknown.
        ConvergenceError: with `options.strict`.
    """
    inputs = PoseInputs.sanitized(
        T_cw, points_w, pixels, camera, weights, mask, options.kernel, options.scale, prior
    )
    minimization = PoseMinimization(inputs, options.iterations, options.tolerance)
    tensors = (T_cw, *inputs.tensors())
    found = find_minimum(minimization, tensors, options.backward)
    refined, success, cost, steps, converged, initial_cost = found
    if options.strict:
        check_minimum(success, converged, "poses")
    if options.backward == "truncated":
        problem = PoseProblem(inputs)
        last, _ = problem.step(problem.evaluate(refined, ~success), torch.zeros_like(cost))
        refined = torch.where(success[:, None, None], last, refined)
    return RefinedPose(
        refined, cost, success, Convergence(steps, converged, initial_cost, cost, options.iterations), inputs
    )
