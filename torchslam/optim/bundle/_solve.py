"""Bundle adjustment of poses, points and optionally cameras: sparse, robust, batched, differentiable."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchslam.geometry.camera import Camera
from torchslam.geometry.precision import full_precision
from torchslam.optim._core.implicit import Minimization, Ndims, Tensors, find_minimum
from torchslam.optim._core.levenberg_marquardt import (
    BUNDLE_OPTIONS,
    Convergence,
    Outcome,
    Progress,
    SolverOptions,
    check_minimum,
    minimize_batch,
    warned,
)
from torchslam.optim._core.residuals import ReprojectionData, linearize, only
from torchslam.optim._core.tangent import move, pull_back, push, retract
from torchslam.optim.bundle._dense import (
    DenseBundle,
    DenseLayout,
    build_dense_layout,
    dense_data,
    suits_dense,
)
from torchslam.optim.bundle._factors import (
    FactorKind,
    depth_terms,
    factor_kinds,
    factor_slope,
    tensors_of_errors,
)
from torchslam.optim.bundle._problem import (
    BundleData,
    BundleEstimate,
    BundleProblem,
    MovingParts,
    flat_rows,
    frames_are_determined,
    points_with_parallax,
    prior_terms,
    sanitized,
    select_moving,
)
from torchslam.optim.bundle._schur import AT_ONCE, Marginals
from torchslam.optim.bundle._sparse import SparseBundle, SparseLayout, build_sparse_layout, runs_of
from torchslam.utils.indexing import row_numbers

# Frame-point pairs of the dense problems solved at once: they fit the cache of a CPU, or keep a GPU busy.
_MAX_CELLS_CPU, _MAX_CELLS_GPU = 1 << 14, 1 << 20


@dataclass(frozen=True)
class BundleSolution(Outcome):
    """The minimum of a bundle adjustment; for a batch, everything leads with B.

    Attributes:
        T_cw: world to camera.
        camera: the cameras of the problem, with refined parameters where they were free.
        cost: half the sum of robustified squared whitened residuals and priors, detached.
        success: all observing frames start finite, all free unknowns are determined, up to the gauge, and every free
            frame sees three points with a parallax, or has a prior. If False, the estimate is the best one found, but
            it has no gradient.
        moved_frames: False for fixed frames, and for frames with fewer than three points and no prior, which stayed at
            their start; observations of the latter did not count.
        moved_points: False for fixed points, and for points seen by fewer than two frames.
        convergence: iterations and convergence per element of the batch.
    """

    T_cw: Float[Tensor, "*batch K 4 4"]
    points_w: Float[Tensor, "*batch N 3"]
    camera: Camera
    cost: Float[Tensor, "*batch"]
    success: Bool[Tensor, "*batch"]
    moved_frames: Bool[Tensor, "*batch K"]
    moved_points: Bool[Tensor, "*batch N"]
    convergence: Convergence
    _marginals: Callable[[], Marginals] = field(repr=False)

    @cached_property
    def _covariance(self) -> Marginals:
        return self._marginals()

    def covariance(
        self,
        frames: Int[Tensor, " n"] | Sequence[int] | None = None,
        points: Int[Tensor, " m"] | Sequence[int] | None = None,
    ) -> Marginals:
        """Marginal covariances, detached, zero for what did not move; computed on the first call.

        Calibrated by the residuals, so the weights need to be right only up to a factor; priors count as they are.

        Args:
            frames: indices (n,) of frames, all if None.
            points: indices (m,) of points, all if None.

        Returns:
            Frames (n, 6, 6) of the left perturbation (translation, rotation), points (m, 3, 3), and camera (P, P), or
            (C P, C P) of several cameras.
        """

        def some(name: str, rows: Tensor | Sequence[int] | None, of_all: Tensor) -> Tensor:
            if rows is None:
                return of_all
            rows = torch.as_tensor(rows, device=of_all.device)
            return of_all[..., row_numbers(name, rows, of_all.shape[-3]), :, :]

        of_frames, of_points, camera = self._covariance
        return Marginals(some("frames", frames, of_frames), some("points", points, of_points), camera)

    def __getstate__(self) -> dict[str, Any]:
        # The covariances themselves travel, not the problem that they follow from.
        return {**super().__getstate__(), "_covariance": self._covariance, "_marginals": None}

    def element(self, row: int, num_frames: int, num_points: int) -> BundleSolution:
        """One problem of a batch, without the frames and points that came after its own to fill it up."""
        frames, points = slice(num_frames), slice(num_points)

        def marginals() -> Marginals:
            of_all = self._covariance
            blocks = of_all.frames[row, frames], of_all.points[row, points], of_all.camera[row]
            return Marginals(*blocks)

        return BundleSolution(
            self.T_cw[row, frames],
            self.points_w[row, points],
            self.camera[row],
            self.cost[row],
            self.success[row],
            self.moved_frames[row, frames],
            self.moved_points[row, points],
            self.convergence.of(row),
            marginals,
        )


@full_precision
def solve_bundle(
    problem: BundleProblem,
    *,
    free_camera: bool | Float[Tensor, "P n"] = False,
    options: SolverOptions = BUNDLE_OPTIONS,
    progress: Progress | None = None,
    check: bool = True,
    near: bool = False,
) -> BundleSolution:
    """Minimize robust reprojection errors over poses, points and, if `free_camera`, the cameras' parameters.

    Observations that are not finite, or of points behind the camera, do not count. The implicit gradient is zero where
    the exact Hessian is not positive definite; a point whose own block is not positive definite counts as fixed, and
    one without parallax, whose depth nothing determines, has none. With an open gauge the gradient is right for losses
    that do not depend on it.

    A batch gives what its problems alone would give, by dense algebra over many of them at once. Where a frame sees
    less than an eighth of the points, or one of them twice, they are solved one after the other.

    Args:
        problem: one bundle adjustment, or a batch.
        free_camera: True frees all P parameters of every camera. A tensor (P, n) frees steps along its n columns, of
            which the covariances then are. Every problem of a batch finds its own parameters.
        options: how to minimize; gradients reach pixels, weights, camera.params (unless free), scale, priors, fixed
            poses and fixed points, depths and what factors measure, with their information, and the tensors that
            errors of factors close over. Nothing flows to the start of free unknowns.
        progress: called before each iteration with its number and the maximum; its exceptions end the minimization.
        check: test whether all that moves is determined. Without, `success` is that of the start; saves a tenth.
        near: end with Newton's steps, with the kernel's whole curvature, as problems with factors do: from a start
            near the minimum two to five times fewer. Batches on grids, and searches without gradients, do without.

    Returns:
        The minimum, differentiable, with covariances on demand.

    Raises:
        ValueError: a shape or an index does not fit, or a name is unknown.
        ConvergenceError: with `options.strict`.
    """
    given = sanitized(problem, options.scale)
    matrices, kinds = given.weights.ndim > 2, factor_kinds(problem.factors)
    minimization = BundleMinimization(
        problem.camera, free_camera, options, progress, check, matrices, kinds, near
    )
    closed_over = tensors_of_errors(problem.factors, given.T_cw, given.points_w, given.params)
    found = BundleMinimum(*find_minimum(minimization, given, options.backward, closed_over))
    if options.strict:
        check_minimum(found.success, found.converged, "bundle adjustments")
    detached = [x.detach() for x in given]
    solution = found.estimate
    if options.backward == "implicit":
        points_w = torch.where(found.with_depth[..., None], found.points_w, found.points_w.detach())
        solution = minimization.at_minimum(found._replace(points_w=points_w), given)
    if options.backward == "truncated":
        solution = minimization.last_step(found, given)
    params = solution.params if problem.camera_index is not None else solution.params[:, 0]

    def marginals() -> Marginals:
        of_all = minimization.marginals(found, detached)
        return of_all if problem.is_batch else Marginals(*(blocks[0] for blocks in of_all))

    row = slice(None) if problem.is_batch else 0
    convergence = Convergence(*found[-4:], limit=options.iterations)
    T_cw, points_w, params = (
        warned(x, found.success, convergence, "bundle adjustments")
        for x in (solution.T_cw, solution.points_w, params)
    )
    return BundleSolution(
        T_cw[row],
        points_w[row],
        problem.camera.with_params(params[row]),
        found.cost[row],
        found.success[row],
        found.moved_frames[row],
        found.moved_points[row],
        convergence,
        marginals,
    )


class BundleMinimum(NamedTuple):
    """Estimates, what moved, counted observations (B, O), the moved points that have a depth, and convergence."""

    T_cw: Tensor
    points_w: Tensor
    params: Tensor
    success: Tensor
    moved_frames: Tensor
    moved_points: Tensor
    used: Tensor
    with_depth: Tensor
    iterations: Tensor
    converged: Tensor
    initial_cost: Tensor
    cost: Tensor

    @property
    def estimate(self) -> BundleEstimate:
        return BundleEstimate(self.T_cw, self.points_w, self.params)


class BatchPart(NamedTuple):
    """Elements that are solved together, and their layout: sparse for one problem, dense for several."""

    rows: slice
    layout: SparseLayout | DenseLayout


class BundleMinimization(Minimization):
    """Bundle adjustments of inputs `BundleData`.

    Vectors are frames (B, K, 6), points (B, N, 3) and cameras (B, C n): along the directions (P, n) in which each may
    move, none where they are fixed.
    """

    num_unknowns = 3
    num_vectors = 3

    def __init__(
        self,
        camera: Camera,
        free_camera: bool | Tensor,
        options: SolverOptions,
        progress: Progress | None = None,
        check: bool = True,
        matrices: bool = False,
        kinds: Sequence[FactorKind] = (),
        near: bool = False,
    ) -> None:
        """matrices: whether weights are inverse covariances; kinds: of factors; near: as of `solve_bundle`"""
        self.ndims: tuple[Ndims, Ndims, Ndims] = (
            (2, 2, 1),
            (3, 2, 2, 0, 1, 1, 1, 1, 0, 0, 0, 0),
            (3, 2, 2, 3 if matrices else 1, 2, 0, 3, 3, 2, 3, 1, 1, 1, 1, 1, 0, 1, 1, 1, 1, 1),
        )
        self.camera, self.free_camera = camera, free_camera
        self.options, self.progress = options, progress
        self.check, self.kinds = check, kinds
        self.has_newton = options.backward == "implicit" and (near or len(kinds) > 0)
        self._last: tuple[Tensor, MovingParts, list[BatchPart]] | None = None

    def minimize(self, inputs: Tensors) -> BundleMinimum:
        given = BundleData(*inputs)
        moving, parts = self._laid_out(given)
        return BundleMinimum(*_concatenated([self._minimize(given, moving, part) for part in parts]))

    def _minimize(self, given: BundleData, moving: MovingParts, part: BatchPart) -> BundleMinimum:
        bundle, moving = self._bundle(given, part), MovingParts(*(mask[part.rows] for mask in moving))
        iterations, tolerance, report = self.options.iterations, self.options.tolerance, self.progress
        # As if one element came after the other.
        before, batch = iterations * part.rows.start, len(given.T_cw)
        progress = None if report is None else lambda now, most: report(before + now, most * batch)
        model, convergence = minimize_batch(bundle, bundle.start, iterations, tolerance, progress)
        estimate: BundleEstimate = bundle.in_order(model.estimate)
        with torch.no_grad():
            success = bundle.solvable & given.finite[part.rows]
            with_parallax = moving.points
            if self.check:
                success = success & bundle.definite(model)
                of_part = given.part(part.rows)
                with_parallax = points_with_parallax(of_part, moving.counted, estimate)
                success = success & frames_are_determined(of_part, moving, with_parallax, self.kinds)
        return BundleMinimum(
            *estimate,
            success,
            moving.frames,
            moving.points,
            moving.counted,
            moving.points & with_parallax,
            *convergence.tensors,
        )

    def factorized(self, found: Tensors, inputs: Tensors) -> Callable[[Tensors], Tensors]:
        found, given = BundleMinimum(*found), BundleData(*inputs)
        with torch.no_grad():
            solvers = [
                (part.rows, bundle.exact_solver(_part(found.estimate, part)))
                for part, bundle in self.formulations(given)
            ]

        def solve(right: Tensors) -> Tensors:
            solved = _concatenated([solver(tuple(x[rows] for x in right)) for rows, solver in solvers])
            success = found.success[:, None]
            return tuple(torch.where(success if x.ndim == 2 else success[..., None], x, 0.0) for x in solved)

        return solve

    def slope(self, found: Tensors, inputs: Tensors, direction: Tensors) -> Tensor:
        found, given = BundleMinimum(*found), BundleData(*inputs)
        return self._slope(found, given, direction, slice(None))

    def slopes(self, found: Tensors, inputs: Tensors, direction: Tensors) -> Iterator[Tensor]:
        found, given = BundleMinimum(*found), BundleData(*inputs)
        for run in runs_of(given.counted.numel(), AT_ONCE):
            yield self._slope(found, given, direction, run)

    def _slope(self, found: BundleMinimum, given: BundleData, direction: Tensors, run: slice) -> Tensor:
        """The part of the slope of some observations; with the first ones that of factors and priors."""
        slope = self._slope_of_observations(found, given, direction, run)
        if run.start:
            return slope
        (frames, points, camera), at = direction, self.at_minimum(found, given)
        if self.kinds:
            moved = found.moved_frames[..., None], found.moved_points[..., None]
            of_frames, of_points = (
                torch.where(mask, part, 0.0) for mask, part in zip(moved, (frames, points), strict=True)
            )
            step = of_frames, of_points, self._along(camera, at.params)
            slope = slope + factor_slope(self.kinds, at, given.measured, given.factor_information, step)
        if not given.has_priors:
            return slope
        directions = self._directions(at.params)
        priors = prior_terms(given, at.T_cw, at.params, found.moved_frames, directions, exact=False)
        slope = slope + (priors.frames_gradient * frames).sum()
        return slope + (priors.cameras_gradient.flatten(1) * camera).sum()

    def _slope_of_observations(
        self, found: BundleMinimum, given: BundleData, direction: Tensors, run: slice
    ) -> Tensor:
        frames, points, camera = direction
        at = self.at_minimum(found, given)
        in_frames = flat_rows(given.frame_index, given.T_cw.shape[1])[run]
        in_points = flat_rows(given.point_index, given.points_w.shape[1])[run]
        T_cw = at.T_cw.flatten(0, 1).index_select(0, in_frames)
        seen = at.points_w.flatten(0, 1).index_select(0, in_points)[..., None]
        points_c = (T_cw[:, :3, :3] @ seen).squeeze(-1) + T_cw[:, :3, 3]
        cameras, in_cameras = self.camera.with_params(at.params.flatten(0, 1)), None
        if len(cameras.params) > 1:
            in_cameras = flat_rows(given.camera_of, at.params.shape[1])[run]
        observed = ReprojectionData(
            given.pixels.flatten(0, 1)[run],
            only(found.used, given.weights).flatten(0, 1)[run],
            cameras[0 if in_cameras is None else in_cameras],
            self.options.kernel,
            given.scale[:, None].expand_as(given.counted).flatten()[run],
        )
        is_free = self.free_camera is not False
        lin = linearize(observed, points_c, is_free)
        velocity = move(points_c, frames.flatten(0, 1).index_select(0, in_frames))
        moving = points.flatten(0, 1).index_select(0, in_points)[..., None]
        velocity = velocity + (T_cw[:, :3, :3] @ moving).squeeze(-1)
        if is_free:
            turning = self._along(camera, at.params).flatten(0, 1)
            turning = turning.expand(len(velocity), -1) if in_cameras is None else turning[in_cameras]
            velocity = torch.cat((velocity, turning), dim=-1)
        slope = (lin.gradient_wrt_residual[:, None, :] @ lin.J @ velocity[..., None]).sum()
        if given.depths.shape[1]:
            counted = torch.where(found.used, given.depth_information, 0.0).flatten()[run]
            terms = depth_terms(given.depths.flatten()[run], counted, points_c[:, 2], exact=False)
            slope = slope + (terms.slope * velocity[:, 2]).sum()
        return slope

    def retracted(self, found: Tensors, direction: Tensors) -> Tensors:
        frames, points, camera = direction
        T_cw, points_w, params, *rest = found
        params = params + self._along(camera, params)
        return retract(T_cw, frames), points_w + points, params, *rest

    def push(self, found: Tensors, direction: Tensors) -> Tensors:
        frames, points, camera = direction
        return push(found[0], frames), points, self._along(camera, found[2])

    def pull_back(self, found: Tensors, gradient: Tensors) -> Tensors:
        frames, points, params = gradient
        directions = self._directions(params)
        camera = params[..., :0] if directions is None else params @ directions
        return pull_back(found[0], frames), points, camera.flatten(1)

    def _directions(self, params: Tensor) -> Tensor | None:
        """Directions (P, n) along which parameters (..., P) may move; None where they do not."""
        if isinstance(self.free_camera, Tensor):
            return self.free_camera
        size = params.shape[-1]
        return torch.eye(size, dtype=params.dtype, device=params.device) if self.free_camera else None

    def _along(self, step: Tensor, params: Tensor) -> Tensor:
        """How a step (B, C n) changes the cameras' parameters (B, C, P)."""
        directions = self._directions(params)
        if directions is None:
            return torch.zeros_like(params)
        return step.unflatten(1, (params.shape[1], directions.shape[1])) @ directions.mT

    def at_minimum(self, found: BundleMinimum, given: BundleData) -> BundleEstimate:
        """The minima where things moved, the inputs, with their derivatives, where they did not."""
        params = given.params if self.free_camera is False else found.params
        if isinstance(
            self.free_camera, Tensor
        ):  # what does not move of the parameters reaches them unchanged
            params = params + (given.params - given.params.detach())
        return BundleEstimate(
            torch.where(found.moved_frames[..., None, None], found.T_cw, given.T_cw),
            torch.where(found.moved_points[..., None], found.points_w, given.points_w),
            params,
        )

    def last_step(self, found: BundleMinimum, inputs: Tensors) -> BundleEstimate:
        """The estimates after one more step from the minima, with the gradient of that step."""
        given = BundleData(*inputs)
        at, steps = self.at_minimum(found, given), []
        for part, bundle in self.formulations(given):
            model = bundle.evaluate(bundle.ordered(_part(at, part)), ~bundle.solvable)
            solution, _ = bundle.step(model, torch.zeros_like(model.cost))
            steps.append(bundle.in_order(solution))
        return BundleEstimate(*_concatenated(steps))

    def marginals(self, found: BundleMinimum, inputs: Sequence[Tensor]) -> Marginals:
        with torch.no_grad():
            bundles = self.formulations(BundleData(*inputs))
            parts = [bundle.marginals(_part(found.estimate, part)) for part, bundle in bundles]
            return Marginals(*_concatenated(parts))

    def formulations(self, given: BundleData) -> list[tuple[BatchPart, Any]]:
        """The parts of a batch and the solver of each, a `DenseBundle` or a `SparseBundle`."""
        return [(part, self._bundle(given, part)) for part in self._laid_out(given)[1]]

    def _bundle(self, given: BundleData, part: BatchPart) -> Any:
        given, layout, kernel = given.part(part.rows), part.layout, self.options.kernel
        directions = self._directions(given.params)
        concludes = self.options.backward == "implicit"
        if isinstance(layout, DenseLayout):
            data = dense_data(layout, given)
            return DenseBundle(layout, data, self.camera, kernel, directions, concludes)
        own, newton = given.part(0), self.has_newton
        return SparseBundle(layout, own, self.camera, kernel, directions, self.kinds, newton, concludes)

    def _laid_out(self, given: BundleData) -> tuple[MovingParts, list[BatchPart]]:
        """The layouts for the observations that count; the last ones are kept, which mostly are the next ones."""
        if self._last is None or not torch.equal(self._last[0], given.counted):
            moving = select_moving(given, self.kinds)
            self._last = (
                given.counted,
                moving,
                _parts(given, moving, self.kinds, self.free_camera is not False),
            )
        return self._last[1:]


