"""The noise of keypoints, `KeypointNoise`, and gates on the errors of predictions.

In units of that noise, the squared error of a correct match follows a chi-square distribution of two degrees of
freedom. Symmetric 2x2 matrices are written out: faster than general ones, and fit for `torch.func`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchslam.geometry.camera import Camera
from torchslam.geometry.precision import full_precision, without_autocast
from torchslam.utils.by_value import ByValue


def triangle(A: Float[Tensor, "*batch 2 2"]) -> Float[Tensor, "*batch 3"]:
    """The entries xx, xy, yy of the symmetric part of matrices."""
    return torch.stack((A[..., 0, 0], 0.5 * (A[..., 0, 1] + A[..., 1, 0]), A[..., 1, 1]), dim=-1)


def from_triangle(values: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2 2"]:
    """Symmetric matrices from their entries xx, xy, yy."""
    xx, xy, yy = values.unbind(-1)
    return torch.stack((xx, xy, xy, yy), dim=-1).unflatten(-1, (2, 2))


def is_definite(A: Float[Tensor, "*batch 2 2"]) -> Bool[Tensor, "*batch"]:
    """Test whether matrices are positive definite; False where they are not finite."""
    xx, xy, yy = triangle(A).unbind(-1)
    return (xx > 0) & (xx * yy - xy * xy > 0)


def inverse_2x2(A: Float[Tensor, "*batch 2 2"]) -> Float[Tensor, "*batch 2 2"]:
    """Inverses of definite matrices."""
    xx, xy, yy = triangle(A).unbind(-1)
    return from_triangle(torch.stack((yy, -xy, xx), dim=-1)) / (xx * yy - xy * xy)[..., None, None]


def whitening(A: Float[Tensor, "*batch 2 2"]) -> Float[Tensor, "*batch 2 2"]:
    """W, upper triangular, with W^T W = A; zero, with gradient zero, where A is not positive definite."""
    definite = is_definite(A)[..., None]
    xx, xy, yy = torch.where(definite, triangle(A), A.new_tensor((1.0, 0.0, 1.0))).unbind(-1)
    p = xx.sqrt()
    q = xy / p
    W = torch.stack((p, q, torch.zeros_like(p), (yy - q * q).sqrt()), dim=-1).unflatten(-1, (2, 2))
    return torch.where(definite[..., None], W, 0.0)


CHI_SQUARE_95 = 5.991
"""95 % of a chi-square distribution of two degrees of freedom."""
GATE_FACTOR = 2.0
"""Inflation of the standard deviations that an extractor provides when a keypoint is gated against the map, which has
errors of its own. Scales, where no information is provided, include that factor: ORB is precise to half its scale."""


@dataclass(frozen=True, eq=False)
class KeypointNoise(ByValue):
    """The errors of keypoints.

    Attributes:
        scales: pixels, the sizes of their pyramid levels.
        information: px^-2, as a feature extractor provides it. I = 0: none, the scale in each direction is the standard
            deviation times `GATE_FACTOR`; I = 1: inverse variance in each direction; I = 3: xx, xy, yy of the inverse
            covariance.
    """

    scales: Float[Tensor, "*batch"]
    information: Float[Tensor, "*batch I"]

    @classmethod
    def of(cls, scales: Float[Tensor, "*batch"], information: Float[Tensor, "..."] | None) -> KeypointNoise:
        """Pack information (...) or (..., 2, 2), as in `Features`, or none. Differentiable."""
        return cls(scales, packed_information(information, scales))

    @property
    def weights(self) -> Float[Tensor, "..."]:
        """Weights in least squares: (...) inverse variances or (..., 2, 2) inverse covariances."""
        size = self.information.shape[-1]
        if size == 0:
            return self.scales**-2
        return self.information[..., 0] if size == 1 else from_triangle(self.information)

    @property
    def sigma_or_covariance(self) -> Float[Tensor, "..."]:
        """(...) standard deviations in pixels, or (..., 2, 2) covariances."""
        size = self.information.shape[-1]
        return inverse_2x2(self.weights) if size == 3 else self.sigmas

    @property
    def sigmas(self) -> Float[Tensor, "*batch"]:
        """Standard deviations in pixels; for a covariance, that of the circle of equal area."""
        size = self.information.shape[-1]
        if size == 0:
            return self.scales
        return self.weights**-0.5 if size == 1 else torch.linalg.det(self.weights) ** -0.25

    def __getitem__(self, rows: Any) -> KeypointNoise:
        """The noise of some of the keypoints, indexed as a tensor."""
        return KeypointNoise(self.scales[rows], self.information[rows])

    def with_explicit_information(self) -> KeypointNoise:
        """The same noise with information, where only scales were known; gates stay as they are."""
        if self.information.shape[-1]:
            return self
        return KeypointNoise(self.scales, GATE_FACTOR**2 * self.scales[..., None] ** -2)

    def scaled(self, factors: Float[Tensor, "*batch"]) -> KeypointNoise:
        """The noise with its information multiplied by factors."""
        return KeypointNoise(self.scales, self.information * factors[..., None])

    def pairwise_max(self, other: KeypointNoise) -> KeypointNoise:
        """The larger noise of each pair of keypoints."""
        first = self.sigmas >= other.sigmas
        return KeypointNoise(
            torch.maximum(self.scales, other.scales),
            torch.where(first[..., None], self.information, other.information),
        )

    @property
    def gate_factor(self) -> float:
        """The factor of `sigmas` in gates: GATE_FACTOR if there is information, else 1."""
        return 1.0 if self.information.shape[-1] == 0 else GATE_FACTOR

    @property
    def gate_sigma(self) -> Float[Tensor, "*batch"]:
        """The standard deviations used by gates, px: `gate_factor` times `sigmas`."""
        return self.sigmas if self.information.shape[-1] == 0 else GATE_FACTOR * self.sigmas

    def squared(self, errors: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch"]:
        """Squares of errors in pixels, in units of the gate's noise, for `passes_gate`."""
        if self.information.shape[-1] < 3:
            return errors.square().sum(-1) / self.gate_sigma**2
        return (errors[..., None, :] @ self.weights @ errors[..., None])[..., 0, 0] / GATE_FACTOR**2

    def squared_reprojection(
        self, points_c: Float[Tensor, "*#batch 3"], pixels: Float[Tensor, "*#batch 2"], camera: Camera
    ) -> Float[Tensor, "*#batch"]:
        """`squared` of the reprojections of points seen at pixels; infinite behind the camera."""
        if self.information.shape[-1] < 3:
            return squared_reprojection_errors(points_c, pixels, camera) / self.gate_sigma**2
        projected, valid = camera.project(points_c)
        return self.squared(projected - pixels).where(valid, torch.inf)


