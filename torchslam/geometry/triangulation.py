"""Points from their pixels in two or many views, with parallax angle, depths and reprojection errors."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchslam.geometry.camera import Camera
from torchslam.geometry.gating import inverse_2x2, whitening
from torchslam.geometry.lie import homogeneous, se3_inverse, skew, transform
from torchslam.geometry.precision import full_precision
from torchslam.utils.by_value import ByValue


@dataclass(frozen=True, eq=False)
class Triangulation(ByValue):
    """Points seen in two views. Invalid rows are finite.

    Attributes:
        points_w: points.
        angles: parallax between the two rays at the point, radians.
        depths_1: z in camera 1.
        depths_2: z in camera 2.
        errors_1: reprojection error in pixels; infinite where the point does not project. `errors_2`: in view 2.
        mask: the input mask, where the rays intersect in front of both cameras.
    """

    points_w: Float[Tensor, "*batch N 3"]
    angles: Float[Tensor, "*batch N"]
    depths_1: Float[Tensor, "*batch N"]
    depths_2: Float[Tensor, "*batch N"]
    errors_1: Float[Tensor, "*batch N"]
    errors_2: Float[Tensor, "*batch N"]
    mask: Bool[Tensor, "*batch N"]


@dataclass(frozen=True, eq=False)
class MultiViewTriangulation(ByValue):
    """Points seen in up to V views. Invalid rows are finite.

    Attributes:
        points_w: points.
        angles: largest parallax between two of the rays, radians.
        depths: z in each camera.
        errors: reprojection error in pixels; infinite where the point does not project.
        mask: seen in two views or more, and in front of all cameras that see it.
    """

    points_w: Float[Tensor, "*batch N 3"]
    angles: Float[Tensor, "*batch N"]
    depths: Float[Tensor, "*batch N V"]
    errors: Float[Tensor, "*batch N V"]
    mask: Bool[Tensor, "*batch N"]


@full_precision
def triangulate(
    pixels_1: Float[Tensor, "*#batch N 2"],
    pixels_2: Float[Tensor, "*#batch N 2"],
    *,
    T_1w: Float[Tensor, "*#batch 4 4"],
    T_2w: Float[Tensor, "*#batch 4 4"],
    camera_1: Camera,
    camera_2: Camera,
    mask: Bool[Tensor, "*#batch N"] | None = None,
    normalized: tuple[Float[Tensor, "*#batch N 2"], Float[Tensor, "*#batch N 2"]] | None = None,
) -> Triangulation:
    """Triangulate matches of two views, with the least squared error in undistorted coordinates.

    Differentiable with respect to poses, pixels and camera parameters. No threshold is applied: reject by `angles`,
    `depths` and `errors`. Source: Lindstrom, "Triangulation made easy", 2010 (two iterations, exact to far below
    the noise).

    Args:
        mask: matches in use; rows outside it may hold anything.
        normalized: the undistorted coordinates of both pixels, if the caller has them already.
    """
    finite = torch.isfinite(pixels_1).all(-1) & torch.isfinite(pixels_2).all(-1)
    mask = finite if mask is None else mask & finite
    x_1, x_2 = normalized or (camera_1.normalize(pixels_1), camera_2.normalize(pixels_2))
    x_1, x_2 = (torch.where(mask[..., None], x, 0.0) for x in (x_1, x_2))
    T_21 = T_2w @ se3_inverse(T_1w)
    R_21, t_21 = T_21[..., :3, :3], T_21[..., :3, 3]
    x_1, x_2 = correct_matches(skew(t_21) @ R_21, x_1, x_2)

    h_1, ray_2 = homogeneous(x_1), homogeneous(x_2)
    ray_1 = h_1 @ R_21.mT
    t = t_21[..., None, :].expand_as(ray_1)
    normal = torch.linalg.cross(ray_1, ray_2, dim=-1)
    normal_squared = (normal * normal).sum(-1)
    # depth_2 ray_2 = depth_1 ray_1 + t, each depth after a cross product with the other ray
    tiny = torch.finfo(x_1.dtype).eps ** 2
    intersects = normal_squared > tiny
    depth_1 = -(torch.linalg.cross(t, ray_2, dim=-1) * normal).sum(-1)
    depth_1 = depth_1 / torch.where(intersects, normal_squared, 1.0)
    depth_1 = torch.where(intersects & (depth_1 != 0), depth_1, 1.0)
    points_1 = depth_1[..., None] * h_1
    points_2 = transform(T_21, points_1)
    depth_2 = points_2[..., 2]

    mask = mask & intersects & (depth_1 > 0) & (depth_2 > 0)
    angles = _angle(depth_1[..., None] * ray_1, points_2)
    errors_1 = _reprojection_error(camera_1, points_1, pixels_1, mask)
    errors_2 = _reprojection_error(camera_2, points_2, pixels_2, mask)
    points_w = transform(se3_inverse(T_1w), points_1)
    return Triangulation(points_w, angles, depth_1, depth_2, errors_1, errors_2, mask)


@full_precision
def triangulation_covariance(
    T_1w: Float[Tensor, "*#batch 4 4"],
    T_2w: Float[Tensor, "*#batch 4 4"],
    points_w: Float[Tensor, "*#batch N 3"],
    sigmas_1: Float[Tensor, "*#batch N"] | Float[Tensor, "*#batch N 2 2"],
    sigmas_2: Float[Tensor, "*#batch N"] | Float[Tensor, "*#batch N 2 2"],
    camera_1: Camera,
    camera_2: Camera,
) -> Float[Tensor, "*#batch N 3 3"]:
    """Covariances (sum of J^T J / sigma^2)^-1 of points triangulated from two views with exact poses.

    Zero where the views do not determine a point: no parallax, or not in front of both. `sigmas_1` and `sigmas_2` are
    standard deviations of the pixels, or their covariances.
    """
    information = torch.zeros_like(points_w[..., None] * points_w[..., None, :])
    determined = torch.ones_like(points_w[..., 0], dtype=torch.bool)
    for T_cw, sigmas, camera in ((T_1w, sigmas_1, camera_1), (T_2w, sigmas_2, camera_2)):
        _, valid, J_c = camera.project_with_point_jacobians(transform(T_cw, points_w))
        J = J_c @ T_cw[..., None, :3, :3]
        is_matrix = sigmas.ndim > 1 and sigmas.shape[-2:] == (2, 2) and sigmas.ndim == points_w.ndim + 1
        J = whitening(inverse_2x2(sigmas)) @ J if is_matrix else J / sigmas[..., None, None]
        information, determined = information + J.mT @ J, determined & valid
    eye = torch.eye(3, dtype=points_w.dtype, device=points_w.device)
    size = information.detach().diagonal(dim1=-2, dim2=-1).sum(-1)
    determined &= torch.linalg.det(information.detach()) > 100 * torch.finfo(eye.dtype).eps * size**3
    covariances = torch.linalg.inv(torch.where(determined[..., None, None], information, eye))
    return torch.where(determined[..., None, None], covariances, 0.0)


@full_precision
def correct_matches(
    E: Float[Tensor, "*#batch 3 3"], x_1: Float[Tensor, "*#batch N 2"], x_2: Float[Tensor, "*#batch N 2"]
) -> tuple[Float[Tensor, "*#batch N 2"], Float[Tensor, "*#batch N 2"]]:
    """Move matches by the least squared distance, over both images, onto the epipolar constraint x_2^T E x_1 = 0.

    In undistorted image coordinates. Source: Lindstrom, "Triangulation made easy", 2010.
    """
    E_22 = E[..., :2, :2]
    h_2, line_2 = homogeneous(x_2), homogeneous(x_1) @ E.mT
    n_1, n_2 = (h_2 @ E)[..., :2], line_2[..., :2]
    constraint = (h_2 * line_2).sum(-1)
    b = 0.5 * ((n_1 * n_1).sum(-1) + (n_2 * n_2).sum(-1))
    a = ((n_2 @ E_22) * n_1).sum(-1)
    regular = b > torch.finfo(b.dtype).tiny
    discriminant = b * b - a * constraint
    root = torch.where(regular & (discriminant > 0), discriminant, 1.0).sqrt()
    step = torch.where(regular, constraint / torch.where(regular, b + root, 1.0), 0.0)[..., None]
    moved_1, moved_2 = n_1 - step * (n_2 @ E_22), n_2 - step * (n_1 @ E_22.mT)
    length = ((moved_1 * moved_1).sum(-1) + (moved_2 * moved_2).sum(-1))[..., None]
    regular = regular[..., None] & (length > torch.finfo(b.dtype).tiny)
    step = torch.where(regular, step * 2 * root[..., None] / torch.where(regular, length, 1.0), 0.0)
    return x_1 - step * moved_1, x_2 - step * moved_2


@full_precision
def triangulate_many(
    pixels: Float[Tensor, "*#batch N V 2"],
    *,
    T_cw: Float[Tensor, "*#batch V 4 4"],
    camera: Camera,
    mask: Bool[Tensor, "*#batch N V"] | None = None,
    iterations: int = 3,
) -> MultiViewTriangulation:
    """Triangulate points from V views: linear on the rays, then Gauss-Newton on the reprojection error.

    Differentiable with respect to poses, pixels and camera parameters. No threshold is applied: reject by `angles`,
    `depths` and `errors`.

    Args:
        pixels: observations; entries outside the mask may hold anything.
        camera: of all views.
        mask: which views see the point.
        iterations: of Gauss-Newton.
    """
    seen = torch.isfinite(pixels).all(-1)
    seen = seen if mask is None else seen & mask
    pixels = torch.where(seen[..., None], pixels, 0.0)
    rays_c = camera.unproject(pixels.flatten(-3, -2)).unflatten(-2, pixels.shape[-3:-1])
    R_cw, t_cw = T_cw[..., None, :, :3, :3], T_cw[..., None, :, :3, 3]
    rays_w = (R_cw.mT @ rays_c[..., None]).squeeze(-1)
    centers_w = -(R_cw.mT @ t_cw[..., None]).squeeze(-1)

    eye = torch.eye(3, dtype=pixels.dtype, device=pixels.device)
    across = (eye - rays_w[..., :, None] * rays_w[..., None, :]) * seen[..., None, None]
    points_w = _solve_3x3(across.sum(-3), (across @ centers_w[..., None]).sum(-3).squeeze(-1))
    for _ in range(iterations):
        points_w = _refine_points(points_w, T_cw, pixels, camera, seen)

    points_c = (R_cw @ points_w[..., None, :, None]).squeeze(-1) + t_cw
    depths = points_c[..., 2]
    mask = (seen.sum(-1) >= 2) & ((depths > 0) | ~seen).all(-1)
    flat, flat_pixels = points_c.flatten(-3, -2), pixels.flatten(-3, -2)
    errors = _reprojection_error(camera, flat, flat_pixels, seen.flatten(-2)).unflatten(-1, seen.shape[-2:])
    rays, pairs = points_w[..., None, :] - centers_w, seen[..., :, None] & seen[..., None, :]
    between = _angle(*torch.broadcast_tensors(rays[..., :, None, :], rays[..., None, :, :]))
    angles = torch.where(pairs, between, 0.0).amax((-2, -1))
    return MultiViewTriangulation(points_w, angles, depths, errors, mask)


def _refine_points(points_w: Tensor, T_cw: Tensor, pixels: Tensor, camera: Camera, seen: Tensor) -> Tensor:
    """One Gauss-Newton step on the reprojection errors, kept for each point only if it helps."""

    def residuals(points_w: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        points_c = (R_cw @ points_w[..., None, :, None]).squeeze(-1) + t_cw
        projected, valid, J = camera.project_with_point_jacobians(points_c.flatten(-3, -2))
        projected, J = projected.unflatten(-2, shape), J.unflatten(-3, shape)
        used = seen & valid.unflatten(-1, shape)
        residual = torch.where(used[..., None], projected - pixels, 0.0)
        return residual, torch.where(used[..., None, None], J @ R_cw, 0.0), (used == seen).all(-1)

    shape = seen.shape[-2:]
    R_cw, t_cw = T_cw[..., None, :, :3, :3], T_cw[..., None, :, :3, 3]
    residual, J, valid = residuals(points_w)
    H, g = (J.mT @ J).sum(-3), (J.mT @ residual[..., None]).sum(-3).squeeze(-1)
    moved = points_w - _solve_3x3(H, g)
    with torch.no_grad():
        after, _, still_valid = residuals(moved)
        # The tolerance, far below a pixel, lets exact data take the step too, which gives it the right gradient.
        before = (residual * residual).sum((-2, -1)) + 1e-6
        better = still_valid & ((after * after).sum((-2, -1)) <= before)
        better = better & valid & torch.isfinite(moved).all(-1)
    return torch.where(better[..., None], moved, points_w)


def _solve_3x3(A: Float[Tensor, "*batch 3 3"], b: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """A^-1 b by the adjugate; zero where A is singular."""
    columns = A.unbind(-1)
    rows = torch.stack([torch.linalg.cross(columns[i - 2], columns[i - 1], dim=-1) for i in range(3)], dim=-2)
    determinant = (rows[..., 0, :] * columns[0]).sum(-1)
    scale = A.detach().abs().amax((-2, -1))
    regular = determinant.abs() > scale**3 * torch.finfo(A.dtype).eps ** 2
    x = (rows @ b[..., None]).squeeze(-1) / torch.where(regular, determinant, 1.0)[..., None]
    return torch.where(regular[..., None], x, 0.0)


def _length(v: Tensor) -> Tensor:
    """Euclidean norm with gradient zero, not NaN, at zero."""
    squared = (v * v).sum(-1)
    zero = squared == 0
    return torch.where(zero, 0.0, torch.where(zero, 1.0, squared).sqrt())


def _angle(u: Tensor, v: Tensor) -> Tensor:
    """Angle between vectors, accurate for small angles, radians."""
    dot = (u * v).sum(-1)
    sine = _length(torch.linalg.cross(u, v, dim=-1))
    return torch.atan2(sine, torch.where((sine == 0) & (dot == 0), 1.0, dot))


def _reprojection_error(camera: Camera, points_c: Tensor, pixels: Tensor, mask: Tensor) -> Tensor:
    """Distance in pixels between projections and measurements; infinite outside the mask or where invalid."""
    projected, valid = camera.project(points_c)
    used = mask & valid
    error = _length(torch.where(used[..., None], projected - pixels, 0.0))
    return torch.where(used, error, torch.inf)
