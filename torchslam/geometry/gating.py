"""Whether a measurement fits a prediction: the one model of what a keypoint's error may be.

A keypoint is known to its scale in pixels, in each direction, so that the squared error of a right match divided by the
squared scale follows a chi-square distribution of two degrees of freedom.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchslam.geometry.camera import Camera
from torchslam.geometry.precision import full_precision

CHI_SQUARE_95 = 5.991
"""95 % of a chi-square distribution of two degrees of freedom."""


@full_precision
def squared_reprojection_errors(points_c: Tensor, pixels: Tensor, camera: Camera) -> Tensor:
    """(...) px^2 between projections of points (..., 3) in the camera frame and pixels (..., 2); infinite behind it."""
    projected, valid = camera.project(points_c)
    return ((projected - pixels) ** 2).sum(-1).where(valid, torch.inf)


@full_precision
def fits(squared_errors: Tensor, sigmas: Tensor, chi_square: float = CHI_SQUARE_95) -> Tensor:
    """(...) bool: squared errors (...), px^2, that keypoints of standard deviation sigmas (...), px, may well have."""
    return squared_errors < chi_square * sigmas**2


@full_precision
def innovation_covariances(J: Tensor, covariances: Tensor, sigmas: Tensor) -> Tensor:
    """S = sigma^2 I + J Sigma J^T: of pixels measured minus pixels predicted. (..., 2, 2).

    J: (..., 2, D) derivative of the prediction in what it is made from; covariances: (..., D, D) of that;
    sigmas: (...) standard deviations of the measured pixels
    """
    eye = torch.eye(J.shape[-2], dtype=J.dtype, device=J.device)
    return sigmas[..., None, None] ** 2 * eye + J @ covariances @ J.mT


@full_precision
def mahalanobis_squared(errors: Tensor, covariances: Tensor) -> Tensor:
    """e^T S^-1 e of errors (..., D) with covariances (..., D, D), positive definite. (...)."""
    return (errors * torch.linalg.solve(covariances, errors)).sum(-1)
