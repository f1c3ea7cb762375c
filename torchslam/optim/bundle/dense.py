"""Many small bundle adjustments at once for `levenberg.minimize`: as `bundle_model`, on the grids of `grid_layout`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchslam.geometry.camera import Camera
from torchslam.geometry.lie import se3_adjoint, se3_inverse, transform
from torchslam.geometry.robust import Kernel
from torchslam.optim.bundle.dense_equations import (
    FactorizedGrid,
    GridEquations,
    GridExpansion,
    assemble_grid,
    factorized_grid,
)
from torchslam.optim.bundle.dense_layout import GridData, take
from torchslam.optim.bundle.priors import PriorTerms, block_diagonal, prior_terms, still_open
from torchslam.optim.bundle.schur import Marginals
from torchslam.optim.bundle.sparse import Estimate
from torchslam.optim.bundle.sparse_layout import camera_columns
from torchslam.optim.core.batching import Tensors, chosen, taken
from torchslam.optim.core.residuals import (
    Expansion,
    Linearization,
    Observations,
    exact_expansion,
    flat_along,
    gauss_newton_expansion,
    linearize,
    rounding_cost,
    variance_factor,
    weigh,
)
from torchslam.optim.core.tangent import retract, turned


class GridEstimate(NamedTuple):
    """Poses (B, F, 4, 4) in the layout's order, points (B, 3, P), camera parameters (B, C, K)."""

    T_cw: Tensor
    points_w: Tensor
    params: Tensor


class GridModel(NamedTuple):
    """The local models of the costs (B,) at an estimate."""

    estimate: GridEstimate
    cost: Tensor
    equations: GridEquations


