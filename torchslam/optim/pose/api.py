"""Refinement of camera poses against known points: batched, robust, differentiable."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import torch
from torch import Tensor

from torchslam.geometry.camera import Camera
from torchslam.geometry.precision import full_precision
from torchslam.geometry.robust import Kernel
from torchslam.optim.core.implicit import Backward, check_backward, minimum
from torchslam.optim.core.levenberg_marquardt import Convergence
from torchslam.optim.core.priors import PosePrior
from torchslam.optim.pose.problem import PoseInputs, PoseMinimization, PoseProblem


@dataclass(frozen=True)
class RefinedPose:
    """Poses at the minimum of their robust reprojection error.

    T_cw:        (B, 4, 4) world to camera; the start, without gradient, where `success` is False
    cost:        (B,) half the sum of robustified squared whitened residuals, detached
    success:     (B,) bool, the start is finite, and the usable points (at least three) or the prior determine the pose
    convergence: iterations and convergence per element
    """

    T_cw: Tensor
    cost: Tensor
    success: Tensor
    convergence: Convergence
    _inputs: PoseInputs = field(repr=False)

    @cached_property
    def covariance(self) -> Tensor:
        """(B, 6, 6) of the left perturbation (translation, rotation), detached; zero where `success` is False.

        Calibrated by the residuals themselves, so the weights need to be right only up to a factor.
        """
        with torch.no_grad():
            covariance = PoseProblem(self._inputs).covariance(self.T_cw)
            return torch.where(self.success[:, None, None], covariance, 0.0)


@full_precision
def refine_pose(
    T_cw: Tensor,
    points_w: Tensor,
    pixels: Tensor,
    camera: Camera,
    weights: Tensor | None = None,
    mask: Tensor | None = None,
    kernel: Kernel = "cauchy",
    scale: Tensor | float = 1.0,
    prior: PosePrior | None = None,
    backward: Backward = "implicit",
    iterations: int = 20,
    tolerance: float = 1e-10,
) -> RefinedPose:
    """Minimise robust reprojection errors over poses by Levenberg-Marquardt, many problems at once.

    T_cw:      (B, 4, 4) start
    points_w:  (B, N, 3), pixels: (B, N, 2); points or pixels of a batch of one broadcast
    weights:   (B, N) inverse variances in px^-2, or (B, N, 2, 2) inverse covariances, which count where they are
               positive definite; one if None
    mask:      (B, N) bool, all if None; rows that are not finite are left out in any case
    scale:     of the kernel, in units of the whitened residual: a number, a scalar tensor or (B,)
    prior:     a Gaussian on the poses, in the same units
    backward:  how gradients reach points, pixels, weights, camera.params, scale and prior, see `implicit.Backward`
    tolerance: stop where a step promises to lower the cost by less than this share of it

    An element that fails (too few points, pose not determined) has `success` False and a zero gradient. The implicit
    gradient is zero as well where the exact Hessian is not positive definite, that is, not at a strict minimum.
    Raises ValueError for shapes that do not fit and for unknown names.
    """
    check_backward(backward)
    inputs = PoseInputs.sanitized(T_cw, points_w, pixels, camera, weights, mask, kernel, scale, prior)
    minimization = PoseMinimization(inputs, iterations, tolerance)
    tensors = (T_cw, *inputs.tensors())
    if backward == "unroll":
        found = minimization.minimize(tensors)
    else:
        attached = backward == "implicit"
        found = minimum(minimization, tensors if attached else [tensor.detach() for tensor in tensors])
    refined, success, cost, steps, converged, initial_cost = found
    if backward == "truncated":
        problem = PoseProblem(inputs)
        last, _ = problem.step(problem.evaluate(refined, ~success), torch.zeros_like(cost))
        refined = torch.where(success[:, None, None], last, refined)
    return RefinedPose(refined, cost, success, Convergence(steps, converged, initial_cost, cost), inputs)
