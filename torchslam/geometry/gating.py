"""Whether a measurement fits a prediction, both of them uncertain."""

from __future__ import annotations

import torch
from torch import Tensor


def innovation_covariances(J: Tensor, covariances: Tensor, sigmas: Tensor) -> Tensor:
    """S = sigma^2 I + J Sigma J^T: of pixels measured minus pixels predicted. (..., 2, 2).

    J: (..., 2, D) derivative of the prediction in what it is made from; covariances: (..., D, D) of that;
    sigmas: (...) standard deviations of the measured pixels
    """
    eye = torch.eye(J.shape[-2], dtype=J.dtype, device=J.device)
    return sigmas[..., None, None] ** 2 * eye + J @ covariances @ J.mT


def mahalanobis_squared(errors: Tensor, covariances: Tensor) -> Tensor:
    """e^T S^-1 e of errors (..., D) with covariances (..., D, D), positive definite. (...)."""
    return (errors * torch.linalg.solve(covariances, errors)).sum(-1)
