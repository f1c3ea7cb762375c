"""Bundle adjustment: poses, points and, where wanted, the camera; sparse, robust, differentiable."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import torch
from torch import Tensor

from torchslam.geometry.camera import Camera
from torchslam.geometry.precision import check_dtypes, full_precision
from torchslam.solvers.bundle_minimization import BundleMinimization, Found, Given
from torchslam.solvers.bundle_model import Inputs
from torchslam.solvers.implicit import Backward, check_backward, minimum
from torchslam.solvers.levenberg import Convergence, Progress
from torchslam.solvers.residuals import usable
from torchslam.solvers.robust import Kernel
from torchslam.solvers.schur import Marginals


@dataclass(frozen=True)
class BundleProblem:
    """Who saw what where: O observations of P points by F frames.

    T_cw:         (F, 4, 4) start, world to camera
    points_w:     (P, 3) start
    frame_index:  (O,) int64 rows of T_cw; point_index: (O,) int64 rows of points_w
    pixels:       (O, 2)
    camera:       one for all frames, params (K,)
    weights:      (O,) inverse variances in px^-2, one if None
    fixed_frames: rows of T_cw, or an (F,) bool mask, that stay as they are. One frame fixes all but the scale, which
                  then is that of the start; with none the answer keeps the position and the orientation, too.
                  Whatever more is fixed constrains the shape.
    fixed_points: rows of points_w, or a (P,) bool mask, likewise
    """

    T_cw: Tensor
    points_w: Tensor
    frame_index: Tensor
    point_index: Tensor
    pixels: Tensor
    camera: Camera
    weights: Tensor | None = None
    fixed_frames: Tensor | Sequence[int] = (0,)
    fixed_points: Tensor | Sequence[int] | None = None


@dataclass(frozen=True)
class BundleSolution:
    """The minimum of a bundle adjustment.

    T_cw:       (F, 4, 4); points_w: (P, 3); camera
    cost:       () half the sum of robustified squared whitened residuals, detached
    success:    () bool, all frames start finite, and all that moves is determined, up to the gauge. If not, the
                estimate is still the best that was found, but it has no gradient.
    moved_frames, moved_points: (F,), (P,) bool. What is fixed, or seen too little (points by two frames, frames with
                three points at least), stayed at its start; in the latter case its observations did not count.
    convergence: of the one element
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
        """Marginal covariances, detached, of the frames and points asked for (all if None) and of the camera.

        Frames (n, 6, 6) of the left perturbation (translation, rotation), points (m, 3, 3), camera (K, K), zero for
        what did not move. Calibrated by the residuals, so the weights need to be right only up to a factor. Computed
        on the first call.
        """
        marginals = self._covariance
        rows = [
            slice(None) if r is None else torch.as_tensor(r, device=self.T_cw.device)
            for r in (frames, points)
        ]
        return Marginals(marginals.frames[rows[0]], marginals.points[rows[1]], marginals.camera)


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
    """Minimise robust reprojection errors over poses, points and, if `free_camera`, the camera's parameters.

    free_camera: True: all K of them; a tensor (K, n): along its n columns alone, and covariances are of the steps
              along these
    scale:    of the kernel, in units of the whitened residual: a number or a scalar tensor
    backward: how gradients reach pixels, weights, camera.params (unless free), scale, fixed poses and fixed points, see
              `implicit.Backward`. The gradient ends at the start values of what moves.
    tolerance: stop where a step promises to lower the cost by less than this share of it
    progress: called with the number of each iteration and the most there are; what it raises is raised here
    check:    find out whether all that moves is determined; else `success` is for the start alone, a tenth is saved

    Observations that are not finite, or of points behind the camera, do not count. Where the exact Hessian is not
    positive definite, that is, not at a strict minimum, the implicit gradient is zero; a point for which its own block
    is not counts as fixed. With an open gauge the gradient is right for losses that do not depend on it.
    Raises ValueError for shapes and indices that do not fit and for unknown names.
    """
    check_backward(backward)
    counted, finite_frames, inputs = _sanitized(problem, scale)
    free_frames = ~_as_mask(problem.fixed_frames, len(problem.T_cw), problem.T_cw.device)
    free_points = ~_as_mask(problem.fixed_points, len(problem.points_w), problem.T_cw.device)
    minimization = BundleMinimization(
        problem.camera, kernel, free_camera, iterations, tolerance, progress, check
    )
    indices = problem.frame_index, problem.point_index
    tensors = Given(*inputs, counted, finite_frames, *indices, free_frames, free_points)
    if backward == "unroll":
        found = Found(*minimization.minimize(tensors))
    else:
        attached = backward == "implicit"
        found = Found(*minimum(minimization, tensors if attached else [x.detach() for x in tensors]))
    detached = [x.detach() for x in tensors]
    solution = minimization.at_minimum(found, tensors) if backward == "implicit" else found.estimate
    if backward == "truncated":
        solution = minimization.last_step(found, tensors)
    return BundleSolution(
        solution.T_cw,
        solution.points_w,
        problem.camera.with_params(solution.params),
        found.cost,
        found.success,
        found.moved_frames,
        found.moved_points,
        Convergence(found.iterations, found.converged, found.initial_cost, found.cost[None]),
        lambda: minimization.marginals(found, detached),
    )


