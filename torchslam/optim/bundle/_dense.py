"""The dense formulation of bundle adjustments by PyTorch: batches of small problems, differentiable.

Every frame is paired with every point, with the points along the last dimension, so that sums over frames and points
are batched matrix products and the Schur complement is one product per problem. It suits windows of a few frames that
see most of the same points; `_sparse` is the formulation for maps, `dense_numpy` the backend for a single problem.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchslam.geometry.camera import Camera
from torchslam.geometry.lie import se3_inverse, skew
from torchslam.geometry.robust import Kernel
from torchslam.optim._core.implicit import Tensors
from torchslam.optim._core.levenberg_marquardt import index_tree, select_models
from torchslam.optim._core.linear import (
    LOWER_3X3,
    DefiniteFactor,
    diagonal_floor,
    factorize,
    inverse_roots,
    lower_times,
)
from torchslam.optim._core.residuals import (
    Expansion,
    Linearization,
    ReprojectionData,
    exact_expansion,
    gauss_newton_expansion,
    linearize,
    rounding_cost,
    variance_factor,
)
from torchslam.optim._core.tangent import cross_entries, retract, rotated
from torchslam.optim.bundle._problem import (
    BundleData,
    BundleEstimate,
    MovingParts,
    PriorTerms,
    block_diagonal,
    flat_rows,
    gauge_motions,
    open_motions,
    prior_terms,
    stiffness_along,
)
from torchslam.optim.bundle._schur import Marginals


class DenseLayout(NamedTuple):
    """The discrete part of the problems; every tensor leads with the batch.

    Attributes:
        order: rows of T_cw, those that move first
        rank: its inverse
        cells: place of each observation among the K * N cells of its grid, the one after them if it
            does not count
        free: which of the first K' move, K' being the most of any problem
        anchors: which of the ordered frames stay and see something
        held_points: whether a point that is seen stays
    """

    order: Int[Tensor, "B K"]
    rank: Int[Tensor, "B K"]
    cells: Int[Tensor, "B O"]
    free: Bool[Tensor, "B F"]
    anchors: Bool[Tensor, "B K"]
    free_points: Bool[Tensor, "B N"]
    held_points: Bool[Tensor, " B"]


_CELLS_PER_OBSERVATION, _CELLS_PER_OBSERVATION_ALONE = 8, 1.5
"""Cells of a grid up to which it is faster than sparse equations, in a batch and for a single problem. Tried from 3 to
24 frames and 50 to 2000 points: alone, full grids take .5 to .9 of the time, half empty ones .8 to 1.1."""
_MOST_FRAMES_ALONE = 16
"""Frames of a single problem: with many, sparse equations let points take steps of their own."""


def suits_dense(given: BundleData, moving: MovingParts) -> bool:
    """Whether grids are the faster way: no point is seen twice in a frame, and few cells are empty."""
    num_frames, num_points = moving.frames.shape[1], moving.points.shape[1]
    cells = moving.frames.numel() * num_points
    if given.weights.ndim > 2 or given.depths.shape[1] or given.measured.shape[1]:
        return False  # the dense equations take scalar weights only, and neither depths nor factors
    alone = len(given.T_cw) == 1
    most = _CELLS_PER_OBSERVATION_ALONE if alone else _CELLS_PER_OBSERVATION
    if not 0 < cells <= most * int(moving.counted.sum()) or (alone and num_frames > _MOST_FRAMES_ALONE):
        return False
    places = flat_rows(given.frame_index * num_points + given.point_index, num_frames * num_points)
    return int(torch.bincount(places[moving.counted.flatten()], minlength=1).max()) <= 1


def build_dense_layout(given: BundleData, moving: MovingParts) -> DenseLayout:
    """The grids of problems that `suits_dense`."""
    num_frames, num_points = moving.frames.shape[1], moving.points.shape[1]
    order = torch.argsort((~moving.frames).int(), dim=1, stable=True)
    rank = torch.argsort(order, dim=1)
    counts = moving.frames.sum(1)
    slots = torch.arange(int(counts.max()), device=counts.device)
    frames = rank.gather(1, given.frame_index)
    seeing = torch.zeros_like(rank).scatter_add(1, frames, moving.counted.long()) > 0
    held = moving.counted & ~moving.points.gather(1, given.point_index)
    return DenseLayout(
        order,
        rank,
        torch.where(moving.counted, frames * num_points + given.point_index, num_frames * num_points),
        slots < counts[:, None],
        seeing & ~moving.frames.gather(1, order),
        moving.points,
        held.any(1),
    )


def dense_data(layout: DenseLayout, given: BundleData) -> BundleData:
    """The problems in the layout's order, with grids of pixels (B, K, 2, N) and weights (B, K, N), zero where nothing
    was seen."""
    priors = given.prior_T_cw, given.prior_information
    if given.pose_prior is not None:
        priors = take_rows(priors[0], layout.order), take_rows(priors[1], layout.order)
    return given._replace(
        T_cw=take_rows(given.T_cw, layout.order),
        pixels=_spread(layout, given.pixels.mT),
        weights=_spread(layout, given.weights[:, None])[:, :, 0],
        prior_T_cw=priors[0],
        prior_information=priors[1],
        camera_index=take_rows(given.camera_index, layout.order),
    )


def take_rows(tensor: Tensor, rows: Tensor) -> Tensor:
    """Rows (B, M) of (B, K, ...)."""
    index = rows.view(*rows.shape, *(1,) * (tensor.ndim - 2))
    return tensor.gather(1, index.expand(*rows.shape, *tensor.shape[2:]))


def _spread(layout: DenseLayout, values: Tensor) -> Tensor:
    """Values (B, D, O) of observations in their cells, (B, K, D, N)."""
    (batch, num_frames), num_points = layout.order.shape, layout.free_points.shape[1]
    grid = values.new_zeros(batch, values.shape[1], num_frames * num_points + 1)
    grid = grid.scatter(2, layout.cells[:, None].expand_as(values), values)[..., :-1]
    return grid.unflatten(-1, (num_frames, num_points)).transpose(1, 2).contiguous()


_CROSS = skew(torch.eye(3, dtype=torch.float64, device="cpu")).permute(2, 0, 1).reshape(9, 3)
"""eps_ijk of the cross product, (a x b)_i = eps_ijk a_j b_k, at (3 k + j, i): flat products b a^T times it."""


class DenseEquations(NamedTuple):
    """Gradient and Hessian over K free frames, which move along the axes of the world as in `_sparse`, and the
    cameras, D = 6 K + C n, and points.
    """

    gradient: Float[Tensor, "B D"]
    points_gradient: Float[Tensor, "B 3 N"]
    reduced: Float[Tensor, "B D D"]
    points: Float[Tensor, "B 3 3 N"]
    coupling: Float[Tensor, "B D 3 N"]


def _sum_by_camera(values: Tensor, camera_of: Tensor, num_cameras: int, over_points: bool = True) -> Tensor:
    """Sums (B, C, ...) of values (B, K, ..., N) over the frames of each camera and, unless told not to, the points."""
    if num_cameras == 1:
        return values.sum((1, -1) if over_points else 1)[:, None]
    values = values.sum(-1) if over_points else values
    own = torch.nn.functional.one_hot(camera_of, num_cameras).to(values.dtype)
    return (own.mT @ values.flatten(2)).unflatten(2, values.shape[2:])


def _times(R: Tensor, columns: Tensor) -> Tensor:
    """R (B, K, 3, 3) times columns (B, K, 3, n, N)."""
    return (R @ columns.flatten(3)).view_as(columns)


def _sum_by_frame(
    slope: Tensor, across: Tensor, coupling: Tensor, rays_w: Tensor, exact: bool
) -> tuple[Tensor, Tensor, Tensor]:
    """G^T q (B, K, 6), G^T C G (B, K, 6, 6) and G^T C_camera (B, K, 6, P) summed over the points, G = [I, -r^].

    They are sums of q, C_camera and G^T C (B, K, 6, 3, N) times 1 and r.
    """
    num_camera, cross = across.shape[3], _CROSS.to(rays_w.dtype).to(rays_w.device)
    affine = torch.cat((torch.ones_like(rays_w[:, :, :1]), rays_w), dim=2).mT
    pushed = slope @ affine  # (B, K, 3, 4)
    outer = pushed[..., 1:]
    torque = outer.flatten(2) @ cross
    moments = (coupling.flatten(2, 3) @ affine).unflatten(2, (6, 3))  # (B, K, 6, 3, 4)
    frames = torch.cat((moments[..., 0], moments[..., 1:].flatten(3) @ cross), dim=-1)
    if exact:
        eye = torch.eye(3, dtype=outer.dtype, device=outer.device)
        trace = outer.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
        curvature_term = 0.5 * (outer + outer.mT) - trace * eye
        frames = frames + torch.nn.functional.pad(curvature_term, (3, 0, 3, 0))
    gradient = torch.cat((pushed[..., 0], torque), dim=-1)
    if not num_camera:
        return gradient, frames, frames[..., :0]
    sums = (across.flatten(2, 3) @ affine).unflatten(2, (3, num_camera))  # (B, K, 3, P, 4)
    rotated = (sums[..., 1:].transpose(2, 3).flatten(3) @ cross).mT
    return gradient, frames, torch.cat((sums[..., 0], rotated), dim=-2)


class FactorizedDense(NamedTuple):
    """Equations ready to be solved for any right side: the inverse roots of the points' blocks, zero for points that
    do not move, the coupling times them, and the reduced system of frames and cameras."""

    root: Float[Tensor, "B 3 3 N"]
    whitened: Float[Tensor, "B D N3"]
    reduced: DefiniteFactor

    def solve(
        self, right: Float[Tensor, "B D"], points: Float[Tensor, "B 3 N"]
    ) -> tuple[Float[Tensor, "B D"], Float[Tensor, "B 3 N"]]:
        """H^-1 right; all zero where the reduced system is not definite."""
        halves = (self.root * points[:, None]).sum(2)
        rest = right - (self.whitened @ halves.flatten(1)[..., None]).squeeze(-1)
        solution = self.reduced.solve(rest[..., None])
        halves = halves - (self.whitened.mT @ solution).view_as(halves)
        moved = (self.root * halves[:, :, None]).sum(1)
        return solution.squeeze(-1), torch.where(self.reduced.definite[:, None, None], moved, 0.0)

    def marginals(self) -> tuple[Float[Tensor, "B D D"], Float[Tensor, "B N 3 3"]]:
        """The inverse over frames and cameras, and the blocks of the points."""
        size = self.whitened.shape[1]
        eye = torch.eye(size, dtype=self.root.dtype, device=self.root.device)
        inverse = self.reduced.solve(eye.expand(len(self.root), size, size))
        A = self.whitened.unflatten(-1, (3, -1)).permute(0, 3, 2, 1)  # (B, N, 3, D)
        root = self.root.permute(0, 3, 1, 2)
        inner = torch.eye(3, dtype=A.dtype, device=A.device) + (A @ inverse[:, None]) @ A.mT
        return inverse, root.mT @ inner @ root


class DenseModel(NamedTuple):
    """The local models of the costs at an estimate, which has the layout's order and points (B, 3, N)."""

    estimate: BundleEstimate
    cost: Float[Tensor, " B"]
    equations: DenseEquations


