"""The pose of one frame against known points, for every frame of a run: `refine_pose` in a fraction of the time.

In undistorted coordinates a pose moves points alike whatever the camera is, and an error in them times the slope of the
distortion at the keypoint is one in pixels, to first order: the iterations pass no distortion. What is far off is to be
left out before. It is all computed on the host, by numpy and in double precision: of a few hundred points a call costs
more than its numbers, and one of numpy a third of one of torch. There are no gradients: a run's graph is solved anew
(`solvers.graph`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from torchslam.optim.core.numpy_backend import (
    DAMPING,
    DAMPING_DOWN,
    DAMPING_UP,
    NEAREST,
    SLACK,
    Array,
    cauchy,
    huber,
    moved,
    on_host,
)

RobustKernel = Literal["cauchy", "huber"]
"""As in `geometry.robust`."""

SCALE = 2.0
"""Of the kernels, in units of the noise."""

_ITERATIONS = 10
_NEGLIGIBLE = 1e-4  # share of the cost that a step promises: less moves the pose by hundredths of its noise


@dataclass(frozen=True)
class Sighting:
    """Points as a pose sees them, before anybody says how much each counts.

    pose:   (3, 4) world to camera; rows: (7, 2, N) whitened derivatives in the pose's left perturbation, and the
            whitened errors; squares, z: (N,) what `squared` and `depths` say, all on the host
    like:   of the type and on the device that tensors are to have
    """

    pose: Array
    rows: Array
    squares: Array
    z: Array
    like: Tensor

    @property
    def T_cw(self) -> Tensor:
        """(4, 4)"""
        return self._tensor(np.concatenate((self.pose, ((0.0, 0.0, 0.0, 1.0),))))

    @property
    def squared(self) -> Tensor:
        """(N,) squared errors in units of the noise, far beyond all gates behind the camera."""
        return self._tensor(self.squares)

    @property
    def depths(self) -> Tensor:
        """(N,)"""
        return self._tensor(self.z)

    def _tensor(self, values: Array) -> Tensor:
        return torch.from_numpy(values).to(self.like)


@dataclass(frozen=True)
class FramePose:
    """A pose of least robust cost.

    sighting: at the pose
    success:  whether the points that counted determine it; if not, the pose is where it started
    """

    sighting: Sighting
    success: bool
    _model: _Model

    @property
    def T_cw(self) -> Tensor:
        """(4, 4)"""
        return self.sighting.T_cw

    def covariance(self) -> Tensor:
        """(6, 6) of the left perturbation (translation, rotation), calibrated by the errors themselves; zero where the
        pose is not determined. As `RefinedPose.covariance`."""
        if not self.success:
            return self.sighting.like.new_zeros(6, 6)
        covariance = self._model.variance_factor() * np.linalg.inv(self._model.normal[:6, :6])
        return torch.from_numpy(covariance).to(self.sighting.like)


class FrameProblem:
    """Points of known place, and where one frame sees them."""

    def __init__(self, points_w: Tensor, xy: Tensor, whitened: Tensor) -> None:
        """points_w: (N, 3); xy: (2, N) undistorted coordinates; whitened: (2, 2, N) as of `Undistorted`; all finite."""
        self.points_w, self.like = np.ascontiguousarray(on_host(points_w).T), points_w.detach()
        self.xy = on_host(xy)
        self.along_x, self.along_y = np.ascontiguousarray(on_host(whitened))

    def see(self, T_cw: Tensor) -> Sighting:
        """The points from a pose (4, 4)."""
        return self._see(on_host(T_cw[:3]))

    def _see(self, pose: Array) -> Sighting:
        points_c = pose[:, :3] @ self.points_w
        points_c += pose[:, 3:]
        z = points_c[2]
        inverse = 1 / np.maximum(z, NEAREST)
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
        return Sighting(pose, rows, np.square(rows[6]).sum(0), z, self.like)

    def minimize(self, start: Sighting, weights: Tensor, kernel: RobustKernel) -> FramePose:
        """The pose of least robust cost near a start, by Levenberg-Marquardt.

        weights: (N,) of the squared errors, none negative; zero where a point does not count
        """
        counts = on_host(weights)
        model, damping = _Model.of(start, counts, kernel), DAMPING
        for _ in range(_ITERATIONS):
            step = _step(model.normal, damping)
            if step is None:
                break
            promised = -0.5 * float(step @ model.normal[:6, 6])
            trial = _Model.of(self._see(moved(model.sighting.pose, step)), counts, kernel)
            settled = not promised > _NEGLIGIBLE * model.cost
            better = trial.cost <= SLACK * model.cost
            model = trial if better else model
            if settled:
                break
            damping *= DAMPING_DOWN if better else DAMPING_UP
        success = _is_definite(model.normal[:6, :6])
        return FramePose(model.sighting if success else start, success, model)


@dataclass(frozen=True)
class _Model:
    """The cost at a pose and its quadratic model, by iteratively reweighted least squares.

    squared: (N,) weighted squared errors; influence: (N,) the kernel's rho' of them
    normal:  (7, 7) [J r]^T W [J r]
    """

    sighting: Sighting
    kernel: RobustKernel
    weights: Array
    squared: Array
    influence: Array
    cost: float
    normal: Array

    @classmethod
    def of(cls, sighting: Sighting, weights: Array, kernel: RobustKernel) -> _Model:
        squared = sighting.squares * weights
        rho, influence = _KERNELS[kernel](squared, SCALE)
        weighted = sighting.rows * (influence * weights)
        normal = weighted.reshape(7, -1) @ sighting.rows.reshape(7, -1).T
        return cls(sighting, kernel, weights, squared, influence, 0.5 * float(rho.sum()), normal)

    def variance_factor(self) -> float:
        """As `residuals.variance_factor`, of six parameters."""
        counted = (self.weights > 0).astype(np.float64)
        across = self.influence * counted
        if self.kernel == "huber":  # the slope of psi along the error: one, or zero beyond the scale
            along = (self.squared <= SCALE**2) * counted
        else:
            along = across * (2 * self.influence - 1)
        psi = across * across
        sums = np.stack((counted, across, along, psi, along * along, psi * self.squared)).sum(1).tolist()
        count, across_sum, along_sum, across_2, along_2, psi_2 = sums
        components = 2 * count
        slope = (across_sum + along_sum) / max(components, 1.0)
        if components <= 6 or slope <= 0:
            return 1.0
        spread = (across_2 + along_2) / components / slope**2 - 1
        correction = 1 + 6 / components * spread
        variance = psi_2 / (components - 6)
        factor: float = correction**2 * variance * (2 * across_sum / components) / slope**2
        return factor


_KERNELS = {"cauchy": cauchy, "huber": huber}


def _step(normal: Array, damping: float) -> Array | None:
    """(6,) the step that minimises the damped model; None where there is none."""
    hessian, gradient = normal[:6, :6].copy(), normal[:6, 6]
    hessian.flat[::7] *= 1 + damping
    try:
        step = -np.linalg.solve(hessian, gradient)
    except np.linalg.LinAlgError:
        return None
    return step if math.isfinite(float(step @ gradient)) else None


def _is_definite(hessian: Array) -> bool:
    """Whether a matrix is clearly positive definite, whatever its units: as `linear.factorize`."""
    diagonal = hessian.diagonal()
    if not (diagonal > 0).all():
        return False
    scale = diagonal**-0.5
    try:
        factor = np.linalg.cholesky(scale[:, None] * hessian * scale)
    except np.linalg.LinAlgError:
        return False
    return bool(factor.diagonal().min() > np.finfo(hessian.dtype).eps ** 0.4)
