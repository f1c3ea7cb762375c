"""The least-squares problem behind `bundle_adjust`: its local models, its adjoint."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchslam.geometry.camera import Camera
from torchslam.geometry.lie import se3_adjoint, se3_inverse, transform
from torchslam.solvers.assembly import assemble
from torchslam.solvers.bundle_layout import Layout, camera_columns
from torchslam.solvers.bundle_priors import PriorTerms, prior_terms, still_open
from torchslam.solvers.bundle_problem import Inputs
from torchslam.solvers.folding import Tensors
from torchslam.solvers.residuals import (
    Linearization,
    Observations,
    exact_expansion_of_each,
    gauss_newton_expansion,
    linearize_each,
    variance_factor,
)
from torchslam.solvers.robust import Kernel
from torchslam.solvers.schur import (
    FactorizedEquations,
    Marginals,
    NormalEquations,
    Tangent,
)
from torchslam.solvers.tangent import retract


class Estimate(NamedTuple):
    """(F, 4, 4) poses, (P, 3) points in the layout's order, (C, K) camera parameters."""

    T_cw: Tensor
    points_w: Tensor
    params: Tensor


@dataclass(frozen=True)
class BundleModel:
    """The local model of the cost (1,) at an estimate."""

    estimate: Estimate
    cost: Tensor
    equations: NormalEquations


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
        self.columns: Tensor | None = None  # from points and directions to points and parameters
        self.camera_of: Tensor | None = None  # where there are several, of each observation
        if len(inputs.params) > 1:
            self.camera_of = camera_of.index_select(0, layout.observations)
        if directions is not None:
            columns = camera_columns(directions, len(inputs.params))
            self.columns = columns[0] if self.camera_of is None else columns.index_select(0, self.camera_of)
        self.observations = self._observed(
            inputs.pixels.index_select(0, layout.observations),
            inputs.weights.index_select(0, layout.observations),
            inputs.params,
        )
        self.start = Estimate(inputs.T_cw, inputs.points_w.index_select(0, layout.point_order), inputs.params)
        has_prior = inputs.pose_prior is not None and len(layout.free_frames) > 0
        solvable = len(layout.observations) > 0 or has_prior
        self.solvable = torch.tensor([solvable], device=inputs.pixels.device)

    def evaluate(self, estimate: Estimate, near: Tensor) -> BundleModel:
        lin, points_c, R_cw = self._linearize(estimate)
        expansion = gauss_newton_expansion(lin, near)
        layout = self.layout
        equations = assemble(layout.structure, expansion, points_c, R_cw, layout.free_points, exact=False)
        equations, cost = self._with_priors(equations, estimate)
        return BundleModel(estimate, (lin.cost.sum() + cost)[None], equations)

    def step(self, model: BundleModel, damping: Tensor) -> tuple[Estimate, Tensor]:
        equations, estimate = model.equations, model.estimate
        factorized = equations.factorized(damping, self._gauge(estimate))
        step = factorized.solve(equations.gradient)
        decrease = torch.where(factorized.reduced.definite, 0.5 * step.dot(equations.gradient), torch.inf)
        frames = self.layout.free_frames
        moved = retract(estimate.T_cw.index_select(0, frames), -step.frames)
        params = estimate.params
        if self.directions is not None:
            params = params - step.camera.view(len(params), -1) @ self.directions.mT
        return (
            Estimate(estimate.T_cw.index_copy(0, frames, moved), estimate.points_w - step.points, params),
            decrease[None],
        )

    def select(self, accept: Tensor, new: BundleModel, old: BundleModel) -> BundleModel:
        return new if bool(accept) else old

    def factorized(self, model: BundleModel) -> FactorizedEquations:
        """The undamped equations of a model at a minimum, ready to be solved."""
        return model.equations.factorized(gauge=self._gauge(model.estimate))

    def definite(self, model: BundleModel) -> Tensor:
        """(1,) whether all that moves is determined, up to the gauge."""
        return self.factorized(model).reduced.definite[None]

    def ordered(self, estimate: Estimate) -> Estimate:
        """The estimate of a batch of one in the layout's order."""
        T_cw, points_w, params = (part[0] for part in estimate)
        return Estimate(T_cw, points_w.index_select(0, self.layout.point_order), params)

    def in_order(self, estimate: Estimate) -> Estimate:
        """The estimate of the layout's order as that of a batch of one, in the order of the problem."""
        points_w = estimate.points_w.index_select(0, self.layout.point_rank)
        return Estimate(estimate.T_cw[None], points_w[None], estimate.params[None])

    def _gauge(self, estimate: Estimate) -> Tensor | None:
        """Directions (F', 6, g) that what is fixed leaves open: scale, or a similarity; None where nothing is."""
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
        motions = torch.linalg.qr(motions.flatten(0, 1)).Q.unflatten(0, (-1, 6))
        with torch.no_grad():
            priors = self._priors(estimate)
            return motions if priors is None else still_open(motions, priors.frames)

    def _priors(self, estimate: Estimate, exact: bool = False) -> PriorTerms | None:
        """What the priors on free frames (F') and the cameras add."""
        frames, inputs = self.layout.free_frames, self.inputs
        poses = inputs.pose_prior
        if poses is not None:
            T_cw, information = (x.index_select(0, frames) for x in (poses.T_cw, poses.information))
            inputs = inputs._replace(prior_T_cw=T_cw, prior_information=information)
        T_cw = estimate.T_cw.index_select(0, frames)
        return prior_terms(
            inputs, T_cw, estimate.params, torch.ones_like(frames).bool(), self.directions, exact
        )

    def _with_priors(
        self, equations: NormalEquations, estimate: Estimate, exact: bool = False, share: Tensor | float = 1.0
    ) -> tuple[NormalEquations, Tensor | float]:
        """The equations with a share of the priors added, and the priors' cost."""
        terms, gradient = self._priors(estimate, exact), equations.gradient
        if terms is None:
            return equations, 0.0
        gradient = gradient._replace(
            frames=gradient.frames + terms.frames_gradient, camera=gradient.camera + terms.camera_gradient
        )
        return (
            replace(
                equations,
                gradient=gradient,
                frames=equations.frames + share * terms.frames,
                camera=equations.camera + share * terms.camera,
            ),
            terms.cost,
        )

    def marginals(self, estimate: Estimate) -> Marginals:
        """Covariances (1, F, 6, 6), (1, P, 3, 3), (1, C n, C n) in the order of the problem, zero for what stays."""
        estimate = self.ordered(estimate)
        lin, points_c, R_cw = self._linearize(estimate)
        expansion = gauss_newton_expansion(lin, torch.zeros_like(self.solvable))
        layout, structure = self.layout, self.layout.structure
        equations = assemble(structure, expansion, points_c, R_cw, layout.free_points, exact=False)
        num_parameters = 6 * structure.num_frames + 3 * int(layout.free_points.sum()) + len(equations.camera)
        factor = variance_factor(self.observations, lin, num_parameters)
        # Priors are in absolute units, which the residuals do not calibrate.
        equations, _ = self._with_priors(equations, estimate, share=factor)
        free, points, camera = equations.factorized(gauge=self._gauge(estimate)).marginals()
        frames = free.new_zeros(len(estimate.T_cw), 6, 6).index_copy(0, layout.free_frames, free)
        blocks = factor * frames, factor * points[layout.point_rank], factor * camera
        return Marginals(*(block[None] for block in blocks))

    def exact_solver(self, estimate: Estimate) -> Callable[[Tensors], Tensors]:
        """v -> H^-1 v with the exact Hessian at a minimum, for a batch of one in the order of the problem."""
        layout, ordered = self.layout, self.ordered(estimate)
        exact = self._exact_equations(ordered).factorized(gauge=self._gauge(ordered))

        def solve(right: Tensors) -> Tensors:
            frames, points, camera = (part[0] for part in right)
            tangent = Tangent(
                frames.index_select(0, layout.free_frames), points.index_select(0, layout.point_order), camera
            )
            solved = exact.solve(tangent)
            spread = torch.zeros_like(frames).index_copy(0, layout.free_frames, solved.frames)
            vector = spread, solved.points.index_select(0, layout.point_rank), solved.camera
            return tuple(part[None] for part in vector)

        return solve

    def _linearize(self, estimate: Estimate) -> tuple[Linearization, Tensor, Tensor]:
        """Errors, points in the camera frame (O', 3) and rotations (O', 3, 3) of the observing frames."""
        T_cw = estimate.T_cw.index_select(0, self.layout.frame_index)
        points_w = estimate.points_w.index_select(0, self.layout.point_index)
        R_cw = T_cw[:, :3, :3]
        points_c = (R_cw @ points_w[..., None]).squeeze(-1) + T_cw[:, :3, 3]
        lin = linearize_each(self._observations(estimate), points_c, self.columns is not None)
        return lin if self.columns is None else lin._replace(J=lin.J @ self.columns), points_c, R_cw

    def _observed(self, pixels: Tensor, weights: Tensor, params: Tensor) -> Observations:
        camera = self.camera.with_params(params)
        camera = camera[0] if self.camera_of is None else camera[self.camera_of]
        return Observations(pixels, weights, camera, self.kernel, self.inputs.scale)

    def _observations(self, estimate: Estimate) -> Observations:
        if self.directions is None:
            return self.observations
        return self._observed(self.observations.pixels, self.observations.weights, estimate.params)

    def _exact_equations(self, estimate: Estimate) -> NormalEquations:
        _, points_c, R_cw = self._linearize(estimate)
        expansion = exact_expansion_of_each(self._observations(estimate), points_c, self.columns is not None)
        if self.columns is not None:
            expansion = expansion.along(self.columns)
        layout = self.layout
        equations = assemble(layout.structure, expansion, points_c, R_cw, layout.free_points, exact=True)
        return self._with_priors(equations, estimate, exact=True)[0]
