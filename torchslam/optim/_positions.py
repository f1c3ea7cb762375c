"""Positions of views and points from rays: the cost, its minimization with exact derivatives, and a search for a start.

A ray is a unit vector v from a camera center c toward a point X. With u = X - c, the residual is r = v - d u, and the
best inverse distance d = u.v / |u|^2 makes it as long as the sine of the angle. Behind the camera, u.v < 0, the best
one that is allowed is zero: the residual is one, without gradient. With d eliminated the gradient of rho(w |r|^2) / 2
in u is -rho' w d r, and the Hessian, with p = u / |u|,

    rho' w d^2 (I - p p^T) + (2 rho'' w^2 d^2 - rho' w / |u|^2) r r^T + rho' w d / |u| (p r^T + r p^T),

of which the first term is that of Gauss and Newton. X and c move u by as much, in opposite directions.

From random positions most points are behind the cameras that see them. The search therefore begins with inverse
distances that are unknowns of their own: the residuals are linear in them, and in centers and points.
Sources: Zhuang, Cheong and Lee, "Baseline desensitizing in translation averaging", 2018; Pan et al., "Global
structure-from-motion revisited", 2024.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchslam.geometry.robust import Kernel, Robustified, robustify
from torchslam.optim._core.implicit import Ndims, Tensors
from torchslam.optim._core.levenberg_marquardt import minimize_batch
from torchslam.optim._core.linear import factorize
from torchslam.optim._core.residuals import flat_along
from torchslam.optim.bundle._schur import BundleTangent, NormalEquations
from torchslam.optim.bundle._sparse import SparseLayout

# The sine of an angle in exact data ends in so many roundings, with room to spare for far points.
_ROUNDINGS = 64.0
# Huber's scale in the search, as a sine times the root of the median weight: GLOMAP's.
_WIDE = 0.1
# Most steps of the search by least squares and of that with Huber's kernel, and the shares of the cost at which they
# end. With a fifth of wrong rays and a narrow last kernel, centers of 16 simulated recordings are off by 0.21 % of
# their extent in the mean; with 5 steps by 0.57 %, 10 by 0.35 %, 40 by 0.21 %. Ten times other shares change little.
_STEPS, _SETTLED, _WIDE_SETTLED = 20, 1e-2, 1e-4
_KERNELS: tuple[Kernel, Kernel] = ("none", "huber")
# Inverse distance where that of a point behind the camera ends; of positions in a cube of size two. With GLOMAP's 1e-5
# the mean above is 0.62 %.
_LEAST_INVERSE = 1e-7
# Share of a point's mean distance below which it touches a camera, which then sees it in any direction: such points
# explain one wrong ray each. Of a street seen ahead, the first and the last distance differ a hundredfold. 1e-4 and
# 1e-2 give the same on simulated recordings.
_TOUCHING = 1e-3


class PositionInputs(NamedTuple):
    """Unit rays and their weights in the order of a layout, the scale of the kernel, and a start."""

    rays_w: Float[Tensor, "O 3"]
    weights: Float[Tensor, " O"]
    scale: Float[Tensor, ""]
    centers_w: Float[Tensor, "K 3"]
    points_w: Float[Tensor, "N 3"]


class Positions(NamedTuple):
    """Estimates of centers and points, and of inverse distances; with None, these are the best ones."""

    centers_w: Float[Tensor, "K 3"]
    points_w: Float[Tensor, "N 3"]
    inverse: Float[Tensor, " O"] | None = None


class PositionModel(NamedTuple):
    """An estimate with its cost (1,), and per ray u, |u|^2, d, r, the kernel of w |r|^2, and its weight rho' w."""

    estimate: Positions
    cost: Float[Tensor, " 1"]
    use_curvature: Bool[Tensor, " 1"]
    u: Float[Tensor, "O 3"]
    squared: Float[Tensor, " O"]
    inverse: Float[Tensor, " O"]
    residual: Float[Tensor, "O 3"]
    kernel: Robustified
    weight: Float[Tensor, " O"]


