"""The pose of one frame against known points, for every frame of a run: `refine_pose` in a tenth of the operations.

In undistorted coordinates a pose moves points alike whatever the camera is, and an error in them times the slope of the
distortion at the keypoint is one in pixels, to first order: the iterations pass no distortion. What is far off is to be
left out before. What is six by six is computed on the host, where a number costs less than a call. There are no
gradients: a run's graph is solved anew (`solvers.graph`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchslam.geometry.precision import full_precision
from torchslam.geometry.projections import pose_tangent

RobustKernel = Literal["cauchy", "huber"]
"""As in `geometry.robust`."""

SCALE = 2.0
"""Of the kernels, in units of the noise."""

_ITERATIONS = 10
_NEGLIGIBLE = 1e-4  # share of the cost that a step promises: less moves the pose by hundredths of its noise
_DAMPING, _DAMPING_DOWN, _DAMPING_UP = 1e-4, 0.1, 10.0
_SLACK = 1 + 1e-13  # of the cost: rounding is no reason to refuse a step

Matrix = NDArray[Any]


@dataclass(frozen=True)
class Sighting:
    """Points as a pose sees them, before anybody says how much each counts.

    pose:    (3, 4) world to camera, on the host
    rows:    (7, 2, N) whitened derivatives in the pose's left perturbation, and the whitened errors
    squared: (N,) squared errors in units of the noise, far beyond all gates behind the camera
    depths:  (N,)
    """

    pose: Matrix
    rows: Tensor
    squared: Tensor
    depths: Tensor

    @property
    def T_cw(self) -> Tensor:
        """(4, 4)"""
        pose = np.concatenate((self.pose, ((0.0, 0.0, 0.0, 1.0),)))
        return torch.from_numpy(pose).to(self.rows)


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
            return self.sighting.rows.new_zeros(6, 6)
        covariance = self._model.variance_factor() * np.linalg.inv(self._model.normal[:6, :6])
        return torch.from_numpy(covariance).to(self.sighting.rows)


class FrameProblem:
    """Points of known place, and where one frame sees them."""

    def __init__(self, points_w: Tensor, xy: Tensor, whitened: Tensor) -> None:
        """points_w: (N, 3); xy: (2, N) undistorted coordinates; whitened: (2, 2, N) as of `Undistorted`; all finite."""
        ones = torch.ones_like(points_w[:, :1])
        self.homogeneous = torch.cat((points_w, ones), dim=1).mT
        self.xy = xy
        self.along_x, self.along_y = whitened.contiguous().unbind(0)  # rows of memory are counted on below
        self.tangent = pose_tangent(points_w.dtype, points_w.device)
        self.nearest = torch.finfo(points_w.dtype).eps

    def see(self, T_cw: Tensor) -> Sighting:
        """The points from a pose (4, 4)."""
        return self._see(T_cw[:3].detach().cpu().double().numpy())

    @full_precision
    def _see(self, pose: Matrix) -> Sighting:
        entries = torch.from_numpy(pose.reshape(12)).to(self.xy)
        mapped = torch.addmv(self.tangent.constant, self.tangent.linear.mT, entries).view(21, 4)
        places, depths = (mapped @ self.homogeneous).view(7, 3, -1).split((2, 1), dim=1)
        inverse = depths[6].clamp_min(self.nearest).reciprocal_()
        image = places[6] * inverse
        # d(u / w) = (du - (u / w) dw) / w; the row of the pose itself becomes the error
        rows = torch.addcmul(places, image, depths, value=-1).mul_(inverse)
        torch.sub(image, self.xy, out=rows[6])
        rows = (rows[:, :1] * self.along_x).addcmul_(rows[:, 1:], self.along_y)
        return Sighting(pose, rows, rows[6].square().sum(0), depths[6, 0])

    @full_precision
    def minimize(self, start: Sighting, weights: Tensor, kernel: RobustKernel) -> FramePose:
        """The pose of least robust cost near a start, by Levenberg-Marquardt.

        weights: (N,) of the squared errors, none negative; zero where a point does not count
        """
        model, damping = _Model.of(start, weights, kernel), _DAMPING
        for _ in range(_ITERATIONS):
            step = _step(model.normal, damping)
            if step is None:
                break
            promised = -0.5 * float(step @ model.normal[:6, 6])
            trial = _Model.of(self._see(_moved(model.sighting.pose, step)), weights, kernel)
            settled = not promised > _NEGLIGIBLE * model.cost
            better = trial.cost <= _SLACK * model.cost
            model = trial if better else model
            if settled:
                break
            damping *= _DAMPING_DOWN if better else _DAMPING_UP
        success = _is_definite(model.normal[:6, :6])
        return FramePose(model.sighting if success else start, success, model)


@dataclass(frozen=True)
class _Model:
    """The cost at a pose and its quadratic model, by iteratively reweighted least squares.

    squared: (N,) weighted squared errors; influence: (N,) the kernel's rho' of them; counted: (N,) bool
    normal:  (7, 7) [J r]^T W [J r], on the host
    """

    sighting: Sighting
    kernel: RobustKernel
    weights: Tensor
    squared: Tensor
    influence: Tensor
    cost: float
    normal: Matrix

    @classmethod
    def of(cls, sighting: Sighting, weights: Tensor, kernel: RobustKernel) -> _Model:
        squared = sighting.squared * weights
        rho, influence = _KERNELS[kernel](squared)
        rows = sighting.rows.view(7, -1)
        weighted = (sighting.rows * (influence * weights)).view(7, -1)
        normal = (weighted @ rows.mT).cpu().double().numpy()
        return cls(sighting, kernel, weights, squared, influence, 0.5 * float(rho.sum()), normal)

    def variance_factor(self) -> float:
        """As `residuals.variance_factor`, of six parameters."""
        counted = (self.weights > 0).to(self.influence)
        across = self.influence * counted
        if self.kernel == "huber":  # the slope of psi along the error: one, or zero beyond the scale
            along = (self.squared <= SCALE**2) * counted
        else:
            along = across * (2 * self.influence - 1)
        psi = across * across
        sums = torch.stack((counted, across, along, psi, along * along, psi * self.squared)).sum(1).tolist()
        count, across_sum, along_sum, across_2, along_2, psi_2 = sums
        components = 2 * count
        slope = (across_sum + along_sum) / max(components, 1.0)
        if components <= 6 or slope <= 0:
            return 1.0
        spread = (across_2 + along_2) / components / slope**2 - 1
        correction = 1 + 6 / components * spread
        variance = psi_2 / (components - 6)
        return correction**2 * variance * (2 * across_sum / components) / slope**2


def _cauchy(squared: Tensor) -> tuple[Tensor, Tensor]:
    share = squared * SCALE**-2
    return torch.log1p(share) * SCALE**2, (share + 1).reciprocal_()


def _huber(squared: Tensor) -> tuple[Tensor, Tensor]:
    limit = SCALE**2
    root = squared.clamp_min(limit).sqrt_()
    return (root * (2 * SCALE)).add_(squared.clamp_max(limit)).sub_(2 * limit), SCALE / root


_KERNELS = {"cauchy": _cauchy, "huber": _huber}  # squared errors (N,) -> rho, rho', as `geometry.robust`


def _step(normal: Matrix, damping: float) -> Matrix | None:
    """(6,) the step that minimises the damped model; None where there is none."""
    hessian, gradient = normal[:6, :6], normal[:6, 6]
    try:
        step = -np.linalg.solve(hessian + damping * np.diag(hessian.diagonal()), gradient)
    except np.linalg.LinAlgError:
        return None
    return step if math.isfinite(float(step @ gradient)) else None


def _moved(pose: Matrix, step: Matrix) -> Matrix:
    """A pose (3, 4) moved by [rho, omega] from the left, by Cayley's rotation: as `solvers.tangent.retract`."""
    x, y, z = (0.5 * step[3:]).tolist()
    W = np.array(((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)))
    turn = np.eye(3) + 2 / (1 + x * x + y * y + z * z) * (W + W @ W)
    moved: Matrix = turn @ pose
    moved[:, 3] += step[:3]
    return moved


def _is_definite(hessian: Matrix) -> bool:
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
