"""Differentiable losses of poses, batched over all leading dimensions, with masks over rows.

Every loss reduces its last dimension of rows, (..., N) to (...), and is NaN, with a gradient of zero, where no row
counts: a loss of zero would look like success. `ate` and `rpe` of `torchslam.evaluation` are losses too, in meters
and radians: both align the estimate by a similarity first, so they are independent of its scale. Errors of real data
have long tails; (errors / unit).log1p() limits the influence of large ones.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from torchslam.evaluation import ate, rpe
from torchslam.geometry import (
    Camera,
    essential_from_pose,
    sampson_errors,
    se3_inverse,
    se3_log,
    so3_log,
    transform,
    triangulate_many,
)
from torchslam.geometry.precision import full_precision
from torchslam.geometry.robust import Kernel, robustify
from torchslam.learning.clip_slam import ClipPoses

__all__ = [
    "ate",
    "clip_reprojection",
    "epipolar_loss",
    "motion_difference",
    "path_length",
    "pose_errors",
    "pose_nll",
    "relative_ate",
    "reprojection_loss",
    "rpe",
]


@full_precision
def path_length(T_cw: Tensor) -> Tensor:
    """Compute the length (...) of the path through poses (..., N, 4, 4), in their unit."""
    return se3_inverse(T_cw)[..., :3, 3].diff(dim=-2).norm(dim=-1).sum(-1)


@full_precision
def relative_ate(T_cw: Tensor, T_cw_groundtruth: Tensor, mask: Tensor | None = None) -> Tensor:
    """Compute the ATE relative to the length of the true path, comparable between clips of any size.

    Args:
        T_cw: (..., N, 4, 4).
        T_cw_groundtruth: (..., N, 4, 4); all of it is the path.
        mask: (..., N) poses that count.

    Returns:
        (...), NaN where fewer than three poses count or the true camera does not move.
    """
    length = path_length(T_cw_groundtruth)
    share = ate(T_cw, T_cw_groundtruth, mask) / torch.where(length > 0, length, 1.0)
    return torch.where(length > 0, share, torch.nan)


@full_precision
def pose_errors(T_cw: Tensor, T_cw_groundtruth: Tensor) -> Tensor:
    """Compute the distance between poses (..., 4, 4) in the same world frame.

    Returns:
        (..., 2): distance of the camera centers, in the unit of the translations, and angle, radians. The gradient is
        zero where the error is.
    """
    difference = T_cw @ se3_inverse(T_cw_groundtruth)
    vectors = torch.stack((difference[..., :3, 3], so3_log(difference[..., :3, :3])), dim=-2)
    return torch.linalg.vector_norm(vectors, dim=-1)


@full_precision
def motion_difference(T_21: Tensor, T_21_groundtruth: Tensor) -> Tensor:
    """Compute the rotation and direction errors of motions (..., 4, 4), independent of the translations' lengths.

    Returns:
        Rotation vectors (..., 2, 3), radians: of the rotation, and of the direction of the translation (zero where a
        translation is). Their lengths are the usual errors of relative poses.
    """
    t, t_true = (F.normalize(T[..., :3, 3], dim=-1) for T in (T_21, T_21_groundtruth))
    axis = torch.linalg.cross(t_true, t, dim=-1)
    sine, cosine = torch.linalg.vector_norm(axis, dim=-1), (t * t_true).sum(-1)
    direction = F.normalize(axis, dim=-1) * torch.atan2(sine, cosine)[..., None]
    rotation = so3_log(T_21[..., :3, :3] @ T_21_groundtruth[..., :3, :3].mT)
    return torch.stack((rotation, direction), dim=-2)


@full_precision
def pose_nll(
    T_cw: Tensor, T_cw_groundtruth: Tensor, covariance: Tensor, mask: Tensor | None = None
) -> Tensor:
    """Compute the mean negative log-likelihood of the true poses, in nats.

    An error xi with covariance S costs (xi^T S^-1 xi + log det S + 6 log 2 pi) / 2. Poses whose covariance is not
    positive definite do not count.

    Args:
        T_cw: (..., N, 4, 4).
        T_cw_groundtruth: (..., N, 4, 4) in the same world and unit.
        covariance: (..., N, 6, 6) of the left perturbation (translation, rotation) of T_cw: of a solver (detached, so
            it only weights the errors) or predicted by a network.
        mask: (..., N) poses that count; others may have any covariance.

    Returns:
        (...).
    """
    xi = se3_log(T_cw_groundtruth @ se3_inverse(T_cw))
    eye = torch.eye(6, dtype=xi.dtype, device=xi.device)
    mask = torch.ones_like(xi[..., 0], dtype=torch.bool) if mask is None else mask
    with torch.no_grad():
        mask = mask & torch.isfinite(covariance).flatten(-2).all(-1)
        mask = mask & (
            torch.linalg.cholesky_ex(torch.where(mask[..., None, None], covariance, eye)).info == 0
        )
    L = torch.linalg.cholesky(torch.where(mask[..., None, None], covariance, eye))
    whitened = torch.linalg.solve_triangular(L, xi[..., None], upper=False).squeeze(-1)
    log_determinant = 2 * L.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    return _mean(0.5 * (whitened.square().sum(-1) + log_determinant + 6 * math.log(2 * math.pi)), mask)


@full_precision
def epipolar_loss(
    T_21: Tensor,
    pixels_1: Tensor,
    pixels_2: Tensor,
    camera_1: Camera,
    camera_2: Camera,
    mask: Tensor | None = None,
    kernel: Kernel = "cauchy",
    scale: float = 1.0,
) -> Tensor:
    """Compute the mean robust squared Sampson distance of matches; needs no depth and no ground truth.

    Args:
        T_21: (..., 4, 4), with a translation of any length but zero, which would fit everything.
        pixels_1: (..., N, 2).
        pixels_2: (..., N, 2).
        camera_1: Of the first images.
        camera_2: Of the second images.
        mask: (..., N) matches that count.
        kernel: Robust kernel.
        scale: Of the kernel, pixels.

    Returns:
        (...), px^2.
    """
    counted = torch.isfinite(pixels_1).all(-1) & torch.isfinite(pixels_2).all(-1)
    counted = counted if mask is None else counted & mask
    pixels_1, pixels_2 = (torch.where(counted[..., None], pixels, 0.0) for pixels in (pixels_1, pixels_2))
    x_1, x_2 = camera_1.normalize(pixels_1), camera_2.normalize(pixels_2)
    E = essential_from_pose(T_21[..., :3, :3], T_21[..., :3, 3])
    variances = [camera.focal[..., None].square().reciprocal() for camera in (camera_1, camera_2)]
    squared = sampson_errors(E, x_1, x_2, *variances).square()
    return _mean(_robust(squared, kernel, scale), counted)


@full_precision
def reprojection_loss(
    T_cw: Tensor,
    pixels: Tensor,
    camera: Camera,
    mask: Tensor | None = None,
    kernel: Kernel = "cauchy",
    scale: float = 1.0,
) -> Tensor:
    """Compute the mean robust reprojection error of points triangulated from tracks, differentiably.

    A point behind one of its views does not count: make sure that the network cannot gain by moving it there.

    Args:
        T_cw: (..., V, 4, 4) poses of the views: true ones, or estimated ones for self-supervision.
        pixels: (..., N, V, 2).
        camera: Of all views.
        mask: (..., N, V) which views see a point; a point needs two.
        kernel: Robust kernel.
        scale: Of the kernel on the root of a point's sum of squares, pixels.

    Returns:
        (...), px^2: mean over points of the robust sum of squares.
    """
    points = triangulate_many(T_cw, pixels, camera, mask)
    seen = points.errors.isfinite()
    squared = torch.where(seen, points.errors, 0.0).square().sum(-1)
    return _mean(_robust(squared, kernel, scale), points.mask & (seen.sum(-1) >= 2))


@full_precision
def clip_reprojection(poses: ClipPoses, kernel: Kernel = "cauchy", scale: float = 1.0) -> Tensor:
    """Compute the robust reprojection error of clips against their own solution; needs no ground truth.

    Observations of frames without a pose and of points that were not optimized do not count. All observations weigh the
    same, so that a network cannot gain by down-weighting bad ones.

    Args:
        poses: Of clips.
        kernel: Robust kernel.
        scale: Of the kernel, pixels.

    Returns:
        (B,), or () for one clip, px^2: mean over the observations, for `clip_mean`.
    """
    means = []
    for T_cw, graph, solution in zip(
        poses.T_cw.view(-1, *poses.posed.shape[-1:], 4, 4), poses.graphs, poses.solutions, strict=True
    ):
        if graph is None or solution is None:
            means.append(0 * T_cw.sum() + torch.nan)  # with a gradient of zero
            continue
        seen = transform(solution.T_cw[graph.frame_index], solution.points_w[graph.point_index, None])
        projected, valid = solution.camera.project(seen.squeeze(-2))
        counted = valid & solution.success[graph.frame_index] & solution.moved_points[graph.point_index]
        means.append(_mean(_robust((projected - graph.pixels).square().sum(-1), kernel, scale), counted))
    return torch.stack(means) if poses.T_cw.ndim == 4 else means[0]


def _robust(squared: Tensor, kernel: Kernel, scale: float) -> Tensor:
    """rho of squares (...)."""
    return robustify(squared, kernel, squared.new_tensor(scale)).rho


def _mean(values: Tensor, mask: Tensor) -> Tensor:
    """The mean of the rows (..., N) that count; NaN, with a gradient of zero, where there is none."""
    total = torch.where(mask, values, 0.0).sum(-1)
    return torch.where(mask.any(-1), total / mask.sum(-1).clamp_min(1), torch.nan)
