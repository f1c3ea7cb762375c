"""The pose of one frame against known points by NumPy, for every frame of a run; `solve_pose` is the general solver.

Errors are taken in undistorted coordinates and multiplied with the slope of the distortion at the keypoint, which makes
them pixels to first order, so no iteration evaluates the distortion. Gross outliers must be removed before. The NumPy
backend has no gradients (`optim._core.numpy_backend`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.geometry import UndistortedKeypoints
from torchslam.optim._core.numpy_backend import (
    MIN_DEPTH,
    Array,
    RobustKernel,
    cauchy,
    huber,
    is_definite,
    minimize_model,
    retract_pose,
    to_numpy,
    variance_factor,
)

SCALE = 2.0
"""Scale of the kernels, in units of the noise."""
MIN_AGREEING = 0.75
"""Fraction of the matches that must agree in `nearby_pose`: another pose with as many would share at least half."""


@dataclass(frozen=True)
class PoseLinearization:
    """The unweighted errors of a frame's points at a pose.

    Attributes:
        pose: world to camera
        rows: derivatives of the whitened errors in the left perturbation of the pose, then the errors
        like: type and device of the tensors that properties return
    """

    pose: Float[np.ndarray, "3 4"]
    rows: Float[np.ndarray, "7 2 N"]
    squares: Float[np.ndarray, " N"]
    z: Float[np.ndarray, " N"]
    like: Tensor

    @property
    def T_cw(self) -> Float[Tensor, "4 4"]:
        """World to camera."""
        return self._tensor(np.concatenate((self.pose, ((0.0, 0.0, 0.0, 1.0),))))

    @property
    def squared(self) -> Float[Tensor, " N"]:
        """Squared errors in units of the noise; huge for points behind the camera."""
        return self._tensor(self.squares)

    @property
    def depths(self) -> Float[Tensor, " N"]:
        """Depths of the points, in units of the map."""
        return self._tensor(self.z)

    def _tensor(self, values: Array) -> Tensor:
        return torch.from_numpy(values).to(self.like)


@dataclass(frozen=True)
class FramePose:
    """A pose of minimal robust cost, or the start where the weighted points do not determine one."""

    linearization: PoseLinearization
    success: bool
    _model: _Model

    @property
    def T_cw(self) -> Float[Tensor, "4 4"]:
        """World to camera."""
        return self.linearization.T_cw

    def covariance(self) -> Float[Tensor, "6 6"]:
        """Covariance of the left perturbation (translation, rotation), as `RefinedPose.covariance`; zero on failure."""
        like, model = self.linearization.like, self._model
        if not self.success:
            return like.new_zeros(6, 6)
        factor = variance_factor(model.squared, model.influence, model.weights, model.kernel, SCALE, 6)
        return torch.from_numpy(factor * np.linalg.inv(model.normal[:6, :6])).to(like)


class FrameProblem:
    """Known points and the keypoints at which one frame observes them."""

    def __init__(
        self, points_w: Float[Tensor, "N 3"], xy: Float[Tensor, "2 N"], whitened: Float[Tensor, "2 2 N"]
    ) -> None:
        """Take the matches, all finite: undistorted coordinates, and slopes as of `UndistortedKeypoints.whitened`."""
        self.points_w, self.like = np.ascontiguousarray(to_numpy(points_w).T), points_w.detach()
        self.xy = to_numpy(xy)
        self.along_x, self.along_y = np.ascontiguousarray(to_numpy(whitened))

    def linearize(self, T_cw: Float[Tensor, "4 4"]) -> PoseLinearization:
        """The errors and their derivatives at a pose (4, 4)."""
        return self._linearize(to_numpy(T_cw[:3]))

    def minimize(
        self, start: PoseLinearization, weights: Float[Tensor, " N"], kernel: RobustKernel
    ) -> FramePose:
        """Find the pose of minimal robust cost by Levenberg-Marquardt, with a kernel of scale `SCALE`.

        weights: of the squared errors, not negative; zero where a point does not count.
        """
        counts = to_numpy(weights)

        def evaluate(pose: Array) -> _Model:
            return _Model.of(self._linearize(pose), counts, kernel)

        # A reduction below the share 1e-4 of the cost moves the pose by hundredths of its noise.
        model = minimize_model(_Model.of(start, counts, kernel), evaluate, iterations=10, tolerance=1e-4)
        success = is_definite(model.normal[:6, :6])
        return FramePose(model.linearization if success else start, success, model)

    def _linearize(self, pose: Array) -> PoseLinearization:
        points_c = pose[:, :3] @ self.points_w
        points_c += pose[:, 3:]
        z = points_c[2]
        inverse = 1 / np.maximum(z, MIN_DEPTH)
        image = points_c[:2] * inverse
        x, y = image
        # The derivatives of (x, y) in translation and rotation, and the errors in them.
        rows = np.zeros((7, 2, len(z)))
        rows[0, 0] = rows[1, 1] = inverse
        np.multiply(image, -inverse, out=rows[2])
        np.multiply(x, y, out=rows[4, 1])
        np.negative(rows[4, 1], out=rows[3, 0])
        np.subtract(-1.0, y * y, out=rows[3, 1])
        np.add(1.0, x * x, out=rows[4, 0])
        np.negative(y, out=rows[5, 0])
        rows[5, 1] = x
        np.subtract(image, self.xy, out=rows[6])
        rows = rows[:, :1] * self.along_x + rows[:, 1:] * self.along_y
        return PoseLinearization(pose, rows, np.square(rows[6]).sum(0), z, self.like)


def nearby_pose(
    expected_T_cw: Float[Tensor, "4 4"],
    points_w: Float[Tensor, "N 3"],
    undistorted: UndistortedKeypoints,
    threshold: float,
) -> Float[Tensor, "4 4"] | None:
    """Refine an expected pose without RANSAC, by all matches under a robust kernel, then by those that agree.

    threshold: maximum error of a match that agrees, px. Returns None where less than `MIN_AGREEING` of them do.
    """
    problem = FrameProblem(points_w, undistorted.xy, undistorted.slope / threshold)
    ones = torch.ones_like(points_w[:, 0])
    first = problem.minimize(problem.linearize(expected_T_cw), ones, "cauchy").linearization
    found = problem.minimize(first, ones * (first.squared < 1), "huber")
    agreeing = int((found.linearization.squared < 1).sum())
    return found.T_cw if found.success and agreeing >= MIN_AGREEING * len(points_w) else None


@dataclass(frozen=True)
class _Model:
    """The cost at a pose and its quadratic model, by iteratively reweighted least squares.

    squared: (N,) weighted squared errors; influence: (N,) the kernel's rho' of them
    normal:  (7, 7) [J r]^T W [J r]
    """

    linearization: PoseLinearization
    kernel: RobustKernel
    weights: Array
    squared: Array
    influence: Array
    cost: float
    normal: Array

    @classmethod
    def of(cls, linearization: PoseLinearization, weights: Array, kernel: RobustKernel) -> _Model:
        squared = linearization.squares * weights
        rho, influence = (cauchy if kernel == "cauchy" else huber)(squared, SCALE)
        weighted = linearization.rows * (influence * weights)
        normal = weighted.reshape(7, -1) @ linearization.rows.reshape(7, -1).T
        return cls(linearization, kernel, weights, squared, influence, 0.5 * float(rho.sum()), normal)

    def step(self, damping: float, use_curvature: bool) -> tuple[Array, float] | None:
        """As `LocalModel.step`; reweighted least squares converge fast enough here without the kernel's curvature."""
        hessian, gradient = self.normal[:6, :6].copy(), self.normal[:6, 6]
        hessian.flat[::7] *= 1 + damping
        try:
            step = -np.linalg.solve(hessian, gradient)
        except np.linalg.LinAlgError:
            return None
        slope = float(step @ gradient)
        return (retract_pose(self.linearization.pose, step), -0.5 * slope) if math.isfinite(slope) else None
