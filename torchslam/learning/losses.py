"""What poses can be told to be wrong by: differentiable, batched over all leading dimensions, rows under a mask.

Every loss reduces its last dimension of rows, (..., N) to (...), and is NaN, with a gradient of zero, where no row
counts: a loss of zero would say that all is well. `ate` and `rpe` of `torchslam.evaluation` are losses too, in metres
and radians: both align the estimate by a similarity first, so that they know nothing of its scale. Errors of real data
have long tails; (errors / unit).log1p() keeps the hopeless ones from ruling.
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
from torchslam.learning.clip import ClipPoses

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
    """The way from the first to the last of poses (..., N, 4, 4), in their unit of length. (...)."""
    return se3_inverse(T_cw)[..., :3, 3].diff(dim=-2).norm(dim=-1).sum(-1)


@full_precision
def relative_ate(T_cw: Tensor, T_cw_groundtruth: Tensor, mask: Tensor | None = None) -> Tensor:
    """The ATE as a share of the true path: an error without a unit, which clips of any size have in common.

    T_cw, T_cw_groundtruth: (..., N, 4, 4); mask: (..., N) poses that count; of the truth, all are the path.
    Returns (...), NaN where fewer than three poses count or the truth stands still.
    """
    length = path_length(T_cw_groundtruth)
    share = ate(T_cw, T_cw_groundtruth, mask) / torch.where(length > 0, length, 1.0)
    return torch.where(length > 0, share, torch.nan)


@full_precision
def pose_errors(T_cw: Tensor, T_cw_groundtruth: Tensor) -> Tensor:
    """How far poses (..., 4, 4) of the same world are apart. (..., 2).

    The distance of the camera centres, in the unit of the translations, and the angle, radians. The gradient is zero
    where an error is.
    """
    difference = T_cw @ se3_inverse(T_cw_groundtruth)
    vectors = torch.stack((difference[..., :3, 3], so3_log(difference[..., :3, :3])), dim=-2)
    return torch.linalg.vector_norm(vectors, dim=-1)


@full_precision
def motion_difference(T_21: Tensor, T_21_groundtruth: Tensor) -> Tensor:
    """By how much motions (..., 4, 4) are turned against the true ones, whatever the length of their translations.

    Returns rotation vectors (..., 2, 3), radians: of the rotation, and of the direction of the translation; their
    lengths are the errors that pairs of images are judged by. Zero for the direction where a translation is.
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
    """Negative logarithm of the likelihood of the true poses, the mean over the poses, nats: accurate and honest.

    T_cw, T_cw_groundtruth: (..., N, 4, 4) in the same world and unit
    covariance: (..., N, 6, 6) of the left perturbation (translation, rotation) of T_cw, as solvers give it (there
                detached: then it only weighs the errors) or as something that learns predicts it
    mask:       (..., N) poses that count; what does not may have any covariance

    An error xi with covariance S costs (xi^T S^-1 xi + log det S + 6 log 2 pi) / 2. Returns (...). Poses whose
    covariance is not positive definite do not count.
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
    """How far matches are from the epipolar lines of a motion: the mean of robust squared Sampson distances, px^2.

    T_21: (..., 4, 4), its translation of any length but zero, which would forgive everything
    pixels_1, pixels_2: (..., N, 2); mask: (..., N) matches that count
    scale: of the kernel, pixels

    Returns (...). Needs no depth and, with a motion that was estimated, no truth.
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
    """How far tracks are from the points that they make: the mean over points of a robust sum of squares, px^2.

    T_cw:   (..., V, 4, 4) the views' poses: the true ones, or estimated ones, which makes it self-supervised
    pixels: (..., N, V, 2); mask: (..., N, V) which views see a point; a point needs two
    scale:  of the kernel on the root of a point's sum of squares, pixels

    Returns (...). Points are triangulated, differentiably, and each bears its best errors. A point that lies behind one
    of its views does not count: see to it that what learns cannot gain by putting it there.
    """
    points = triangulate_many(T_cw, pixels, camera, mask)
    seen = points.errors.isfinite()
    squared = torch.where(seen, points.errors, 0.0).square().sum(-1)
    return _mean(_robust(squared, kernel, scale), points.mask & (seen.sum(-1) >= 2))


@full_precision
def clip_reprojection(poses: ClipPoses, kernel: Kernel = "cauchy", scale: float = 1.0) -> Tensor:
    """How far the observations of clips are from where their own solution has them: no truth is needed. (B,) px^2.

    The mean over a clip's observations of robust squared reprojection errors, scale in pixels, for `clip_mean`; () for
    ClipPoses of one clip. Observations of frames without a pose and of points that stayed where they were do not count.
    All weights of observations count alike here, so that nothing is gained by weighing bad ones down.
    """
    means = []
    for T_cw, graph, solution in zip(
        poses.T_cw.view(-1, *poses.posed.shape[-1:], 4, 4), poses.graphs, poses.solutions, strict=True
    ):
        if graph is None or solution is None:
            means.append(0 * T_cw.sum() + torch.nan)  # a gradient of zero all the same
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
