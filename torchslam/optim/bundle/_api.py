"""Bundle adjustment of poses, points and optionally cameras: sparse, robust, batched, differentiable."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchslam.geometry.camera import Camera
from torchslam.geometry.precision import full_precision
from torchslam.optim._core.implicit import find_minimum
from torchslam.optim._core.levenberg_marquardt import (
    BUNDLE_OPTIONS,
    Convergence,
    Outcome,
    Progress,
    SolverOptions,
    check_minimum,
)
from torchslam.optim.bundle._factors import factor_kinds
from torchslam.optim.bundle._minimization import BundleMinimization, BundleMinimum
from torchslam.optim.bundle._problem import BundleProblem, sanitized
from torchslam.optim.bundle._schur import Marginals
from torchslam.utils.indexing import row_numbers

__all__ = ["BundleProblem", "BundleSolution", "solve_bundle"]


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
        marginals = self._covariance

        def some(name: str, rows: Tensor | Sequence[int] | None, of_all: Tensor) -> Tensor:
            if rows is None:
                return of_all
            rows = torch.as_tensor(rows, device=of_all.device)
            return of_all[..., row_numbers(name, rows, of_all.shape[-3]), :, :]

        return Marginals(
            some("frames", frames, marginals.frames),
            some("points", points, marginals.points),
            marginals.camera,
        )

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
            poses and fixed points, and depths and what factors measure, with their information. Nothing flows to the
            start of free unknowns.
        progress: called before each iteration with its number and the maximum; its exceptions end the minimization.
        check: test whether all that moves is determined. Without, `success` is that of the start; saves a tenth.

    Returns:
        The minimum, differentiable, with covariances on demand.

    Raises:
        ValueError: a shape or an index does not fit, or a name is unknown.
        ConvergenceError: with `options.strict`.
    """
    given = sanitized(problem, options.scale)
    matrices, kinds = given.weights.ndim > 2, factor_kinds(problem.frame_factors)
    minimization = BundleMinimization(problem.camera, free_camera, options, progress, check, matrices, kinds)
    found = BundleMinimum(*find_minimum(minimization, given, options.backward))
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
    return BundleSolution(
        solution.T_cw[row],
        solution.points_w[row],
        problem.camera.with_params(params[row]),
        found.cost[row],
        found.success[row],
        found.moved_frames[row],
        found.moved_points[row],
        Convergence(*found[-4:], limit=options.iterations),
        marginals,
    )
