"""Refinement of camera poses against known points: batched, robust, differentiable.

In the local quadratic models, which take most of the time, rows of Jacobians run along the observations, (B, D, N): one
matrix product per problem makes Hessian and gradient, and every operation before it streams through contiguous memory.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchslam.geometry.camera import Camera
from torchslam.geometry.lie import transform
from torchslam.geometry.precision import full_precision
from torchslam.geometry.robust import kernel_scale
from torchslam.optim._core.implicit import Minimization, Ndims, Tensors, find_minimum
from torchslam.optim._core.levenberg_marquardt import (
    POSE_OPTIONS,
    Convergence,
    Outcome,
    SolverOptions,
    check_minimum,
    minimize_batch,
    select_models,
    warned,
)
from torchslam.optim._core.linear import diagonal_floor, factorize
from torchslam.optim._core.residuals import (
    ReprojectionData,
    exact_expansion,
    linearize,
    only,
    usable,
    variance_factor,
    weigh,
)
from torchslam.optim._core.tangent import (
    PosePrior,
    cross_entries,
    move,
    prior_expansion,
    prior_hessian,
    pull_back,
    push,
    retract,
)


class PoseModel(NamedTuple):
    """The local model of the cost at poses, in xi: the Hessian of iteratively reweighted least squares, which is
    positive semi-definite, and the kernel's curvature near the optimum, never positive, for Newton's steps."""

    T_cw: Float[Tensor, "B 4 4"]
    cost: Float[Tensor, " B"]
    gradient: Float[Tensor, "B 6"]
    hessian: Float[Tensor, "B 6 6"]
    curvature_term: Float[Tensor, "B 6 6"]


class PoseProblem:
    """The least-squares problem of `solve_pose` for `minimize_batch`, with covariances and the exact Hessian."""

    concludes = False

    def __init__(self, points_w: Tensor, observations: ReprojectionData, prior: PosePrior | None) -> None:
        """Take finite tensors; rows that do not count have weight zero."""
        self.points_w, self.observations, self.prior = points_w, observations, prior
        self.eye = torch.eye(6, dtype=self.points_w.dtype, device=self.points_w.device)
        counted = (self.observations.factors > 0).sum(-1)
        self.solvable = counted >= (3 if self.prior is None else 0)  # two equations each for six unknowns
        camera = self.observations.camera
        self._columns_w = self.points_w.mT.contiguous()
        self._is_pinhole = camera.model == "pinhole" and not self.observations.has_matrices
        self._metric = camera.params.new_ones(1, 1)  # what turns products of rows into those of pixels
        if self._is_pinhole:
            focal, center = camera.params[..., :2, None], camera.params[..., 2:4, None]
            self._normalized = ((self.observations.pixels.mT - center) / focal).contiguous()
            self._metric = focal.square()  # (2, 1) or (B, 2, 1)

    def evaluate(self, T_cw: Tensor, use_curvature: Tensor) -> PoseModel:
        model = self.expand(T_cw, use_curvature)
        if self.prior is None:
            return model
        cost, gradient, hessian = prior_expansion(self.prior, T_cw)
        return model._replace(
            cost=model.cost + cost, gradient=model.gradient + gradient, hessian=model.hessian + hessian
        )

    def expand(self, T_cw: Float[Tensor, "B 4 4"], use_curvature: Bool[Tensor, " B"]) -> PoseModel:
        """The model of the observations alone."""
        return self._expanded(T_cw, use_curvature)[0]

    def _expanded(self, T_cw: Tensor, use_curvature: Tensor) -> tuple[PoseModel, Tensor, Tensor, Tensor]:
        """`expand`, the points (B, 3, N) in the camera, and the rows (B, 7, 2, N), also weighted."""
        points_c = torch.baddbmm(T_cw[:, :3, 3:], T_cw[:, :3, :3], self._columns_w)
        expanded = self._pinhole(points_c) if self._is_pinhole else self._general(points_c)
        rows, (cost, weight, curvature_term) = expanded
        weight = weight[:, None] * self._metric
        weighted = rows * weight[:, None]
        moments = weighted.flatten(2) @ rows.flatten(2).mT
        hessian, gradient = moments[:, :6, :6], moments[:, :6, 6]
        added = torch.zeros_like(hessian)
        if self.observations.kernel != "none" and use_curvature.any():
            pulls = (rows[:, :6] * (self._metric[..., None, :, :] * rows[:, 6:])).sum(2)
            added = (pulls * (curvature_term * use_curvature[:, None])[:, None]) @ pulls.mT
        return PoseModel(T_cw, cost.sum(-1), gradient, hessian, added), points_c, rows, weighted

    def _pinhole(self, points_c: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor]]:
        """Rows (B, 7, 2, N) of d residual / d xi and of the residual, in units of the focal length; `weigh`."""
        depth = points_c[:, 2:]
        valid = depth > torch.finfo(depth.dtype).eps
        inverse = torch.where(valid, depth, 1.0).reciprocal()
        xy = points_c[:, :2] * inverse
        residual = xy - self._normalized
        squared_px = (self._metric * residual.square()).sum(1)

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

    def _general(self, points_c: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor]]:
        """As `_pinhole`, for any camera; rows are in pixels."""
        points_c = points_c.mT
        lin = linearize(self.observations, points_c)
        J_rotation = torch.linalg.cross(points_c[..., None, :].expand_as(lin.J), lin.J)
        rows = torch.cat((lin.J, J_rotation, lin.residual[..., None]), dim=-1)
        return rows.permute(0, 3, 2, 1), lin[2:]

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

    def concluded(self, model: PoseModel, estimate: Tensor) -> PoseModel:
        return model._replace(T_cw=estimate)

    def covariance(self, T_cw: Float[Tensor, "B 4 4"]) -> Float[Tensor, "B 6 6"]:
        """Covariances (B, 6, 6) at minima, zero where the pose is not determined."""
        lin = linearize(self.observations, transform(T_cw, self.points_w))
        factor = variance_factor(self.observations, lin, num_parameters=6)[:, None, None]
        information = self.expand(T_cw, torch.zeros_like(self.solvable)).hessian
        if self.prior is not None:  # in absolute units, which the residuals do not calibrate
            information = information + factor * prior_expansion(self.prior, T_cw)[2]
        return factor * factorize(information).solve(self.eye.expand_as(information))

    def hessian(self, T_cw: Float[Tensor, "B 4 4"]) -> Float[Tensor, "B 6 6"]:
        """The exact Hessian (B, 6, 6) of the cost in xi."""
        result = self._pinhole_hessian(T_cw) if self._is_pinhole else self._general_hessian(T_cw)
        return result if self.prior is None else result + prior_hessian(self.prior, T_cw)

    def _pinhole_hessian(self, T_cw: Tensor) -> Tensor:
        """Of the observations, in half of the time of `_general_hessian`."""
        model, points_c, rows, weighted = self._expanded(T_cw, torch.ones_like(self.solvable))
        depth = points_c[:, 2]
        inverse = torch.where(depth > torch.finfo(depth.dtype).eps, depth, 1.0).reciprocal()
        # The curvature of a projection has the entries (0, 2), (1, 2) and half of (2, 2), and their mirror images.
        pulls = weighted[:, 6] * (inverse * inverse)[:, None]
        x, y = (-pulls).unbind(1)
        half = (pulls * points_c[:, :2]).sum(1) * inverse
        (p, q, _), zero = points_c.unbind(1), torch.zeros_like(half)
        first = torch.stack((zero, zero, torch.ones_like(half), q, -p, zero), dim=1)
        second = (x, y, half, half * q - y * depth, x * depth - half * p, y * p - x * q)
        projected = first @ torch.stack(second, dim=1).mT
        result = model.hessian + model.curvature_term + projected + projected.mT
        gradient = (weighted[:, :3] * rows[:, 6:]).sum(2)
        return result + self._of_rotation(gradient @ points_c.mT)

    def _general_hessian(self, T_cw: Tensor) -> Tensor:
        """As `_pinhole_hessian`, of any camera."""
        points_c = transform(T_cw, self.points_w)
        gradient, hessian = exact_expansion(self.observations, points_c)
        blocks = hessian.movedim((-2, -1), (0, 1))  # (3, 3, B, N)
        rays = points_c.movedim(-1, 0).contiguous()
        turned = torch.stack(cross_entries(rays, blocks))
        twice = torch.stack(cross_entries(rays, turned.transpose(0, 1)))
        own, turned, twice = (part.sum(-1).movedim(-1, 0) for part in (blocks, turned, twice))
        rows = torch.cat((own, turned.mT), dim=-1), torch.cat((turned, twice), dim=-1)
        return torch.cat(rows, dim=-2) + self._of_rotation(gradient.mT @ points_c)

    def _of_rotation(self, outer: Float[Tensor, "B 3 3"]) -> Float[Tensor, "B 6 6"]:
        """The curvature of the rotation itself, half of gradient . (omega x (omega x p)), by sums of gradient p^T."""
        trace = outer.diagonal(dim1=-2, dim2=-1).sum(-1)[:, None, None]
        curvature_term = 0.5 * (outer + outer.mT) - trace * self.eye[:3, :3]
        return torch.nn.functional.pad(curvature_term, (3, 0, 3, 0))


class PoseMinimization(Minimization):
    """`solve_pose` for `find_minimum`: found are the poses, `success`, and how it went.

    Inputs are the start, points, pixels, weights, camera.params, scale, and where there is a prior its two tensors.
    """

    num_unknowns = 1
    num_vectors = 1

    def __init__(self, camera: Camera, options: SolverOptions, inputs: Tensors) -> None:
        self.camera, self.options = camera, options
        ndims = tuple(tensor.ndim - 1 for tensor in inputs)
        # The camera's parameters and the scale may have no batch.
        self.ndims: tuple[Ndims, Ndims, Ndims] = (1,), (2, 0, 0, 0, 0, 0), (*ndims[:4], 1, 1, *ndims[6:])

    def problem(self, inputs: Tensors) -> PoseProblem:
        return PoseProblem(*self._given(inputs))

    def _given(self, inputs: Tensors) -> tuple[Tensor, ReprojectionData, PosePrior | None]:
        _, points_w, pixels, weights, params, scale, *prior = inputs
        camera = self.camera.with_params(params)
        observations = ReprojectionData(pixels, weights, camera, self.options.kernel, scale)
        return points_w, observations, PosePrior(*prior) if prior else None

    def minimize(self, inputs: Tensors) -> Tensors:
        T_cw, problem = inputs[0], self.problem(inputs)
        finite = torch.isfinite(T_cw).flatten(1).all(-1)
        identity = torch.eye(4, dtype=T_cw.dtype, device=T_cw.device)
        start = torch.where(finite[:, None, None], T_cw, identity)
        options = self.options
        problem.concludes = options.backward == "implicit"
        model, convergence = minimize_batch(problem, start, options.iterations, options.tolerance)
        with torch.no_grad():
            success = problem.solvable & factorize(model.hessian).definite & finite
        refined = torch.where(success[:, None, None], model.T_cw, start.detach())
        return refined, success, *convergence.tensors

    def factorized(self, found: Tensors, inputs: Tensors) -> Callable[[Tensors], Tensors]:
        T_cw, success, *_ = found
        with torch.no_grad():
            factor = factorize(self.problem(inputs).hessian(T_cw))

        def solve(right: Tensors) -> Tensors:
            right_of_successes = torch.where(success[:, None], right[0], 0.0)
            return (factor.solve(right_of_successes[..., None]).squeeze(-1),)

        return solve

    def slope(self, found: Tensors, inputs: Tensors, direction: Tensors) -> Tensor:
        T_cw, (xi,), (points_w, observations, prior) = found[0], direction, self._given(inputs)
        points_c = transform(T_cw, points_w)
        lin = linearize(observations, points_c)
        pulled = (lin.gradient_wrt_residual[..., None] * lin.J).sum(-2)
        slope = (pulled * move(points_c, xi[:, None])).sum()
        if prior is not None:
            slope = slope + (prior_expansion(prior, T_cw)[1] * xi).sum()
        return slope

    def retracted(self, found: Tensors, direction: Tensors) -> Tensors:
        return retract(found[0], direction[0]), *found[1:]

    def push(self, found: Tensors, direction: Tensors) -> Tensors:
        return (push(found[0], direction[0]),)

    def pull_back(self, found: Tensors, gradient: Tensors) -> Tensors:
        return (pull_back(found[0], gradient[0]),)


@dataclass(frozen=True)
class RefinedPose(Outcome):
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
    _problem: Callable[[], PoseProblem] = field(repr=False)

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "covariance": self.covariance, "_problem": None}

    @cached_property
    def covariance(self) -> Float[Tensor, "B 6 6"]:
        """Covariance of the left perturbation (translation, rotation), detached; zero where `success` is False.

        Calibrated by the residuals themselves, so the weights need to be right only up to a factor.
        """
        with torch.no_grad():
            covariance = self._problem().covariance(self.T_cw)
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
    batch, count = T_cw.shape[0], points_w.shape[1]
    points_w, pixels = points_w.expand(batch, count, 3), pixels.expand(batch, count, 2)
    weights = torch.ones_like(pixels[..., 0]) if weights is None else weights
    weights = weights.expand(batch, *weights.shape[1:])
    proper = camera.is_proper[..., None]
    use = usable(pixels, points_w, weights) & proper
    use = use if mask is None else use & mask
    rows, scale = use[..., None], kernel_scale(options.scale, T_cw)[..., None]
    priors: Tensors = ()
    if prior is not None:
        priors = prior.T_cw.expand(batch, 4, 4), prior.information.expand(batch, 6, 6)
    points_w, pixels = torch.where(rows, points_w, 0.0), torch.where(rows, pixels, 0.0)
    # A copy, as of the others: parameters may move in place before the covariance is asked for.
    params = torch.where(proper, camera.params, 1.0)
    inputs = T_cw, points_w, pixels, only(use, weights), params, scale, *priors
    minimization = PoseMinimization(camera, options, inputs)
    found = find_minimum(minimization, inputs, options.backward)
    refined, success, *how = found
    convergence = Convergence(*how, limit=options.iterations)
    if options.strict:
        check_minimum(success, convergence.converged, "poses")
    if options.backward == "truncated":
        problem = minimization.problem(inputs)
        at_minimum = problem.evaluate(refined, ~success)
        last, _ = problem.step(at_minimum, torch.zeros_like(convergence.cost))
        refined = torch.where(success[:, None, None], last, refined)
    refined = warned(refined, success, convergence, "poses")
    return RefinedPose(refined, convergence.cost, success, convergence, partial(minimization.problem, inputs))
