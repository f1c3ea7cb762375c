"""Whether a measurement fits a prediction: the one model of what a keypoint's error may be, `KeypointNoise`.

In units of it the squared error of a right match follows a chi-square distribution of two degrees of freedom. Whatever
weighs a keypoint, or asks whether it fits, asks it: tracking, mapping, adjusting, covariances, the graph of a run.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchslam.geometry.camera import Camera
from torchslam.geometry.precision import full_precision
from torchslam.geometry.whitening import from_triangle, inverse_2x2, triangle

CHI_SQUARE_95 = 5.991
"""95 % of a chi-square distribution of two degrees of freedom."""


MARGIN = 2.0
"""Times the standard deviation that a front end states: what a test takes for granted that compares a keypoint with
the map, which has errors of its own. A scale, where nothing is stated, has that margin: ORB is right to half of it."""


@dataclass(frozen=True)
class KeypointNoise:
    """What is known of the errors of keypoints (...).

    scales:      (...) pixels, the sizes of their pyramid levels
    information: (..., I) px^-2, what a front end says of them: nothing, I = 0, a keypoint then is known to its scale in
                 each direction; I = 1: the inverse variance in each direction; I = 3: xx, xy, yy of the inverse
                 covariance
    """

    scales: Tensor
    information: Tensor

    @classmethod
    def of(cls, scales: Tensor, information: Tensor | None) -> KeypointNoise:
        """Of information (...) or (..., 2, 2) as `Features` has it, or none. Differentiable."""
        return cls(scales, packed_information(information, scales))

    @property
    def weights(self) -> Tensor:
        """What observations count in least squares: (...) inverse variances or (..., 2, 2) inverse covariances."""
        size = self.information.shape[-1]
        if size == 0:
            return self.scales**-2
        return self.information[..., 0] if size == 1 else from_triangle(self.information)

    @property
    def spread(self) -> Tensor:
        """(...) standard deviations in pixels, or (..., 2, 2) covariances."""
        size = self.information.shape[-1]
        return inverse_2x2(self.weights) if size == 3 else self.sigmas

    @property
    def sigmas(self) -> Tensor:
        """(...) standard deviations in pixels: of covariances that of a circle of equal area."""
        size = self.information.shape[-1]
        if size == 0:
            return self.scales
        return self.weights**-0.5 if size == 1 else torch.linalg.det(self.weights) ** -0.25

    def __getitem__(self, rows: Any) -> KeypointNoise:
        """Of some keypoints, as one indexes a tensor."""
        return KeypointNoise(self.scales[rows], self.information[rows])

    def stated(self) -> KeypointNoise:
        """The same noise, stated where it was only known by scale: tests that know MARGIN stay as they are."""
        if self.information.shape[-1]:
            return self
        return KeypointNoise(self.scales, MARGIN**2 * self.scales[..., None] ** -2)

    def weighed(self, factors: Tensor) -> KeypointNoise:
        """Stated information, multiplied with factors (...)."""
        return KeypointNoise(self.scales, self.information * factors[..., None])

    def worse(self, other: KeypointNoise) -> KeypointNoise:
        """Of each pair of keypoints that of the one that is known less well."""
        first = self.sigmas >= other.sigmas
        return KeypointNoise(
            torch.maximum(self.scales, other.scales),
            torch.where(first[..., None], self.information, other.information),
        )

    @property
    def margin(self) -> float:
        """Times `sigmas`: what tests take for granted, MARGIN where the noise is stated."""
        return 1.0 if self.information.shape[-1] == 0 else MARGIN

    @property
    def tolerance(self) -> Tensor:
        """(...) px, the standard deviation that tests take for granted: `sigmas`, with MARGIN where they are stated."""
        return self.sigmas if self.information.shape[-1] == 0 else MARGIN * self.sigmas

    def squared(self, errors: Tensor) -> Tensor:
        """(...) squared errors (..., 2), px, in units of the noise, with MARGIN where it is stated: for `fits`."""
        if self.information.shape[-1] < 3:
            return self._squared(errors.square().sum(-1))
        return (errors[..., None, :] @ self.weights @ errors[..., None])[..., 0, 0] / MARGIN**2

    def squared_reprojection(self, points_c: Tensor, pixels: Tensor, camera: Camera) -> Tensor:
        """(...) what `squared` says of the errors between projections of points_c (..., 3) and pixels (..., 2).

        Infinite behind the camera.
        """
        if self.information.shape[-1] < 3:
            return self._squared(squared_reprojection_errors(points_c, pixels, camera))
        projected, valid = camera.project(points_c)
        return self.squared(projected - pixels).where(valid, torch.inf)

    def _squared(self, squared_px: Tensor) -> Tensor:
        return squared_px / self.tolerance**2


def packed_information(information: Tensor | None, like: Tensor) -> Tensor:
    """Information (...) or (..., 2, 2) of keypoints, or none, as `KeypointNoise` has it; like: (...)."""
    if information is None:
        return like.new_zeros(*like.shape, 0)
    return information[..., None] if information.ndim == like.ndim else triangle(information)


def unpacked_information(information: Tensor) -> Tensor | None:
    """The way back: (...), (..., 2, 2) or None."""
    size = information.shape[-1]
    return None if size == 0 else information[..., 0] if size == 1 else from_triangle(information)


@full_precision
def squared_reprojection_errors(points_c: Tensor, pixels: Tensor, camera: Camera) -> Tensor:
    """(...) px^2 between projections of points (..., 3) in the camera frame and pixels (..., 2); infinite behind it."""
    projected, valid = camera.project(points_c)
    return ((projected - pixels) ** 2).sum(-1).where(valid, torch.inf)


def fits(squared: Tensor, chi_square: float = CHI_SQUARE_95) -> Tensor:
    """(...) bool: squared errors (...), as `KeypointNoise` says them, that keypoints may well have."""
    return squared < chi_square


@full_precision
def innovation_covariances(J: Tensor, covariances: Tensor, sigmas: Tensor) -> Tensor:
    """S = R + J Sigma J^T: of pixels measured minus pixels predicted. (..., 2, 2).

    J: (..., 2, D) derivative of the prediction in what it is made from; covariances: (..., D, D) of that;
    sigmas: (...) standard deviations of the measured pixels, R = sigma^2 I, or (..., 2, 2) their covariances R
    """
    if sigmas.ndim == J.ndim:
        return sigmas + J @ covariances @ J.mT
    eye = torch.eye(J.shape[-2], dtype=J.dtype, device=J.device)
    return sigmas[..., None, None] ** 2 * eye + J @ covariances @ J.mT


@full_precision
def mahalanobis_squared(errors: Tensor, covariances: Tensor) -> Tensor:
    """e^T S^-1 e of errors (..., D) with covariances (..., D, D), positive definite. (...)."""
    return (errors * torch.linalg.solve(covariances, errors)).sum(-1)
