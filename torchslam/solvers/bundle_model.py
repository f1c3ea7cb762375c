"""The least-squares problem behind `bundle_adjust`: its layout, its local models, its adjoint."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from torchslam.geometry.camera import Camera
from torchslam.geometry.lie import se3_adjoint, se3_inverse, transform
from torchslam.solvers.assembly import assemble, product
from torchslam.solvers.residuals import (
    Expansion,
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
    Tangent,
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
    """The local model of the cost (1,) at an estimate; its equations are made when they are asked for.

    Where a minimisation ends nobody asks, and they are most of the work.
    """

    estimate: Estimate
    cost: Tensor
    assembled: Callable[[], NormalEquations]

    @cached_property
    def equations(self) -> NormalEquations:
        return self.assembled()


class Bundle:
    """A bundle adjustment for `levenberg.minimize` (a batch of one), and what follows from its minimum."""

    def __init__(
        self, layout: Layout, inputs: Inputs, camera: Camera, kernel: Kernel, free_camera: bool | Tensor
    ) -> None:
        """free_camera: whether all parameters (K,) move, or the directions (K, n) in which they do."""
        self.layout, self.free_camera = layout, free_camera is not False
        self.directions = free_camera if isinstance(free_camera, Tensor) else None
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
        R_cw, rays_w, points_c = self._seen(estimate)
        lin = linearize(self._observations(estimate), points_c, self.free_camera)

        def assembled() -> NormalEquations:
            expansion = gauss_newton_expansion(lin, self._in_world(lin.J.movedim(0, -1), R_cw), near)
            return assemble(self.layout.structure, expansion, rays_w, self.layout.free_points, exact=False)

        return BundleModel(estimate, lin.cost.sum()[None], assembled)

    def step(self, model: BundleModel, damping: Tensor) -> tuple[Estimate, Tensor]:
        equations, estimate = model.equations, model.estimate
        factorized = equations.factorized(damping, self._gauge(estimate.T_cw))
        step = factorized.solve(equations.gradient)
        decrease = torch.where(factorized.reduced.definite, 0.5 * step.dot(equations.gradient), torch.inf)
        frames = self.layout.free_frames
        T_free = estimate.T_cw.index_select(0, frames)
        moved = retract(T_free, -_turned(T_free[:, :3, :3], step.frames[..., None])[..., 0])
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
        """The undamped equations of a model at a minimum, ready to be solved; frames in the axes of the world."""
        return model.equations.factorized(gauge=self._gauge(model.estimate.T_cw))

    def _gauge(self, T_cw: Tensor) -> Tensor | None:
        """Directions (F', 6, g) that what is fixed leaves open: scale, or a similarity; None where nothing is.

        In the axes of the world, as are all vectors of the equations.
        """
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
        motions = _turned(T_free[:, :3, :3].mT, motions)
        return torch.linalg.qr(motions.flatten(0, 1)).Q.view_as(motions)

    def marginals(self, estimate: Estimate) -> Marginals:
        """Covariances (F, 6, 6), (P, 3, 3), (K, K) in the order of the problem, zero for what does not move."""
        lin = linearize(self._observations(estimate), self._seen(estimate)[2], self.free_camera)
        model = self.evaluate(estimate, torch.zeros_like(self.solvable))
        layout, structure = self.layout, self.layout.structure
        num_parameters = (
            6 * structure.num_frames + 3 * int(layout.free_points.sum()) + len(model.equations.camera)
        )
        factor = variance_factor(self.observations, lin, num_parameters)
        free, points, camera = self.factorized(model).marginals()
        R_cw = estimate.T_cw[layout.free_frames, :3, :3]
        free = _turned(R_cw, _turned(R_cw, free).mT)
        frames = free.new_zeros(len(estimate.T_cw), 6, 6).index_copy(0, layout.free_frames, free)
        return Marginals(factor * frames, factor * points[layout.point_rank], factor * camera)

    def exact_solver(self, estimate: Estimate) -> Callable[[Tangent], Tangent]:
        """The function v -> H^-1 v with the exact Hessian at a minimum."""
        factorized = self._exact_equations(estimate).factorized(gauge=self._gauge(estimate.T_cw))
        R_cw = estimate.T_cw[self.layout.free_frames, :3, :3]

        def solve(right: Tangent) -> Tangent:
            turned = right._replace(frames=_turned(R_cw.mT, right.frames[..., None])[..., 0])
            solved = factorized.solve(turned)
            return solved._replace(frames=_turned(R_cw, solved.frames[..., None])[..., 0])

        return solve

    def _seen(self, estimate: Estimate) -> tuple[Tensor, Tensor, Tensor]:
        """Per observation the rotation (3, 3, O') of its frame, and the ray to its point: (3, O') in the axes of the
        world and (O', 3) in those of the camera."""
        R_cw = estimate.T_cw[:, :3, :3]
        centres_w = -(R_cw.mT @ estimate.T_cw[:, :3, 3:])
        frames = torch.cat((R_cw.flatten(1), centres_w[..., 0]), dim=-1)
        rows = frames.index_select(0, self.layout.frame_index).mT.contiguous()
        R_cw = rows[:9].unflatten(0, (3, 3))
        rays_w = estimate.points_w.index_select(0, self.layout.point_index).mT - rows[9:]
        return R_cw, rays_w, product(R_cw, rays_w[:, None])[:, 0].mT

    def _in_world(self, rows: Tensor, R_cw: Tensor) -> Tensor:
        """Derivatives (m, 3 + K, O') in points_c and the camera, as such in points_w and what moves of the camera."""
        points = product(rows[:, :3], R_cw)
        if not self.free_camera:
            return points
        camera = rows[:, 3:] if self.directions is None else self.directions.mT @ rows[:, 3:]
        return torch.cat((points, camera), dim=1)

    def _observations(self, estimate: Estimate) -> Observations:
        if not self.free_camera:
            return self.observations
        pixels, weights, _, scale = self.observations.tensors()
        return self.observations.replaced((pixels, weights, estimate.params, scale))

    def _exact_equations(self, estimate: Estimate) -> NormalEquations:
        R_cw, rays_w, points_c = self._seen(estimate)
        gradient, hessian = exact_expansion(self._observations(estimate), points_c, self.free_camera)
        half = self._in_world(hessian.movedim(0, -1), R_cw).transpose(0, 1)
        expansion = Expansion(self._in_world(gradient.mT[None], R_cw)[0], self._in_world(half, R_cw))
        return assemble(self.layout.structure, expansion, rays_w, self.layout.free_points, exact=True)


def _turned(R: Tensor, values: Tensor) -> Tensor:
    """Both halves of tangent vectors (F, 6, n) turned by R (F, 3, 3)."""
    return (R[:, None] @ values.unflatten(1, (2, 3))).flatten(1, 2)