def _parts(
    given: BundleData, moving: MovingParts, kinds: Sequence[FactorKind] = (), free_camera: bool = True
) -> list[BatchPart]:
    """Split a batch into parts: dense, as many problems at once as fit, or sparse, one at a time."""
    batch = len(given.T_cw)
    use_dense = suits_dense(given, moving)
    size = 1
    if use_dense:
        cells = _MAX_CELLS_CPU if given.T_cw.device.type == "cpu" else _MAX_CELLS_GPU
        size = max(1, cells // (moving.frames.shape[1] * moving.points.shape[1]))
    joined = torch.cat([kind.pairs for kind in kinds]) if kinds else None
    parts = []
    for start in range(0, batch, size):
        rows = slice(start, min(start + size, batch))
        of_part = MovingParts(*(mask[rows] for mask in moving))
        if use_dense:
            parts.append(BatchPart(rows, build_dense_layout(given.part(rows), of_part)))
            continue
        of_one = MovingParts(*(mask[0] for mask in of_part))
        parts.append(BatchPart(rows, build_sparse_layout(given.part(start), of_one, joined, free_camera)))
    return parts


def _part(estimate: BundleEstimate, part: BatchPart) -> BundleEstimate:
    return BundleEstimate(*(tensor[part.rows] for tensor in estimate))


def _concatenated(parts: Sequence[Tensors]) -> Tensors:
    """Parts of a batch, one after the other."""
    return parts[0] if len(parts) == 1 else tuple(torch.cat(tensors) for tensors in zip(*parts, strict=True))