def packed_information(
    information: Float[Tensor, "..."] | None, like: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch I"]:
    """Pack information (...) or (..., 2, 2) of keypoints (...), or none, as in `KeypointNoise`."""
    if information is None:
        return like.new_zeros(*like.shape, 0)
    return information[..., None] if information.ndim == like.ndim else triangle(information)


def unpacked_information(information: Float[Tensor, "*batch I"]) -> Float[Tensor, "..."] | None:
    """The inverse of `packed_information`: (...), (..., 2, 2) or None."""
    size = information.shape[-1]
    return None if size == 0 else information[..., 0] if size == 1 else from_triangle(information)


@full_precision
def squared_reprojection_errors(
    points_c: Float[Tensor, "*#batch 3"], pixels: Float[Tensor, "*#batch 2"], camera: Camera
) -> Float[Tensor, "*#batch"]:
    """Squared distances in px^2 of projected points from the pixels where they are seen; infinite behind the camera."""
    projected, valid = camera.project(points_c)
    return ((projected - pixels) ** 2).sum(-1).where(valid, torch.inf)


@without_autocast
def passes_gate(
    squared: Float[Tensor, "*batch"], chi_square: float = CHI_SQUARE_95
) -> Bool[Tensor, "*batch"]:
    """Test squared errors in units of `KeypointNoise` against a quantile of chi-square."""
    return squared < chi_square


@full_precision
def innovation_covariances(
    J: Float[Tensor, "*#batch 2 D"],
    covariances: Float[Tensor, "*#batch D D"],
    sigmas: Float[Tensor, "*#batch"] | Float[Tensor, "*#batch 2 2"],
) -> Float[Tensor, "*#batch 2 2"]:
    """Covariances S = R + J Sigma J^T of measured minus predicted pixels, px^2.

    J are the derivatives of the predictions by the parameters, which have the covariances; `sigmas` are (...) standard
    deviations of the measured pixels, R = sigma^2 I, or (..., 2, 2) their covariances R.
    """
    if sigmas.ndim == J.ndim:
        return sigmas + J @ covariances @ J.mT
    eye = torch.eye(J.shape[-2], dtype=J.dtype, device=J.device)
    return sigmas[..., None, None] ** 2 * eye + J @ covariances @ J.mT


@full_precision
def mahalanobis_squared(
    errors: Float[Tensor, "*#batch D"], covariances: Float[Tensor, "*#batch D D"]
) -> Float[Tensor, "*#batch"]:
    """e^T S^-1 e of errors with positive definite covariances."""
    return (errors * torch.linalg.solve(covariances, errors)).sum(-1)
