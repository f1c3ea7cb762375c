"""The least-squares problem behind `bundle_adjust`: its local models, its adjoint."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from torchslam.geometry.camera import Camera
from torchslam.geometry.lie import se3_adjoint, se3_inverse, transform
from torchslam.geometry.robust import Kernel
from torchslam.optim.bundle.assembly import assemble, product
from torchslam.optim.bundle.priors import PriorTerms, prior_terms, still_open
from torchslam.optim.bundle.problem import Inputs
from torchslam.optim.bundle.schur import (
    Marginals,
    NormalEquations,
    Tangent,
)
from torchslam.optim.bundle.sparse_layout import Layout
from torchslam.optim.core.batching import Tensors
from torchslam.optim.core.residuals import (
    Expansion,
    Linearization,
    Observations,
    exact_expansion_of_each,
    gauss_newton_expansion,
    linearize_each,
    rounding_cost,
    variance_factor,
)
from torchslam.optim.core.tangent import retract, turned


class Estimate(NamedTuple):
    """(F, 4, 4) poses, (P, 3) points in the layout's order, (C, K) camera parameters."""

    T_cw: Tensor
    points_w: Tensor
    params: Tensor


@dataclass(frozen=True)
class BundleModel:
    """The local model of the cost (1,) at an estimate; its equations are made when they are asked for.

    Where a minimisation ends nobody asks, and they are most of the work.
    """

    estimate: Estimate
    cost: Tensor
    assembled: Callable[[], NormalEquations]

    @cached_property
    def equations(self) -> NormalEquations:
        return self.assembled()


class Seen(NamedTuple):
    """Per observation the rotation (3, 3, O') of its frame, and the ray to its point: (3, O') in the axes of the world
    and (O', 3) in those of the camera."""

    R_cw: Tensor
    rays_w: Tensor
    points_c: Tensor