class PositionProblem:
    """Positions for `minimize_batch`, a batch of one. Each step eliminates the inverse distances, then the points."""

    def __init__(self, layout: SparseLayout, inputs: PositionInputs, kernel: Kernel) -> None:
        self.layout, self.structure, self.inputs, self.kernel = layout, layout.structure, inputs, kernel
        self.solvable = torch.ones(1, dtype=torch.bool, device=inputs.rays_w.device)

    def rounding(self) -> Tensor:
        weights = self.inputs.weights.detach()
        return 0.5 * weights.sum()[None] * (_ROUNDINGS * torch.finfo(weights.dtype).eps) ** 2

    def evaluate(self, estimate: Positions, use_curvature: Tensor) -> PositionModel:
        rays_w, weights, scale = self.inputs[:3]
        u, inverse = self.between(*estimate[:2]), estimate.inverse
        squared = u.square().sum(-1).clamp_min(torch.finfo(u.dtype).tiny)
        if inverse is None:
            inverse = ((u * rays_w).sum(-1) / squared).clamp_min(0)
        r = rays_w - inverse[:, None] * u
        kernel = robustify(weights * r.square().sum(-1), self.kernel, scale)
        cost, weight = 0.5 * kernel.rho.sum()[None], weights * kernel.weight
        return PositionModel(estimate, cost, use_curvature, u, squared, inverse, r, kernel, weight)

    def step(self, model: PositionModel, damping: Tensor) -> tuple[Positions, Tensor]:
        centers_w, points_w, inverse = model.estimate
        if inverse is None:
            factorized = self.equations(model).factorized(damping[0], self.gauge(model))
        else:  # the gauge is left to the damping: inverse distances go with the scale
            factorized = self.equations(model, damping).factorized(damping[0])
        gradient = factorized.equations.gradient
        step = factorized.solve(gradient)
        reduction = step.dot(gradient)
        if inverse is not None:
            ur, damped = (model.u * model.residual).sum(-1), (1 + damping) * model.squared
            moved = -(model.u * self.between(step.frames, step.points)).sum(-1)
            reduction = reduction + (model.weight * ur.square() / damped).sum()
            inverse = (inverse + (ur - inverse * moved) / damped).clamp_min(_LEAST_INVERSE)
        reduction = torch.where(factorized.reduced.definite, 0.5 * reduction, torch.inf)[None]
        return Positions(centers_w - step.frames, points_w - step.points, inverse), reduction

    def select(self, accept: Tensor, new: PositionModel, old: PositionModel) -> PositionModel:
        return new if bool(accept) else old

    def equations(
        self, model: PositionModel, damping: Tensor | float = 0.0, exact: bool = False
    ) -> NormalEquations:
        """The normal equations. damping: of the inverse distances; exact: with the exact Hessian at the best ones."""
        structure, u, r, weight = self.structure, model.u, model.residual, model.weight
        curvature = 2 * model.kernel.curvature * (self.inputs.weights * model.inverse).square()
        curvature = torch.where(model.inverse > 0, curvature - weight / model.squared, 0.0)
        hessian = self._gauss_newton(model, damping)
        if exact:
            cross = _outer(u, (weight * model.inverse / model.squared)[:, None] * r)
            hessian = hessian + cross + cross.mT
        else:  # negative curvature along the residual counts as flat, as in bundle adjustment
            along = weight * model.inverse.square()
            curvature = flat_along(along, curvature, r.square().sum(-1), model.use_curvature)
        hessian = hessian + _outer(r, curvature[:, None] * r)
        projected = r - ((u * r).sum(-1) / ((1 + damping) * model.squared))[:, None] * u
        gradient = -(weight * model.inverse)[:, None] * projected
        both, none = torch.cat((hessian, gradient[..., None]), dim=-1), gradient.new_zeros
        points = structure.sum_by_point(both.flatten(1)).unflatten(-1, (3, 4))
        frames = structure.sum_by_frame(both.movedim(0, -1))
        return NormalEquations(
            structure,
            BundleTangent(-frames[..., 3], points[..., 3], none(1, 0)),
            frames[..., :3],
            points[..., :3],
            none(1, 0, 0),
            none(len(frames), 3, 0),
            structure.coupling.stored(-hessian),
            none(structure.camera_coupling.size, 0),
            self.layout.free_points,
        )

    def gauge(self, model: PositionModel) -> Float[Tensor, "K 3 4"]:
        """Orthonormal directions of the centers that change no ray: three translations and the scale."""
        spread = model.estimate.centers_w - model.estimate.centers_w.mean(0)
        spread = spread / spread.norm().clamp_min(torch.finfo(spread.dtype).tiny)
        eye = torch.eye(3, dtype=spread.dtype, device=spread.device).expand(len(spread), 3, 3)
        return torch.cat((eye / len(spread) ** 0.5, spread[..., None]), dim=-1)

    def determining(self, model: PositionModel) -> Bool[Tensor, " O"]:
        """Rays that do not touch their camera, to points that rays of more than one direction see."""
        point, distance = self.layout.point_index, model.squared.sqrt()
        definite = factorize(self.structure.sum_by_point(self._gauss_newton(model))).definite
        mean = self.structure.sum_by_point(distance[:, None])[:, 0] / self.structure.point_counts
        return definite.index_select(0, point) & (distance > _TOUCHING * mean.index_select(0, point))

    def triangulated(self, estimate: Positions) -> Positions:
        """Each point where it is, or where the rays of its views nearly meet if it costs less there."""
        rays_w, points_w = self.inputs.rays_w, estimate.points_w
        model = self.evaluate(estimate, ~self.solvable)
        eye = torch.eye(3, dtype=rays_w.dtype, device=rays_w.device)
        across = (model.weight / model.squared)[:, None, None] * (eye - _outer(rays_w, rays_w))
        right = across @ estimate.centers_w.index_select(0, self.layout.frame_index)[..., None]
        sums = self.structure.sum_by_point(torch.cat((across, right), dim=-1).flatten(1)).unflatten(
            -1, (3, 4)
        )
        met_w = torch.linalg.solve_ex(sums[..., :3], sums[..., 3:])[0][..., 0]
        met_w = torch.where(torch.isfinite(met_w).all(-1, keepdim=True), met_w, points_w)
        there = self.evaluate(estimate._replace(points_w=met_w), ~self.solvable)
        gain = self.structure.sum_by_point((model.kernel.rho - there.kernel.rho)[:, None])
        return estimate._replace(points_w=torch.where(gain > 0, met_w, points_w))

    def between(self, centers: Float[Tensor, "K 3"], points: Float[Tensor, "N 3"]) -> Float[Tensor, "O 3"]:
        """From centers to points."""
        layout = self.layout
        return points.index_select(0, layout.point_index) - centers.index_select(0, layout.frame_index)

    def _gauss_newton(self, model: PositionModel, damping: Tensor | float = 0.0) -> Float[Tensor, "O 3 3"]:
        """The Hessian of each ray in u without any curvature."""
        eye = torch.eye(3, dtype=model.u.dtype, device=model.u.device)
        across = eye - _outer(model.u, model.u / ((1 + damping) * model.squared)[:, None])
        return (model.weight * model.inverse.square())[:, None, None] * across


