"""The least-squares problem behind `bundle_adjust`: its layout, its local models, its adjoint."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torchslam.geometry.camera import Camera
from torchslam.geometry.lie import se3_adjoint, se3_inverse, transform
from torchslam.solvers.assembly import assemble
from torchslam.solvers.residuals import (
    Expansion,
    Linearization,
    Observations,
    exact_expansion,
    gauss_newton_expansion,
    linearize,
    variance_factor,
)
from torchslam.solvers.robust import Kernel
from torchslam.solvers.schur import (
    FactorizedEquations,
    Marginals,
    NormalEquations,
    Structure,
    build_structure,
)
from torchslam.solvers.tangent import retract

_MIN_POINTS_PER_FRAME = 3
_MIN_FRAMES_PER_POINT = 2


@dataclass(frozen=True)
class Layout:
    """The discrete part of a bundle adjustment: what moves, what counts, and in which order it is processed.

    observations: (O',) rows of the problem's observations that count, ordered as `Structure` asks
    frame_index:  (O',) rows of T_cw; point_index: (O',) positions in point_order
    point_order:  (P,) rows of points_w, ordered as `Structure` asks; point_rank: (P,) its inverse
    free_frames:  (F',) rows of T_cw that move; free_points: (P,) bool, in point_order
    """

    observations: Tensor
    frame_index: Tensor
    point_index: Tensor
    point_order: Tensor
    point_rank: Tensor
    free_frames: Tensor
    free_points: Tensor
    structure: Structure


def build_layout(
    frame_index: Tensor, point_index: Tensor, counted: Tensor, free_frames: Tensor, free_points: Tensor
) -> Layout:
    """Order the observations and decide what moves.

    counted: (O,) bool, observations that count; free_frames (F,) and free_points (P,) bool: what may move. Of these,
    points seen less than twice and frames that see less than three points do not move and are not observed.
    """
    num_frames, num_points = len(free_frames), len(free_points)
    seen = torch.bincount(point_index[counted], minlength=num_points) >= _MIN_FRAMES_PER_POINT
    counted = counted & (seen | ~free_points)[point_index]
    seeing = torch.bincount(frame_index[counted], minlength=num_frames) >= _MIN_POINTS_PER_FRAME
    counted = counted & (seeing | ~free_frames)[frame_index]
    free_frames, free_points = free_frames & seeing, free_points & seen

    count = int(free_frames.sum())
    slots = torch.where(free_frames, free_frames.cumsum(0) - 1, count)
    rows = counted.nonzero().squeeze(-1)
    rows = rows[torch.argsort(slots[frame_index[rows]], stable=True)]
    first = torch.full((num_points,), count, device=rows.device)
    first = first.scatter_reduce(0, point_index[rows], slots[frame_index[rows]], "amin")
    point_order = torch.argsort(first, stable=True)
    point_rank = torch.argsort(point_order)
    points = point_rank[point_index[rows]]
    structure = build_structure(slots[frame_index[rows]], points, count, num_points)
    return Layout(
        rows,
        frame_index[rows],
        points,
        point_order,
        point_rank,
        free_frames.nonzero().squeeze(-1),
        free_points[point_order],
        structure,
    )


class Estimate(NamedTuple):
    """(F, 4, 4) poses, (P, 3) points in the layout's order, (K,) camera parameters."""

    T_cw: Tensor
    points_w: Tensor
    params: Tensor


class Inputs(NamedTuple):
    """All that gradients may flow to, in the order of the problem."""

    T_cw: Tensor
    points_w: Tensor
    pixels: Tensor
    weights: Tensor
    params: Tensor
    scale: Tensor


@dataclass(frozen=True)
class BundleModel:
    """The local model of the cost (1,) at an estimate."""

    estimate: Estimate
    cost: Tensor
    equations: NormalEquations


class Bundle:
    """A bundle adjustment for `levenberg.minimize` (a batch of one), and what follows from its minimum."""

    def __init__(
        self, layout: Layout, inputs: Inputs, camera: Camera, kernel: Kernel, free_camera: bool | Tensor
    ) -> None:
        """free_camera: whether all parameters (K,) move, or the directions (K, n) in which they do."""
        self.layout, self.free_camera = layout, free_camera is not False
        self.directions = free_camera if isinstance(free_camera, Tensor) else None
        self.columns: Tensor | None = (
            None  # (3 + K, 3 + n) from the point and the directions to the parameters
        )
        if self.directions is not None:
            eye = torch.eye(3, dtype=self.directions.dtype, device=self.directions.device)
            self.columns = torch.block_diag(eye, self.directions)
        self.observations = Observations(
            inputs.pixels.index_select(0, layout.observations),
            inputs.weights.index_select(0, layout.observations),
            camera.with_params(inputs.params),
            kernel,
            inputs.scale,
        )
        self.start = Estimate(inputs.T_cw, inputs.points_w.index_select(0, layout.point_order), inputs.params)
        self.solvable = torch.tensor([len(layout.observations) > 0], device=inputs.pixels.device)

    def evaluate(self, estimate: Estimate, near: Tensor) -> BundleModel:
        lin, points_c, R_cw = self._linearize(estimate)
        expansion = gauss_newton_expansion(lin, near)
        layout = self.layout
        equations = assemble(layout.structure, expansion, points_c, R_cw, layout.free_points, exact=False)
        return BundleModel(estimate, lin.cost.sum()[None], equations)

    def step(self, model: BundleModel, damping: Tensor) -> tuple[Estimate, Tensor]:
        equations, estimate = model.equations, model.estimate
        factorized = equations.factorized(damping, self._gauge(estimate.T_cw))
        step = factorized.solve(equations.gradient)
        decrease = torch.where(factorized.reduced.definite, 0.5 * step.dot(equations.gradient), torch.inf)
        frames = self.layout.free_frames
        moved = retract(estimate.T_cw.index_select(0, frames), -step.frames)
        params = estimate.params - self._along(step.camera) if self.free_camera else estimate.params
        return (
            Estimate(estimate.T_cw.index_copy(0, frames, moved), estimate.points_w - step.points, params),
            decrease[None],
        )

    def _along(self, step: Tensor) -> Tensor:
        """(K,) how a step (n,) changes the camera's parameters."""
        return step if self.directions is None else self.directions @ step

    def select(self, accept: Tensor, new: BundleModel, old: BundleModel) -> BundleModel:
        return new if bool(accept) else old

    def factorized(self, model: BundleModel) -> FactorizedEquations:
        """The undamped equations of a model at a minimum, ready to be solved."""
        return model.equations.factorized(gauge=self._gauge(model.estimate.T_cw))

    def _gauge(self, T_cw: Tensor) -> Tensor | None:
        """Directions (F', 6, g) that what is fixed leaves open: scale, or a similarity; None where nothing is."""
        layout = self.layout
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
        return torch.linalg.qr(motions.flatten(0, 1)).Q.view_as(motions)

    def marginals(self, estimate: Estimate) -> Marginals:
        """Covariances (F, 6, 6), (P, 3, 3), (K, K) in the order of the problem, zero for what does not move."""
        lin, _, _ = self._linearize(estimate)
        model = self.evaluate(estimate, torch.zeros_like(self.solvable))
        layout, structure = self.layout, self.layout.structure
        num_parameters = (
            6 * structure.num_frames + 3 * int(layout.free_points.sum()) + len(model.equations.camera)
        )
        factor = variance_factor(self.observations, lin, num_parameters)
        free, points, camera = self.factorized(model).marginals()
        frames = free.new_zeros(len(estimate.T_cw), 6, 6).index_copy(0, layout.free_frames, free)
        return Marginals(factor * frames, factor * points[layout.point_rank], factor * camera)

    def exact_factorized(self, estimate: Estimate) -> FactorizedEquations:
        """The exact Hessian at a minimum, ready to be solved."""
        return self._exact_equations(estimate).factorized(gauge=self._gauge(estimate.T_cw))

    def _linearize(self, estimate: Estimate) -> tuple[Linearization, Tensor, Tensor]:
        """Errors, points in the camera frame (O', 3) and rotations (O', 3, 3) of the observing frames."""
        T_cw = estimate.T_cw.index_select(0, self.layout.frame_index)
        points_w = estimate.points_w.index_select(0, self.layout.point_index)
        R_cw = T_cw[:, :3, :3]
        points_c = (R_cw @ points_w[..., None]).squeeze(-1) + T_cw[:, :3, 3]
        lin = linearize(self._observations(estimate), points_c, self.free_camera)
        return lin if self.columns is None else lin._replace(J=lin.J @ self.columns), points_c, R_cw

    def _observations(self, estimate: Estimate) -> Observations:
        if not self.free_camera:
            return self.observations
        pixels, weights, _, scale = self.observations.tensors()
        return self.observations.replaced((pixels, weights, estimate.params, scale))

    def _exact_equations(self, estimate: Estimate) -> NormalEquations:
        _, points_c, R_cw = self._linearize(estimate)
        expansion = exact_expansion(self._observations(estimate), points_c, self.free_camera)
        if self.columns is not None:
            gradient, hessian = expansion
            expansion = Expansion(gradient @ self.columns, self.columns.mT @ hessian @ self.columns)
        layout = self.layout
        return assemble(layout.structure, expansion, points_c, R_cw, layout.free_points, exact=True)