class Bundle:
    """A bundle adjustment for `levenberg.minimize` (a batch of one), and what follows from its minimum."""

    def __init__(
        self,
        layout: Layout,
        inputs: Inputs,
        camera: Camera,
        kernel: Kernel,
        directions: Tensor | None,
        camera_of: Tensor,
    ) -> None:
        """directions: (K, n) in which the parameters move, None where they do not; camera_of: (O,)"""
        self.layout, self.inputs, self.directions = layout, inputs, directions
        self.camera, self.kernel = camera, kernel
        self.camera_of: Tensor | None = None  # where there are several, of each observation
        if len(inputs.params) > 1:
            self.camera_of = camera_of.index_select(0, layout.observations)
        self.observations = self._observed(
            inputs.pixels.index_select(0, layout.observations),
            inputs.weights.index_select(0, layout.observations),
            inputs.params,
        )
        self.start = Estimate(inputs.T_cw, inputs.points_w.index_select(0, layout.point_order), inputs.params)
        has_prior = inputs.pose_prior is not None and len(layout.free_frames) > 0
        solvable = len(layout.observations) > 0 or has_prior
        self.solvable = torch.tensor([solvable], device=inputs.pixels.device)

    def rounding(self) -> Tensor:
        weights = self.inputs.weights
        if self.observations.has_matrices:
            weights = weights.diagonal(dim1=-2, dim2=-1)
        return rounding_cost(weights[None], self.inputs.params[None])

    def evaluate(self, estimate: Estimate, near: Tensor) -> BundleModel:
        seen, terms = self._seen(estimate), self._priors(estimate)
        lin = self._linearize(estimate, seen)
        cost = lin.cost.sum() if terms is None else lin.cost.sum() + terms.cost
        return BundleModel(
            estimate, cost[None], lambda: _with_priors(self._equations(seen, lin, near), terms)
        )

    def step(self, model: BundleModel, damping: Tensor) -> tuple[Estimate, Tensor]:
        equations, estimate = model.equations, model.estimate
        factorized = equations.factorized(damping, self._gauge(estimate))
        step = factorized.solve(equations.gradient)
        decrease = torch.where(factorized.reduced.definite, 0.5 * step.dot(equations.gradient), torch.inf)
        frames = self.layout.free_frames
        T_free = estimate.T_cw.index_select(0, frames)
        moved = retract(T_free, -turned(T_free[:, :3, :3], step.frames[..., None])[..., 0])
        params = estimate.params
        if self.directions is not None:
            params = params - step.camera.view(len(params), -1) @ self.directions.mT
        return (
            Estimate(estimate.T_cw.index_copy(0, frames, moved), estimate.points_w - step.points, params),
            decrease[None],
        )

    def select(self, accept: Tensor, new: BundleModel, old: BundleModel) -> BundleModel:
        return new if bool(accept) else old

    def definite(self, model: BundleModel) -> Tensor:
        """(1,) whether all that moves is determined, up to the gauge."""
        return model.equations.factorized(gauge=self._gauge(model.estimate)).reduced.definite[None]

    def ordered(self, estimate: Estimate) -> Estimate:
        """The estimate of a batch of one in the layout's order."""
        T_cw, points_w, params = (part[0] for part in estimate)
        return Estimate(T_cw, points_w.index_select(0, self.layout.point_order), params)

    def in_order(self, estimate: Estimate) -> Estimate:
        """The estimate of the layout's order as that of a batch of one, in the order of the problem."""
        points_w = estimate.points_w.index_select(0, self.layout.point_rank)
        return Estimate(estimate.T_cw[None], points_w[None], estimate.params[None])

    def _gauge(self, estimate: Estimate) -> Tensor | None:
        """Directions (F', 6, g) that what is fixed leaves open: scale, or a similarity; None where nothing is.

        In the axes of the world, as are all vectors of the equations.
        """
        layout, T_cw = self.layout, estimate.T_cw
        is_anchor = torch.zeros(len(T_cw), dtype=torch.bool, device=T_cw.device)
        is_anchor[layout.frame_index] = True
        is_anchor[layout.free_frames] = False
        anchors = T_cw[is_anchor]
        fixed_points = ~layout.free_points & (layout.structure.point_counts > 0)
        if len(anchors) > 1 or fixed_points.any() or not len(layout.free_frames):
            return None
        T_free = T_cw[layout.free_frames]
        origin = se3_inverse(anchors[0] if len(anchors) else T_free[0])[:3, 3]
        scaling = torch.nn.functional.pad(transform(T_free, origin[None]).squeeze(-2), (0, 3))[..., None]
        motions = scaling if len(anchors) else torch.cat((scaling, -se3_adjoint(T_free)), dim=-1)
        motions = turned(T_free[:, :3, :3].mT, motions)
        motions = torch.linalg.qr(motions.flatten(0, 1)).Q.unflatten(0, (-1, 6))
        with torch.no_grad():
            priors = self._priors(estimate)
            return motions if priors is None else still_open(motions, priors.frames)

    def _priors(self, estimate: Estimate, exact: bool = False) -> PriorTerms | None:
        """What the priors on free frames (F') and the cameras add, in the axes of the world."""
        frames, inputs = self.layout.free_frames, self.inputs
        poses = inputs.pose_prior
        if poses is None and inputs.camera_prior is None:
            return None
        if poses is not None:
            T_cw, information = (x.index_select(0, frames) for x in (poses.T_cw, poses.information))
            inputs = inputs._replace(prior_T_cw=T_cw, prior_information=information)
        T_cw = estimate.T_cw.index_select(0, frames)
        moving = torch.ones_like(frames).bool()
        terms = prior_terms(inputs, T_cw, estimate.params, moving, self.directions, exact)
        return None if terms is None else terms.in_world(T_cw[:, :3, :3])

    def marginals(self, estimate: Estimate) -> Marginals:
        """Covariances (1, F, 6, 6), (1, P, 3, 3), (1, C n, C n) in the order of the problem, zero for what stays."""
        estimate = self.ordered(estimate)
        seen = self._seen(estimate)
        lin = self._linearize(estimate, seen)
        equations = self._equations(seen, lin, torch.zeros_like(self.solvable))
        layout, structure = self.layout, self.layout.structure
        num_parameters = 6 * structure.num_frames + 3 * int(layout.free_points.sum()) + len(equations.camera)
        factor = variance_factor(self.observations, lin, num_parameters)
        # Priors are in absolute units, which the residuals do not calibrate.
        equations = _with_priors(equations, self._priors(estimate), share=factor)
        free, points, camera = equations.factorized(gauge=self._gauge(estimate)).marginals()
        R_cw = estimate.T_cw[layout.free_frames, :3, :3]
        free = turned(R_cw, turned(R_cw, free).mT)
        frames = free.new_zeros(len(estimate.T_cw), 6, 6).index_copy(0, layout.free_frames, free)
        blocks = factor * frames, factor * points[layout.point_rank], factor * camera
        return Marginals(*(block[None] for block in blocks))

    def exact_solver(self, estimate: Estimate) -> Callable[[Tensors], Tensors]:
        """v -> H^-1 v with the exact Hessian at a minimum, for a batch of one in the order of the problem."""
        layout, ordered = self.layout, self.ordered(estimate)
        exact = self._exact_equations(ordered).factorized(gauge=self._gauge(ordered))
        R_cw = ordered.T_cw[layout.free_frames, :3, :3]

        def solve(right: Tensors) -> Tensors:
            frames, points, camera = (part[0] for part in right)
            free = turned(R_cw.mT, frames.index_select(0, layout.free_frames)[..., None])[..., 0]
            solved = exact.solve(Tangent(free, points.index_select(0, layout.point_order), camera))
            free = turned(R_cw, solved.frames[..., None])[..., 0]
            spread = torch.zeros_like(frames).index_copy(0, layout.free_frames, free)
            vector = spread, solved.points.index_select(0, layout.point_rank), solved.camera
            return tuple(part[None] for part in vector)

        return solve

    def _seen(self, estimate: Estimate) -> Seen:
        R_cw = estimate.T_cw[:, :3, :3]
        centres_w = -(R_cw.mT @ estimate.T_cw[:, :3, 3:])
        frames = torch.cat((R_cw.flatten(1), centres_w[..., 0]), dim=-1)
        rows = frames.index_select(0, self.layout.frame_index).mT.contiguous()
        R_cw = rows[:9].unflatten(0, (3, 3))
        rays_w = estimate.points_w.index_select(0, self.layout.point_index).mT - rows[9:]
        return Seen(R_cw, rays_w, product(R_cw, rays_w[:, None])[:, 0].mT)

    def _linearize(self, estimate: Estimate, seen: Seen) -> Linearization:
        return linearize_each(self._observations(estimate), seen.points_c, self.directions is not None)

    def _in_world(self, rows: Tensor, R_cw: Tensor) -> Tensor:
        """Derivatives (m, 3 + K, O') in points_c and the camera, as such in points_w and what moves of all cameras."""
        points = product(rows[:, :3], R_cw)
        if self.directions is None:
            return points
        camera = self.directions.mT @ rows[:, 3:]
        if self.camera_of is not None:
            every = torch.arange(len(self.inputs.params), device=rows.device)
            camera = torch.where(self.camera_of == every[:, None, None], camera[:, None], 0.0).flatten(1, 2)
        return torch.cat((points, camera), dim=1)

    def _observed(self, pixels: Tensor, weights: Tensor, params: Tensor) -> Observations:
        camera = self.camera.with_params(params)
        camera = camera[0] if self.camera_of is None else camera[self.camera_of]
        return Observations(pixels, weights, camera, self.kernel, self.inputs.scale)

    def _observations(self, estimate: Estimate) -> Observations:
        if self.directions is None:
            return self.observations
        return self._observed(self.observations.pixels, self.observations.weights, estimate.params)

    def _equations(self, seen: Seen, lin: Linearization, near: Tensor) -> NormalEquations:
        """Without the bend of the projection, and without priors."""
        expansion = gauss_newton_expansion(lin, self._in_world(lin.J.movedim(0, -1), seen.R_cw), near)
        return assemble(self.layout.structure, expansion, seen.rays_w, self.layout.free_points, exact=False)

    def _exact_equations(self, estimate: Estimate) -> NormalEquations:
        R_cw, rays_w, points_c = self._seen(estimate)
        observations, is_free = self._observations(estimate), self.directions is not None
        gradient, hessian = exact_expansion_of_each(observations, points_c, is_free)
        half = self._in_world(hessian.movedim(0, -1), R_cw).transpose(0, 1)
        expansion = Expansion(self._in_world(gradient.mT[None], R_cw)[0], self._in_world(half, R_cw))
        layout = self.layout
        equations = assemble(layout.structure, expansion, rays_w, layout.free_points, exact=True)
        return _with_priors(equations, self._priors(estimate, exact=True))


def _with_priors(
    equations: NormalEquations, terms: PriorTerms | None, share: Tensor | float = 1.0
) -> NormalEquations:
    """The equations with a share of the priors added."""
    if terms is None:
        return equations
    gradient = equations.gradient
    gradient = gradient._replace(
        frames=gradient.frames + terms.frames_gradient, camera=gradient.camera + terms.camera_gradient
    )
    return replace(
        equations,
        gradient=gradient,
        frames=equations.frames + share * terms.frames,
        camera=equations.camera + share * terms.camera,
    )