@dataclass(frozen=True)
class DenseBundle:
    """A batch of bundle adjustments for `minimize_batch`, with their covariances and exact solvers.

    given: as of `dense_data`; directions: in which the cameras' parameters move, None where they do not
    """

    layout: DenseLayout
    given: BundleData
    camera: Camera
    kernel: Kernel
    directions: Float[Tensor, "P n"] | None
    concludes: bool = False

    @property
    def solvable(self) -> Tensor:
        layout, has_prior = self.layout, self.given.pose_prior is not None
        observed = (layout.cells < layout.order.shape[1] * layout.free_points.shape[1]).any(1)
        return observed | layout.free.any(1) if has_prior else observed

    @property
    def start(self) -> BundleEstimate:
        return BundleEstimate(self.given.T_cw, self.given.points_w.mT, self.given.params)

    def rounding(self) -> Tensor:
        return rounding_cost(self.given.weights, self.given.params)

    def part(self, rows: Tensor) -> DenseBundle:
        """The problems of some elements of the batch."""
        layout, given = index_tree((self.layout, self.given), rows)
        return replace(self, layout=layout, given=given)

    def evaluate(self, estimate: BundleEstimate, use_curvature: Tensor) -> DenseModel:
        lin = self._linearize(estimate)
        equations, prior_cost = self._equations(estimate, _expanded(lin, use_curvature))
        return DenseModel(estimate, lin.cost.sum((1, 2)) + prior_cost, equations)

    def step(self, model: DenseModel, damping: Tensor) -> tuple[BundleEstimate, Tensor]:
        equations, (T_cw, points_w, params) = model.equations, model.estimate
        factorized = self._factorized(model.estimate, equations, damping)
        step, points = factorized.solve(equations.gradient, equations.points_gradient)
        of_points = (points * equations.points_gradient).sum((1, 2))
        predicted_reduction = (step * equations.gradient).sum(1) + of_points
        predicted_reduction = torch.where(factorized.reduced.definite, 0.5 * predicted_reduction, torch.inf)
        frames, camera = self._split(step)
        leading = frames.shape[1]
        moved = retract(T_cw[:, :leading], -rotated(T_cw[:, :leading, :3, :3], frames[..., None])[..., 0])
        T_cw = torch.cat((moved, T_cw[:, leading:]), dim=1)
        if self.directions is not None:
            params = params - camera.unflatten(1, (params.shape[1], -1)) @ self.directions.mT
        return BundleEstimate(T_cw, points_w - points, params), predicted_reduction

    select = staticmethod(select_models)

    def concluded(self, model: DenseModel, estimate: BundleEstimate) -> DenseModel:
        return model._replace(estimate=estimate)

    def definite(self, model: DenseModel) -> Tensor:
        """Whether (B,) all that moves is determined, up to the gauge."""
        return self._factorized(model.estimate, model.equations).reduced.definite

    def exact_solver(self, estimate: BundleEstimate) -> Callable[[Tensors], Tensors]:
        """v -> H^-1 v with the exact Hessians at minima, in the order of the problems."""
        layout, ordered = self.layout, self.ordered(estimate)
        points_c = self._points_c(ordered)
        expansion = exact_expansion(self._observations(ordered), points_c.mT, self.directions is not None)
        if self.directions is not None:
            expansion = expansion.along(self._columns)
        gradient, hessian = expansion.gradient.mT.contiguous(), expansion.hessian.movedim(2, -1).contiguous()
        equations, _ = self._equations(ordered, Expansion(gradient, hessian), exact=True)
        factorized = self._factorized(ordered, equations)
        leading = layout.free.shape[1]
        padding, R_cw = layout.order.shape[1] - leading, ordered.T_cw[:, :leading, :3, :3]

        def solve(right: Tensors) -> Tensors:
            frames, points, camera = right
            frames = torch.where(layout.free[..., None], take_rows(frames, layout.order)[:, :leading], 0.0)
            frames = rotated(R_cw.mT, frames[..., None])[..., 0]
            solved, points = factorized.solve(torch.cat((frames.flatten(1), camera), dim=1), points.mT)
            frames, camera = self._split(solved)
            frames = torch.nn.functional.pad(rotated(R_cw, frames[..., None])[..., 0], (0, 0, 0, padding))
            return take_rows(frames, layout.rank), points.mT, camera

        return solve

    def marginals(self, estimate: BundleEstimate) -> Marginals:
        """Covariances (B, K, 6, 6), (B, N, 3, 3), (B, C n, C n) in the order of the problems, zero for what stays."""
        layout, ordered = self.layout, self.ordered(estimate)
        lin = self._linearize(ordered)
        observed = self._observations(ordered)
        flat = replace(observed, pixels=observed.pixels.flatten(1, 2), weights=observed.weights.flatten(1))
        num_cameras = 0 if self.directions is None else estimate.params.shape[1] * self.directions.shape[1]
        num_parameters = 6 * layout.free.sum(1) + 3 * layout.free_points.sum(1) + num_cameras
        factor = variance_factor(flat, Linearization(*(part.flatten(1, 2) for part in lin)), num_parameters)
        expansion = _expanded(lin, torch.zeros_like(factor))
        equations, _ = self._equations(ordered, expansion, share=factor[:, None, None])
        inverse, points = self._factorized(ordered, equations).marginals()
        inverse, points = factor[:, None, None] * inverse, factor[:, None, None, None] * points
        leading = layout.free.shape[1]
        size, R_cw = 6 * leading, ordered.T_cw[:, :leading, :3, :3]
        frames = inverse[:, :size, :size].unflatten(1, (-1, 6)).unflatten(3, (-1, 6)).diagonal(dim1=1, dim2=3)
        frames = rotated(R_cw, rotated(R_cw, frames.movedim(-1, 1)).mT)
        frames = torch.where(layout.free[..., None, None], frames, 0.0)
        padding = layout.order.shape[1] - leading
        frames = take_rows(torch.nn.functional.pad(frames, (0, 0, 0, 0, 0, padding)), layout.rank)
        return Marginals(frames, points, inverse[:, size:, size:])

    def ordered(self, estimate: BundleEstimate) -> BundleEstimate:
        """An estimate as the grids have it."""
        T_cw = take_rows(estimate.T_cw, self.layout.order)
        return BundleEstimate(T_cw, estimate.points_w.mT, estimate.params)

    def in_order(self, estimate: BundleEstimate) -> BundleEstimate:
        """An estimate as the problems have it."""
        T_cw = take_rows(estimate.T_cw, self.layout.rank)
        return BundleEstimate(T_cw, estimate.points_w.mT, estimate.params)

    def _points_c(self, estimate: BundleEstimate) -> Tensor:
        """Points in the camera frames, (B, K, 3, N)."""
        T_cw = estimate.T_cw
        return T_cw[..., :3, :3] @ estimate.points_w[:, None] + T_cw[..., :3, 3:]

    def _observations(self, estimate: BundleEstimate) -> ReprojectionData:
        given, params = self.given, estimate.params
        if params.shape[1] > 1:
            params = take_rows(params, given.camera_index)
        camera, scale = self.camera.with_params(params), given.scale[:, None, None]
        return ReprojectionData(given.pixels.mT, given.weights, camera, self.kernel, scale)

    @property
    def _columns(self) -> Tensor:
        """From points and directions to points and parameters, (3 + P, 3 + n)."""
        assert self.directions is not None
        eye = torch.eye(3, dtype=self.directions.dtype, device=self.directions.device)
        return torch.block_diag(eye, self.directions)

    def _linearize(self, estimate: BundleEstimate) -> Linearization:
        """Of every frame and point, (B, K, N, ...)."""
        observations, points_c = self._observations(estimate), self._points_c(estimate)
        lin = linearize(observations, points_c.mT, self.directions is not None)
        return lin if self.directions is None else lin._replace(J=lin.J @ self._columns)

    def _equations(
        self, estimate: BundleEstimate, expansion: Expansion, exact: bool = False, share: Tensor | float = 1.0
    ) -> tuple[DenseEquations, Tensor | float]:
        """The equations with a share of the priors, and the priors' cost (B,)."""
        equations, terms = self._observed(estimate, expansion, exact), self._priors(estimate, exact)
        if terms is None:
            return equations, 0.0
        gradient = torch.cat((terms.frames_gradient.flatten(1), terms.cameras_gradient.flatten(1)), dim=1)
        frames, camera = block_diagonal(terms.frames), block_diagonal(terms.cameras)
        size, more = frames.shape[-1], camera.shape[-1]
        hessian = torch.nn.functional.pad(frames, (0, more, 0, more))
        hessian = hessian + torch.nn.functional.pad(camera, (size, 0, size, 0))
        gradient, reduced = equations.gradient + gradient, equations.reduced + share * hessian
        return equations._replace(gradient=gradient, reduced=reduced), terms.cost

    def _observed(self, estimate: BundleEstimate, expansion: Expansion, exact: bool) -> DenseEquations:
        """The equations of the observations, with the expansion in the points in the camera frames and the n directions
        of the frame's camera: (B, K, 3 + n, N) and (B, K, 3 + n, 3 + n, N)."""
        free, camera_of = self.layout.free, self.given.camera_index
        leading, num_cameras = free.shape[1], estimate.params.shape[1]
        R_wc = estimate.T_cw[..., :3, :3].mT
        rays_w = estimate.points_w[:, None] + R_wc @ estimate.T_cw[..., :3, 3:]
        upper = expansion.hessian[:, :, :3]
        curve = _times(R_wc, R_wc[:, :, None] @ upper[:, :, :, :3])  # (B, K, 3, 3, N): R^T C R
        slope, across = R_wc @ expansion.gradient[:, :, :3], _times(R_wc, upper[:, :, :, 3:])
        points, points_gradient = curve.sum(1), slope.sum(1)
        points_cameras = _sum_by_camera(across, camera_of, num_cameras, over_points=False)

        slope, curve, across, rays_w = (part[:, :leading] for part in (slope, curve, across, rays_w))
        turning = cross_entries(rays_w[..., None, :].unbind(2), curve.unbind(2))
        coupling = torch.stack((*curve.unbind(2), *turning), dim=2)
        gradient, frames, frames_camera = _sum_by_frame(slope, across, coupling, rays_w, exact)
        if exact:
            eye = torch.eye(3, dtype=slope.dtype, device=slope.device)[None, None, ..., None]
            curvature_term = torch.stack(cross_entries(slope[:, :, :, None].unbind(2), eye.unbind(2)), dim=2)
            coupling = coupling - torch.nn.functional.pad(curvature_term, (0, 0, 0, 0, 3, 0))
        if not free.all():  # what only fills up stays where it is
            gradient = torch.where(free[..., None], gradient, 0.0)
            eye = torch.eye(6, dtype=frames.dtype, device=frames.device)
            frames = torch.where(free[..., None, None], frames, eye)
            frames_camera = torch.where(free[..., None, None], frames_camera, 0.0)
            coupling = torch.where(free[..., None, None, None], coupling, 0.0)
        coupling, reduced = coupling.flatten(1, 2), block_diagonal(frames)
        cameras_gradient = _sum_by_camera(expansion.gradient[:, :, 3:], camera_of, num_cameras)
        if self.directions is not None:
            every = torch.arange(num_cameras, device=camera_of.device)
            own = camera_of[:, :leading, None, None, None] == every[:, None]  # (B, K', 1, C, 1)
            frames_cameras = torch.where(own, frames_camera[..., None, :], 0.0).flatten(3).flatten(1, 2)
            cameras = block_diagonal(_sum_by_camera(expansion.hessian[:, :, 3:, 3:], camera_of, num_cameras))
            coupling = torch.cat((coupling, points_cameras.transpose(2, 3).flatten(1, 2)), dim=1)
            rows = (reduced, frames_cameras), (frames_cameras.mT, cameras)
            reduced = torch.cat([torch.cat(row, dim=-1) for row in rows], dim=1)
        gradient = torch.cat((gradient.flatten(1), cameras_gradient.flatten(1)), dim=-1)
        return DenseEquations(gradient, points_gradient, reduced, points, coupling)

    def _priors(self, estimate: BundleEstimate, exact: bool = False) -> PriorTerms | None:
        given, free = self.given, self.layout.free
        if not given.has_priors:
            return None
        leading = free.shape[1]
        if given.pose_prior is not None:
            T_cw, information = given.prior_T_cw[:, :leading], given.prior_information[:, :leading]
            given = given._replace(prior_T_cw=T_cw, prior_information=information)
        T_cw = estimate.T_cw[:, :leading]
        terms = prior_terms(given, T_cw, estimate.params, free, self.directions, exact)
        return terms.in_world(T_cw[..., :3, :3])

    def _split(self, vector: Tensor) -> tuple[Tensor, Tensor]:
        """The parts of (B, D) that are of the free frames (B, K', 6) and of the cameras."""
        leading = self.layout.free.shape[1]
        return vector[:, : 6 * leading].unflatten(1, (leading, 6)), vector[:, 6 * leading :]

    def _factorized(
        self, estimate: BundleEstimate, equations: DenseEquations, damping: Tensor | None = None
    ) -> FactorizedDense:
        """Eliminate the points and factorize what is left, as `NormalEquations.factorized` does."""
        free, reduced = self.layout.free, equations.reduced
        frames = 6 * free.shape[1]
        more = reduced.shape[-1] - frames
        growth = None if damping is None else damping[:, None]
        root = inverse_roots(equations.points, self.layout.free_points, growth)
        rows = lower_times([root[:, None, i, j] for i, j in LOWER_3X3], equations.coupling.unbind(2))
        whitened = torch.stack(rows, dim=2).flatten(2)
        if damping is not None:  # a frame that lost all its observations stays solvable: its step is zero
            growth = damping[:, None] * reduced.diagonal(dim1=-2, dim2=-1)
            growth[:, :frames] += diagonal_floor(growth.dtype)
            reduced = reduced + torch.diag_embed(growth)
        reduced = torch.baddbmm(reduced, whitened, whitened.mT, alpha=-1)
        if (gauge := self._gauge(estimate)) is not None:
            diagonal = reduced.diagonal(dim1=-2, dim2=-1)
            mean = diagonal.mean(-1)
            if not free.all():  # without padding: for each problem the same as for it alone
                is_own = torch.nn.functional.pad(free.repeat_interleave(6, dim=1), (0, more), value=True)
                mean = torch.where(is_own, diagonal, 0.0).sum(-1) / is_own.sum(-1).clamp_min(1)
            c = torch.nn.functional.pad(gauge * mean.sqrt()[:, None, None], (0, 0, 0, more))
            reduced = torch.baddbmm(reduced, c, c.mT)
        return FactorizedDense(root, whitened, factorize(reduced, strict=damping is None))

    def _gauge(self, estimate: BundleEstimate) -> Tensor | None:
        """Gauge directions (B, 6 K', g) along the axes of the world, zero where the gauge is fixed; None if all are."""
        layout = self.layout
        free, anchors = layout.free, layout.anchors.sum(1)
        is_open = (anchors < 2) & ~layout.held_points & free.any(1)
        if not is_open.any():
            return None
        T_free = estimate.T_cw[:, : free.shape[1]]
        first = torch.where(anchors > 0, layout.anchors.int().argmax(1), 0)[:, None]
        similarity = gauge_motions(T_free, se3_inverse(take_rows(estimate.T_cw, first))[..., :3, 3])
        scaling = similarity[..., 0]
        scaling = torch.where((free & is_open[:, None])[..., None], scaling, 0.0)
        length = scaling.square().sum((1, 2), keepdim=True)
        motions = (scaling * torch.where(length > 0, length, 1.0).rsqrt())[..., None]
        adrift = is_open & (anchors == 0) & (free.sum(1) > 1)
        if adrift.any():
            moves = torch.where(free[..., None, None], similarity[..., 1:], 0.0)
            whole = torch.cat((motions, moves), dim=-1).flatten(1, 2)
            eye = torch.eye(*whole.shape[1:], dtype=whole.dtype, device=whole.device)
            whole = torch.linalg.qr(torch.where(adrift[:, None, None], whole, eye)).Q
            rest = torch.where(adrift[:, None, None], whole[..., 1:], 0.0).unflatten(1, (free.shape[1], 6))
            motions = torch.cat((motions, rest), dim=-1)
        with torch.no_grad():
            priors = self._priors(estimate)
            if priors is not None:
                motions = open_motions(motions, stiffness_along(motions, priors.frames))
        return motions.flatten(1, 2)


def _expanded(lin: Linearization, use_curvature: Tensor) -> Expansion:
    """Without the curvature of the projection; use_curvature: (B,)."""
    J = lin.J.movedim((-2, -1), (0, 1))
    gradient, hessian = gauss_newton_expansion(lin, J, use_curvature[:, None, None])
    return Expansion(gradient.movedim(0, 2).contiguous(), hessian.movedim((0, 1), (2, 3)).contiguous())
