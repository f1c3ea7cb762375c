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
from jaxtyping import Bool, Float
from torch import Tensor

from torchslam.evaluation import ate
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


@full_precision
def path_length(T_cw: Float[Tensor, "*batch N 4 4"]) -> Float[Tensor, "*batch"]:
    """Compute the length of the path through poses, in their unit."""
    return se3_inverse(T_cw)[..., :3, 3].diff(dim=-2).norm(dim=-1).sum(-1)


@full_precision
def relative_ate(
    *,
    T_cw: Float[Tensor, "*batch N 4 4"],
    T_cw_groundtruth: Float[Tensor, "*batch N 4 4"],
    mask: Bool[Tensor, "*batch N"] | None = None,
) -> Float[Tensor, "*batch"]:
    """Compute the ATE relative to the length of the path of all true poses, comparable between clips of any size.

    Returns:
        A ratio, NaN where fewer than three poses count or the true camera does not move.
    """
    length = path_length(T_cw_groundtruth)
    share = ate(T_cw=T_cw, T_cw_groundtruth=T_cw_groundtruth, mask=mask) / torch.where(
        length > 0, length, 1.0
    )
    return torch.where(length > 0, share, torch.nan)


@full_precision
def pose_errors(
    *, T_cw: Float[Tensor, "*#batch 4 4"], T_cw_groundtruth: Float[Tensor, "*#batch 4 4"]
) -> Float[Tensor, "*#batch 2"]:
    """Compute the distance between poses in the same world frame.

    Returns:
        Distance of the camera centers, in the unit of the translations, and angle, radians. The gradient is zero where
        the error is.
    """
    difference = T_cw @ se3_inverse(T_cw_groundtruth)
    vectors = torch.stack((difference[..., :3, 3], so3_log(difference[..., :3, :3])), dim=-2)
    return torch.linalg.vector_norm(vectors, dim=-1)


@full_precision
def motion_difference(
    T_21: Float[Tensor, "*#batch 4 4"], T_21_groundtruth: Float[Tensor, "*#batch 4 4"]
) -> Float[Tensor, "*#batch 2 3"]:
    """Compute the rotation and direction errors of motions, independent of the translations' lengths.

    Returns:
        Rotation vectors, radians: of the rotation, and of the direction of the translation (zero where a
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
    *,
    T_cw: Float[Tensor, "*#batch N 4 4"],
    T_cw_groundtruth: Float[Tensor, "*#batch N 4 4"],
    covariance: Float[Tensor, "*#batch N 6 6"],
    mask: Bool[Tensor, "*#batch N"] | None = None,
) -> Float[Tensor, "*#batch"]:
    """Compute the mean negative log-likelihood of the true poses, in nats.

    An error xi with covariance S costs (xi^T S^-1 xi + log det S + 6 log 2 pi) / 2. Poses whose covariance is not
    positive definite do not count.

    Args:
        T_cw, T_cw_groundtruth: Estimated and true poses, in the same world and unit.
        covariance: Of the left perturbation (translation, rotation) of T_cw: of a solver (detached, so it only weights
            the errors) or predicted by a network.
        mask: Poses that count; others may have any covariance.
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
    T_21: Float[Tensor, "*#batch 4 4"],
    pixels_1: Float[Tensor, "*#batch N 2"],
    pixels_2: Float[Tensor, "*#batch N 2"],
    camera_1: Camera,
    camera_2: Camera,
    mask: Bool[Tensor, "*#batch N"] | None = None,
    kernel: Kernel = "cauchy",
    scale: float = 1.0,
) -> Float[Tensor, "*#batch"]:
    """Compute the mean robust squared Sampson distance of matches; needs no depth and no ground truth.

    Args:
        T_21: With a translation of any length but zero, which would fit everything.
        pixels_1, pixels_2: Matching pixels of the first and the second images.
        camera_1, camera_2: Of these images.
        mask: Matches that count.
        kernel, scale: Robust kernel and its scale, pixels.

    Returns:
        px^2.
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
    T_cw: Float[Tensor, "*#batch V 4 4"],
    pixels: Float[Tensor, "*#batch N V 2"],
    camera: Camera,
    mask: Bool[Tensor, "*#batch N V"] | None = None,
    kernel: Kernel = "cauchy",
    scale: float = 1.0,
) -> Float[Tensor, "*#batch"]:
    """Compute the mean robust reprojection error of points triangulated from tracks, differentiably.

    A point behind one of its views does not count: make sure that the network cannot gain by moving it there.

    Args:
        T_cw: Poses of the views: true ones, or estimated ones for self-supervision.
        pixels: Of the points in the views.
        camera: Of all views.
        mask: Which views see a point; a point needs two.
        kernel, scale: Robust kernel and its scale on the root of a point's sum of squares, pixels.

    Returns:
        px^2: mean over points of the robust sum of squares.
    """
    points = triangulate_many(pixels, T_cw=T_cw, camera=camera, mask=mask)
    seen = points.errors.isfinite()
    squared = torch.where(seen, points.errors, 0.0).square().sum(-1)
    return _mean(_robust(squared, kernel, scale), points.mask & (seen.sum(-1) >= 2))


@full_precision
def clip_reprojection(
    poses: ClipPoses, kernel: Kernel = "cauchy", scale: float = 1.0
) -> Float[Tensor, "*batch"]:
    """Compute the robust reprojection error of clips against their own solution; needs no ground truth.

    Observations of frames without a pose and of points that were not optimized do not count. All observations weigh the
    same, so that a network cannot gain by down-weighting bad ones.

    Args:
        poses: Of clips.
        kernel, scale: Robust kernel and its scale, pixels.

    Returns:
        px^2, one per clip: mean over the observations, for `clip_mean`.
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


def _robust(squared: Float[Tensor, "*batch"], kernel: Kernel, scale: float) -> Float[Tensor, "*batch"]:
    """The kernel's rho of squares."""
    return robustify(squared, kernel, squared.new_tensor(scale)).rho


def _mean(values: Float[Tensor, "*batch N"], mask: Bool[Tensor, "*batch N"]) -> Float[Tensor, "*batch"]:
    """The mean of the rows that count; NaN, with a gradient of zero, where there is none."""
    total = torch.where(mask, values, 0.0).sum(-1)
    return torch.where(mask.any(-1), total / mask.sum(-1).clamp_min(1), torch.nan)