@dataclass(frozen=True)
class GridBundle:
    """Bundle adjustments for `levenberg.minimize`, and what follows from their minima.

    directions: (K, n) in which the cameras' parameters move, None where they do not
    """

    data: GridData
    camera: Camera
    kernel: Kernel
    directions: Tensor | None

    @property
    def solvable(self) -> Tensor:
        layout, has_prior = self.data.layout, self.data.inputs.pose_prior is not None
        observed = (layout.cells < layout.order.shape[1] * layout.free_points.shape[1]).any(1)
        return observed | layout.free.any(1) if has_prior else observed

    @property
    def start(self) -> GridEstimate:
        inputs = self.data.inputs
        return GridEstimate(inputs.T_cw, inputs.points_w.mT, inputs.params)

    def rounding(self) -> Tensor:
        return rounding_cost(self.data.inputs.weights, self.data.inputs.params)

    def part(self, rows: Tensor) -> GridBundle:
        """The problems of some elements of the batch."""
        return replace(self, data=taken(self.data, rows))

    def evaluate(self, estimate: GridEstimate, near: Tensor) -> GridModel:
        points_c = self._points_c(estimate)
        if self.camera.model == "pinhole" and self.directions is None:
            expansion, cost = self._pinhole(points_c, near[:, None, None])
        else:
            lin = self._linearize(estimate, points_c)
            expansion = _expanded(lin, near)
            cost = lin.cost.sum((1, 2))
        equations, prior_cost = self._equations(estimate, expansion)
        return GridModel(estimate, cost + prior_cost, equations)

    def step(self, model: GridModel, damping: Tensor) -> tuple[GridEstimate, Tensor]:
        equations, (T_cw, points_w, params) = model.equations, model.estimate
        factorized = self._factorized(model.estimate, equations, damping)
        step, points = factorized.solve(equations.gradient, equations.points_gradient)
        decrease = (step * equations.gradient).sum(1) + (points * equations.points_gradient).sum((1, 2))
        decrease = torch.where(factorized.reduced.definite, 0.5 * decrease, torch.inf)
        frames, camera = self._split(step)
        leading = frames.shape[1]
        moved = retract(T_cw[:, :leading], -turned(T_cw[:, :leading, :3, :3], frames[..., None])[..., 0])
        T_cw = torch.cat((moved, T_cw[:, leading:]), dim=1)
        if self.directions is not None:
            params = params - camera.unflatten(1, (params.shape[1], -1)) @ self.directions.mT
        return GridEstimate(T_cw, points_w - points, params), decrease

    def select(self, accept: Tensor, new: GridModel, old: GridModel) -> GridModel:
        return new if accept.all() else chosen(accept, new, old)

    def definite(self, model: GridModel) -> Tensor:
        """(B,) whether all that moves is determined, up to the gauge."""
        return self._factorized(model.estimate, model.equations).reduced.definite

    def exact_solver(self, estimate: Estimate) -> Callable[[Tensors], Tensors]:
        """v -> H^-1 v with the exact Hessians at minima, in the order of the problems."""
        layout, ordered = self.data.layout, self.ordered(estimate)
        points_c = self._points_c(ordered)
        expansion = exact_expansion(self._observations(ordered), points_c.mT, self.directions is not None)
        if self.directions is not None:
            expansion = expansion.along(self._columns)
        equations, _ = self._equations(ordered, _as_grid(expansion), exact=True)
        factorized = self._factorized(ordered, equations)
        leading = layout.free.shape[1]
        padding, R_cw = layout.order.shape[1] - leading, ordered.T_cw[:, :leading, :3, :3]

        def solve(right: Tensors) -> Tensors:
            frames, points, camera = right
            frames = torch.where(layout.free[..., None], take(frames, layout.order)[:, :leading], 0.0)
            frames = turned(R_cw.mT, frames[..., None])[..., 0]
            solved, points = factorized.solve(torch.cat((frames.flatten(1), camera), dim=1), points.mT)
            frames, camera = self._split(solved)
            frames = torch.nn.functional.pad(turned(R_cw, frames[..., None])[..., 0], (0, 0, 0, padding))
            return take(frames, layout.rank), points.mT, camera

        return solve

    def marginals(self, estimate: Estimate) -> Marginals:
        """Covariances (B, F, 6, 6), (B, P, 3, 3), (B, C n, C n) in the order of the problems, zero for what stays."""
        layout, ordered = self.data.layout, self.ordered(estimate)
        points_c = self._points_c(ordered)
        lin = self._linearize(ordered, points_c)
        observations = self._observations(ordered)
        flat = replace(
            observations, pixels=observations.pixels.flatten(1, 2), weights=observations.weights.flatten(1)
        )
        columns = 0 if self.directions is None else self._columns.shape[-1] - 3
        num_parameters = 6 * layout.free.sum(1) + 3 * layout.free_points.sum(1) + columns
        factor = variance_factor(flat, Linearization(*(part.flatten(1, 2) for part in lin)), num_parameters)
        expansion = _expanded(lin, torch.zeros_like(factor))
        equations, _ = self._equations(ordered, expansion, share=factor[:, None, None])
        inverse, points = self._factorized(ordered, equations).marginals()
        inverse, points = factor[:, None, None] * inverse, factor[:, None, None, None] * points
        leading = layout.free.shape[1]
        size, R_cw = 6 * leading, ordered.T_cw[:, :leading, :3, :3]
        frames = inverse[:, :size, :size].unflatten(1, (-1, 6)).unflatten(3, (-1, 6)).diagonal(dim1=1, dim2=3)
        frames = turned(R_cw, turned(R_cw, frames.movedim(-1, 1)).mT)
        frames = torch.where(layout.free[..., None, None], frames, 0.0)
        padding = layout.order.shape[1] - leading
        frames = take(torch.nn.functional.pad(frames, (0, 0, 0, 0, 0, padding)), layout.rank)
        return Marginals(frames, points, inverse[:, size:, size:])

    def ordered(self, estimate: Estimate) -> GridEstimate:
        """An estimate as the grids have it."""
        T_cw = take(estimate.T_cw, self.data.layout.order)
        return GridEstimate(T_cw, estimate.points_w.mT, estimate.params)

    def in_order(self, estimate: GridEstimate) -> Estimate:
        """An estimate as the problems have it."""
        T_cw = take(estimate.T_cw, self.data.layout.rank)
        return Estimate(T_cw, estimate.points_w.mT, estimate.params)

    def _points_c(self, estimate: GridEstimate) -> Tensor:
        """(B, F, 3, P)"""
        T_cw = estimate.T_cw
        return T_cw[..., :3, :3] @ estimate.points_w[:, None] + T_cw[..., :3, 3:]

    def _observations(self, estimate: GridEstimate) -> Observations:
        inputs = self.data.inputs
        params = estimate.params
        if params.shape[1] > 1:
            params = take(params, self.data.camera_of)
        camera, scale = self.camera.with_params(params), inputs.scale[:, None, None]
        return Observations(inputs.pixels.mT, inputs.weights, camera, self.kernel, scale)

    @property
    def _columns(self) -> Tensor:
        """From points and directions to points and parameters, (3 + K, 3 + n) or (B, F, 1, 3 + K, 3 + C n)."""
        assert self.directions is not None
        num_cameras = self.data.inputs.params.shape[1]
        columns = camera_columns(self.directions, num_cameras)
        return columns[0] if num_cameras == 1 else columns[self.data.camera_of][:, :, None]

    def _linearize(self, estimate: GridEstimate, points_c: Tensor) -> Linearization:
        """Of every frame and point, (B, F, P, ...)."""
        lin = linearize(self._observations(estimate), points_c.mT, self.directions is not None)
        return lin if self.directions is None else lin._replace(J=lin.J @ self._columns)

    def _pinhole(self, points_c: Tensor, near: Tensor) -> tuple[GridExpansion, Tensor]:
        """The expansion without distortion, and the costs (B,); near: (B, 1, 1)."""
        inputs = self.data.inputs
        observations = self._observations(self.start)
        x, y, depth = points_c.unbind(2)
        valid = depth > torch.finfo(depth.dtype).eps
        inverse = torch.where(valid, depth, 1.0).reciprocal()
        fx, fy, cx, cy = observations.camera.params[..., None].unbind(2)
        u, v, a, b = x * inverse, y * inverse, fx * inverse, fy * inverse
        rx, ry = fx * u + (cx - inputs.pixels[:, :, 0]), fy * v + (cy - inputs.pixels[:, :, 1])
        squared = rx * rx + ry * ry
        cost, weight, bend = weigh(observations, squared, valid)
        bend = flat_along(weight, bend, squared, near)
        # J^T W J, with J^T (u, v, 1) = 0, and W = weight * I + bend * r r^T.
        C00, C01, C11 = (
            a * a * (weight + bend * rx * rx),
            a * b * bend * rx * ry,
            b * b * (weight + bend * ry * ry),
        )
        C02, C12 = -(u * C00 + v * C01), -(u * C01 + v * C11)
        q0, q1 = a * weight * rx, b * weight * ry
        C = (C00, C01, C02, C01, C11, C12, C02, C12, -(u * C02 + v * C12))
        hessian = torch.stack(C, dim=2).unflatten(2, (3, 3))
        return GridExpansion(torch.stack((q0, q1, -(u * q0 + v * q1)), dim=2), hessian), cost.sum((1, 2))

    def _equations(
        self,
        estimate: GridEstimate,
        expansion: GridExpansion,
        exact: bool = False,
        share: Tensor | float = 1.0,
    ) -> tuple[GridEquations, Tensor | float]:
        """The equations with a share of the priors, and the priors' cost (B,)."""
        R_cw, t_cw = estimate.T_cw[..., :3, :3], estimate.T_cw[..., :3, 3:]
        rays_w = estimate.points_w[:, None] + R_cw.mT @ t_cw
        equations = assemble_grid(expansion, rays_w, R_cw, self.data.layout.free, exact)
        terms = self._priors(estimate, exact)
        if terms is None:
            return equations, 0.0
        gradient = torch.cat((terms.frames_gradient.flatten(1), terms.camera_gradient), dim=1)
        frames, camera = block_diagonal(terms.frames), terms.camera
        size, more = frames.shape[-1], camera.shape[-1]
        hessian = torch.nn.functional.pad(frames, (0, more, 0, more))
        hessian = hessian + torch.nn.functional.pad(camera, (size, 0, size, 0))
        return (
            equations._replace(
                gradient=equations.gradient + gradient, reduced=equations.reduced + share * hessian
            ),
            terms.cost,
        )

    def _priors(self, estimate: GridEstimate, exact: bool = False) -> PriorTerms | None:
        inputs, free = self.data.inputs, self.data.layout.free
        if inputs.pose_prior is not None:
            leading = free.shape[1]
            inputs = inputs._replace(
                prior_T_cw=inputs.prior_T_cw[:, :leading],
                prior_information=inputs.prior_information[:, :leading],
            )
        T_cw = estimate.T_cw[:, : free.shape[1]]
        terms = prior_terms(inputs, T_cw, estimate.params, free, self.directions, exact)
        return None if terms is None else terms.in_world(T_cw[..., :3, :3])

    def _split(self, vector: Tensor) -> tuple[Tensor, Tensor]:
        """The parts of (B, D) that are of the free frames (B, F', 6) and of the cameras."""
        leading = self.data.layout.free.shape[1]
        return vector[:, : 6 * leading].unflatten(1, (leading, 6)), vector[:, 6 * leading :]

    def _factorized(
        self, estimate: GridEstimate, equations: GridEquations, damping: Tensor | None = None
    ) -> FactorizedGrid:
        layout = self.data.layout
        more = equations.reduced.shape[-1] - 6 * layout.free.shape[1]
        return factorized_grid(
            equations, layout.free, layout.free_points, more, damping, self._gauge(estimate)
        )

    def _gauge(self, estimate: GridEstimate) -> Tensor | None:
        """Directions (B, 6 F', g), along the world's axes, that what is fixed leaves open, zero where nothing is; None
        where nowhere."""
        layout = self.data.layout
        free, anchors = layout.free, layout.anchors.sum(1)
        is_open = (anchors < 2) & ~layout.held_points & free.any(1)
        if not is_open.any():
            return None
        T_free = estimate.T_cw[:, : free.shape[1]]
        first = torch.where(anchors > 0, layout.anchors.int().argmax(1), 0)[:, None]
        origin = se3_inverse(take(estimate.T_cw, first))[:, :, None, :3, 3]
        scaling = torch.nn.functional.pad(transform(T_free, origin).squeeze(-2), (0, 3))
        R_wc = T_free[..., :3, :3].mT
        scaling = turned(R_wc, scaling[..., None])[..., 0]
        scaling = torch.where((free & is_open[:, None])[..., None], scaling, 0.0)
        length = scaling.square().sum((1, 2), keepdim=True)
        motions = (scaling * torch.where(length > 0, length, 1.0).rsqrt())[..., None]
        adrift = is_open & (anchors == 0) & (free.sum(1) > 1)
        if adrift.any():
            moves = torch.where(free[..., None, None], -turned(R_wc, se3_adjoint(T_free)), 0.0)
            whole = torch.cat((motions, moves), dim=-1).flatten(1, 2)
            eye = torch.eye(*whole.shape[1:], dtype=whole.dtype, device=whole.device)
            whole = torch.linalg.qr(torch.where(adrift[:, None, None], whole, eye)).Q
            rest = torch.where(adrift[:, None, None], whole[..., 1:], 0.0).unflatten(1, (free.shape[1], 6))
            motions = torch.cat((motions, rest), dim=-1)
        with torch.no_grad():
            priors = self._priors(estimate)
            motions = motions if priors is None else still_open(motions, priors.frames)
        return motions.flatten(1, 2)


def _expanded(lin: Linearization, near: Tensor) -> GridExpansion:
    """Without the bend of the projection; near: (B,)."""
    J = lin.J.movedim((-2, -1), (0, 1))
    gradient, hessian = gauss_newton_expansion(lin, J, near[:, None, None])
    return GridExpansion(gradient.movedim(0, 2).contiguous(), hessian.movedim((0, 1), (2, 3)).contiguous())


def _as_grid(expansion: Expansion) -> GridExpansion:
    """(B, F, P, D) and (B, F, P, D, D) with the points last."""
    return GridExpansion(expansion.gradient.mT.contiguous(), expansion.hessian.movedim(2, -1).contiguous())