def _outer(a: Float[Tensor, "O 3"], b: Float[Tensor, "O 3"]) -> Float[Tensor, "O 3 3"]:
    return a[:, :, None] * b[:, None]


def search_positions(
    problem: PositionProblem, iterations: int, tolerance: float, is_random: bool
) -> tuple[Positions, Bool[Tensor, " O"]]:
    """Positions at a minimum, from random ones or near it, and which rays help to determine them."""
    layout, inputs = problem.layout, problem.inputs
    at = Positions(inputs.centers_w, inputs.points_w)
    if is_random:
        scale = torch.maximum(inputs.scale, _WIDE * inputs.weights.median().sqrt())
        plain, wide = (PositionProblem(layout, inputs._replace(scale=scale), name) for name in _KERNELS)
        at = at._replace(inverse=torch.ones_like(inputs.weights))
        at = minimize_batch(plain, at, _STEPS, _SETTLED)[0].estimate
        at = minimize_batch(wide, at, _STEPS, _WIDE_SETTLED)[0].estimate
        # One point that steps too far, with little parallax, would shorten the steps of all others from here on.
        at = wide.triangulated(at._replace(inverse=None))
        at = minimize_batch(wide, at, iterations, tolerance)[0].estimate
    model = minimize_batch(problem, at, iterations, tolerance)[0]
    return model.estimate, problem.determining(model)


class PositionMinimization:
    """Positions of `PositionInputs` for `find_minimum`, whether they are determined, and the parts of `Convergence`.

    Vectors are centers (K, 3) and points (N, 3).
    """

    num_unknowns = 2
    num_vectors = 2
    ndims: tuple[Ndims, Ndims, Ndims] | None = None

    def __init__(self, layout: SparseLayout, kernel: Kernel, iterations: int, tolerance: float) -> None:
        self.layout, self.kernel, self.iterations, self.tolerance = layout, kernel, iterations, tolerance

    def problem(self, inputs: Tensors) -> PositionProblem:
        return PositionProblem(self.layout, PositionInputs(*inputs), self.kernel)

    def minimize(self, inputs: Tensors) -> Tensors:
        problem = self.problem(inputs)
        model, c = minimize_batch(problem, Positions(*inputs[3:]), self.iterations, self.tolerance)
        with torch.no_grad():
            definite = problem.equations(model).factorized(gauge=problem.gauge(model)).reduced.definite
        success = definite & (len(model.u) > 0)
        return *model.estimate[:2], success, c.iterations, c.converged, c.initial_cost, c.cost

    def factorized(self, found: Tensors, inputs: Tensors) -> Callable[[Tensors], Tensors]:
        problem, model = self._at(found, inputs)
        factor = problem.equations(model, exact=True).factorized(gauge=problem.gauge(model))

        def solve(right: Tensors) -> Tensors:
            solved = factor.solve(BundleTangent(right[0], right[1], right[0].new_zeros(1, 0)))
            return tuple(torch.where(found[2], part, 0.0) for part in solved[:2])

        return solve

    def slope(self, found: Tensors, inputs: Tensors, direction: Tensors) -> Tensor:
        problem, model = self._at(found, inputs)
        pull = (model.weight * model.inverse)[:, None] * model.residual
        return -(pull * problem.between(*direction)).sum()

    def retracted(self, found: Tensors, direction: Tensors) -> Tensors:
        return found[0] + direction[0], found[1] + direction[1], *found[2:]

    def push(self, found: Tensors, direction: Tensors) -> Tensors:
        return direction

    def pull_back(self, found: Tensors, gradient: Tensors) -> Tensors:
        return gradient

    def last_step(self, found: Tensors, inputs: Tensors) -> Positions:
        """The positions after one more step from the minimum, with the gradient of that step."""
        problem, model = self._at(found, inputs)
        return problem.step(model, torch.zeros_like(model.cost))[0]

    def _at(self, found: Tensors, inputs: Tensors) -> tuple[PositionProblem, PositionModel]:
        problem = self.problem(inputs)
        return problem, problem.evaluate(Positions(*found[:2]), ~problem.solvable)