def _sanitized(problem: BundleProblem, scale: Tensor | float) -> tuple[Tensor, Tensor, Inputs]:
    """Which observations count, which frames are finite, and the tensors with zero or the identity for what is not."""
    T_cw, points_w, pixels, like = problem.T_cw, problem.points_w, problem.pixels, problem.T_cw
    if T_cw.shape[1:] != (4, 4) or points_w.shape[1:] != (3,) or pixels.shape[1:] != (2,):
        raise ValueError(
            "T_cw, points_w and pixels must be (F, 4, 4), (P, 3) and (O, 2), not "
            f"{tuple(T_cw.shape)}, {tuple(points_w.shape)} and {tuple(pixels.shape)}"
        )
    for name, index, size in (
        ("frame_index", problem.frame_index, len(T_cw)),
        ("point_index", problem.point_index, len(points_w)),
    ):
        if index.shape != pixels.shape[:1]:
            raise ValueError(
                f"{name} must have one row per observation, {len(pixels)}, not {tuple(index.shape)}"
            )
        if len(index) and not 0 <= int(index.min()) <= int(index.max()) < size:
            raise ValueError(f"{name} must lie in 0 ... {size - 1}")
    weights = torch.ones_like(pixels[:, 0]) if problem.weights is None else problem.weights
    if weights.shape != pixels.shape[:1]:
        raise ValueError(f"weights must be (O,) = ({len(pixels)},), not {tuple(weights.shape)}")
    check_dtypes(
        T_cw=T_cw, points_w=points_w, pixels=pixels, weights=weights, camera_params=problem.camera.params
    )
    finite_frames = torch.isfinite(T_cw).flatten(1).all(-1)
    counted = usable(pixels, points_w[problem.point_index], weights) & finite_frames[problem.frame_index]
    eye = torch.eye(4, dtype=like.dtype, device=like.device)
    return (
        counted,
        finite_frames,
        Inputs(
            torch.where(finite_frames[:, None, None], T_cw, eye),
            torch.where(torch.isfinite(points_w), points_w, 0.0),
            torch.where(counted[:, None], pixels, 0.0),
            torch.where(counted, weights, 0.0),
            problem.camera.params,
            torch.as_tensor(scale, dtype=like.dtype, device=like.device),
        ),
    )


def _as_mask(rows: Tensor | Sequence[int] | None, count: int, device: torch.device) -> Tensor:
    """A bool mask (count,) of rows given as one, or as indices."""
    rows = torch.as_tensor(() if rows is None else rows, device=device)
    if rows.dtype == torch.bool:
        if rows.shape != (count,):
            raise ValueError(f"a mask of fixed rows must have shape ({count},), not {tuple(rows.shape)}")
        return rows
    mask = torch.zeros(count, dtype=torch.bool, device=device)
    mask[rows.long()] = True
    return mask
