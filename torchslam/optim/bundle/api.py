"""Bundle adjustment: poses, points and, where wanted, the cameras; sparse, robust, batched, differentiable."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import torch
from torch import Tensor

from torchslam.geometry.camera import Camera
from torchslam.geometry.precision import full_precision
from torchslam.geometry.robust import Kernel
from torchslam.optim.bundle._minimization import BundleMinimization, Found
from torchslam.optim.bundle._problem import BundleProblem, sanitized
from torchslam.optim.bundle._schur import Marginals
from torchslam.optim.core.implicit import Backward, check_backward, minimum
from torchslam.optim.core.levenberg_marquardt import Convergence, Progress

__all__ = ["BundleProblem", "BundleSolution", "bundle_adjust"]


@dataclass(frozen=True)
class BundleSolution:
    """The minimum of a bundle adjustment; of a batch, everything leads with B.

    T_cw:       (F, 4, 4); points_w: (P, 3)
    camera:     one or many, as the problem had them, with other parameters where they were free
    cost:       () half the sum of robustified squared whitened residuals, and priors of what moves, detached
    success:    () bool, all frames that anything counts of start finite, and all that moves is determined, up to the
                gauge. If not, the estimate is still the best that was found, but it has no gradient.
    moved_frames, moved_points: (F,), (P,) bool. What is fixed, or seen too little (points by two frames, frames with
                three points at least, or a prior), stayed at its start; in the latter case its observations did not
                count.
    convergence: per element of the batch, which a problem alone has one of
    """

    T_cw: Tensor
    points_w: Tensor
    camera: Camera
    cost: Tensor
    success: Tensor
    moved_frames: Tensor
    moved_points: Tensor
    convergence: Convergence
    _marginals: Callable[[], Marginals] = field(repr=False)

    @cached_property
    def _covariance(self) -> Marginals:
        return self._marginals()

    def covariance(
        self, frames: Tensor | Sequence[int] | None = None, points: Tensor | Sequence[int] | None = None
    ) -> Marginals:
        """Marginal covariances, detached, of the frames and points asked for (all if None) and of the cameras.

        Frames (n, 6, 6) of the left perturbation (translation, rotation), points (m, 3, 3), camera (K, K), one after
        the other where there are several, zero for what did not move. Calibrated by the residuals, so the weights need
        to be right only up to a factor; priors count as they are. Computed on the first call.
        """
        marginals = self._covariance
        rows = [
            slice(None) if r is None else torch.as_tensor(r, device=self.T_cw.device)
            for r in (frames, points)
        ]
        return Marginals(
            marginals.frames[..., rows[0], :, :], marginals.points[..., rows[1], :, :], marginals.camera
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
def bundle_adjust(
    problem: BundleProblem,
    kernel: Kernel = "huber",
    scale: Tensor | float = 1.0,
    free_camera: bool | Tensor = False,
    backward: Backward = "implicit",
    iterations: int = 20,
    tolerance: float = 1e-8,
    progress: Progress | None = None,
    check: bool = True,
) -> BundleSolution:
    """Minimise robust reprojection errors over poses, points and, if `free_camera`, the cameras' parameters.

    free_camera: True: all K of every camera; a tensor (K, n): along its n columns alone, and covariances are of the
              steps along these. Every problem of a batch finds its own.
    scale:    of the kernel, in units of the whitened residual: a number, a scalar tensor or (B,)
    backward: how gradients reach pixels, weights, camera.params (unless free), scale, priors, fixed poses and fixed
              points, see `implicit.Backward`. The gradient ends at the start values of what moves.
    tolerance: stop where a step promises to lower the cost by less than this share of it
    progress: called with the number of each iteration and the most there are; what it raises is raised here
    check:    find out whether all that moves is determined; else `success` is for the start alone, a tenth is saved

    Observations that are not finite, or of points behind the camera, do not count. Where the exact Hessian is not
    positive definite, that is, not at a strict minimum, the implicit gradient is zero; a point for which its own block
    is not counts as fixed. With an open gauge the gradient is right for losses that do not depend on it.
    A batch gives what its problems alone would give, by dense algebra over many of them at once; where a frame sees
    less than an eighth of the points, or one of them twice, they are solved one after the other.
    Raises ValueError for shapes and indices that do not fit and for unknown names.
    """
    check_backward(backward)
    given = sanitized(problem, scale)
    minimization = BundleMinimization(
        problem.camera, kernel, free_camera, iterations, tolerance, progress, check, given.weights.ndim > 2
    )
    if backward == "unroll":
        found = minimization.minimize(given)
    else:
        attached = backward == "implicit"
        found = Found(*minimum(minimization, given if attached else [x.detach() for x in given]))
    detached = [x.detach() for x in given]
    solution = minimization.at_minimum(found, given) if backward == "implicit" else found.estimate
    if backward == "truncated":
        solution = minimization.last_step(found, given)
    params = solution.params if problem.camera_index is not None else solution.params[:, 0]
    convergence = Convergence(found.iterations, found.converged, found.initial_cost, found.cost)

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
        convergence,
        marginals,
    )
