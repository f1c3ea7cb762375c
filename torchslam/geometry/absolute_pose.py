"""The pose of a camera from points and their pixels, some of them wrong: RANSAC over P3P."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchslam.geometry.camera import Camera
from torchslam.geometry.estimate_gradients import (
    implicit_step,
    needs_gradient,
    refuse_transforms,
    with_zero_gradient,
)
from torchslam.geometry.lie import homogeneous, rigid, se3_exp, transform
from torchslam.geometry.p3p import p3p
from torchslam.geometry.precision import full_precision
from torchslam.geometry.projections import fit_projections, pose_tangent, squared_projections
from torchslam.geometry.ransac import (
    CONFIDENCE,
    SUPPORT_WIDTH,
    ModelState,
    best_models,
    best_of,
    check_search,
    count_distinct,
    gather_rows,
    is_significant,
    levenberg_marquardt,
    pose_rows,
    retract_pose,
    sample_minimal,
    sample_minimal_of_all,
    search,
    some_problems,
    truncated_rows,
    truncated_score,
    valid_first,
)
from torchslam.geometry.sensor import UndistortedKeypoints
from torchslam.utils.by_value import ByValue

FIRST_ROUND = 160  # samples; with 64, frames of sheared and blurred images are lost
CANDIDATES = 2  # hypotheses of each round that are optimized
LOCAL_ITERATIONS, FINAL_ITERATIONS = 1, 10
"""Of a hypothesis within the search, which only ranks it, and of the final refinement. Tried at these values only."""
FINAL_WIDTH = 1.5  # thresholds, for the tail of the noise; without this refinement more runs are lost
MAX_TURN_STD = math.radians(1.5)
"""Largest standard error of the rotation, radians, for noise of half a threshold: three of them are 5 degrees."""


@dataclass(frozen=True, eq=False)
class AbsolutePose(ByValue):
    """Absolute poses of B cameras.

    Attributes:
        T_cw: world to camera; the identity where there is no pose.
        inliers: points within the threshold of their pixel, in front of the camera.
        success: whether the inliers are significant and determine the rotation to 5 degrees (MAX_TURN_STD).
        score: sum over the points of 1 - min((error / threshold)^2, 1).
    """

    T_cw: Float[Tensor, "B 4 4"]
    inliers: Bool[Tensor, "B N"]
    success: Bool[Tensor, " B"]
    score: Float[Tensor, " B"]


@full_precision
def estimate_absolute_pose(
    points_w: Float[Tensor, "B N 3"],
    pixels: Float[Tensor, "B N 2"],
    *,
    camera: Camera,
    threshold: float = 2.0,
    mask: Bool[Tensor, "B N"] | None = None,
    seed: int = 0,
    confidence: float = CONFIDENCE,
    max_samples: int = 3000,
) -> AbsolutePose:
    """Estimate poses of B cameras by RANSAC over P3P, with local optimization and a least-squares refinement.

    The same arguments and seed give the same result. Where an input requires a gradient, T_cw carries that of the final
    least squares with respect to points, pixels and camera parameters, with the set of rows it uses fixed (implicit
    function theorem, exact Hessian). Sources: Fischler and Bolles, 1981; Chum et al., "Locally optimized RANSAC", 2003;
    for P3P see `p3p`. Too few points, points on a line or on too small a plane, and pure noise give `success` False.

    Args:
        camera: one for all, or a batch of B.
        threshold: reprojection error of an inlier, pixels.
        mask: rows in use; rows with NaN are never used.
        seed: of the random samples.
        confidence: probability that some sample has no outlier.
        max_samples: largest number of samples per camera.

    Raises:
        ValueError: A shape or a dtype does not fit.
        RuntimeError: It is called within a transform of `torch.func`.
    """
    refuse_transforms("estimate_absolute_pose")
    check_search(threshold, confidence, max_samples)
    B, N = pixels.shape[:2]
    if B == 0 or N < 3:
        nothing = torch.zeros(B, N, dtype=torch.bool, device=pixels.device)
        T_cw = torch.eye(4, dtype=points_w.dtype, device=points_w.device).repeat(B, 1, 1)
        T_cw = with_zero_gradient(T_cw, points_w, pixels, camera.params)
        score = torch.zeros_like(T_cw[:, 0, 0])
        return AbsolutePose(T_cw, nothing, score > 0, score)
    finite = torch.isfinite(points_w).all(-1) & torch.isfinite(pixels).all(-1)
    mask = finite if mask is None else mask & finite
    points_w = torch.where(mask[..., None], points_w, 0.0)
    pixels = torch.where(mask[..., None], pixels, 0.0)
    effort = seed, confidence, max_samples
    with torch.inference_mode():  # less work per operation than without gradients only
        results = _estimate(points_w.detach(), pixels.detach(), camera, threshold, mask, effort)
    T_cw, success, squared, score = (result.clone() for result in results)  # fit for graphs
    mask = mask & success[:, None]
    if needs_gradient(points_w, pixels, camera.params):
        used, found = (squared < FINAL_WIDTH**2) & mask, T_cw

        def objective(xi: Tensor) -> Tensor:
            projected, valid = camera.project(transform(se3_exp(xi) @ found, points_w))
            squared = (projected - pixels).square().sum(-1)
            return torch.where(used & valid, squared, 0.0).sum(-1)

        T_cw = se3_exp(implicit_step(objective, found[:, 0, :1].expand(-1, 6))) @ found
    return AbsolutePose(T_cw, (squared < 1) & mask, success, score)


@full_precision
@torch.no_grad()
def start_pose(
    points_w: Float[Tensor, "N 3"],
    undistorted: UndistortedKeypoints,
    size: tuple[int, int],
    threshold: float,
    seed: int = 0,
    confidence: float = CONFIDENCE,
    max_samples: int = 3000,
) -> Float[Tensor, "4 4"] | None:
    """Estimate the pose of one camera by RANSAC over P3P, as a start for a refinement.

    The same search as `estimate_absolute_pose`, in fewer calls for a single problem without a mask. Errors are those of
    undistorted coordinates, in pixels at each keypoint. The same arguments and seed give the same result.

    Args:
        undistorted: of the keypoints that see the points, which are finite.
        size: (width, height) of the image.
        threshold: reprojection error of an inlier, pixels.
        seed: of the random samples.
        confidence: probability that some sample has no outlier.
        max_samples: largest number of samples.

    Returns:
        T_cw, locally optimized on its inliers; None if wrong matches could agree as well, or if the inliers are on a
        line.
    """
    check_search(threshold, confidence, max_samples)
    if len(points_w) < 4:
        return None
    center = points_w.mean(0)
    points, xy = points_w - center, undistorted.xy.mT
    mask = torch.ones_like(points[None, :, 0], dtype=torch.bool)
    scale = (undistorted.pixel_scale / threshold)[None, :, None]
    search_data = _Search.of(points[None], xy[None], scale, mask, is_single=True)
    P = search_data.best_pose(seed, confidence, max_samples)
    P = search_data.fit(P[:, None], FINAL_ITERATIONS, FINAL_WIDTH)[0][:, 0]
    inliers = search_data.squared_errors(P) < 1
    if not bool(search_data.is_success(P, inliers, size, threshold)):
        return None
    P = P[0]
    T_cw = torch.eye(4, dtype=P.dtype, device=P.device)
    T_cw[:3] = P
    T_cw[:3, 3] -= P[:, :3] @ center
    return T_cw


def _estimate(
    points_w: Float[Tensor, "B N 3"],
    pixels: Float[Tensor, "B N 2"],
    camera: Camera,
    threshold: float,
    mask: Bool[Tensor, "B N"],
    effort: tuple[int, float, int],
) -> tuple[Float[Tensor, "B 4 4"], Bool[Tensor, " B"], Float[Tensor, "B N"], Float[Tensor, " B"]]:
    """T_cw, success, squared errors in thresholds and score. effort: seed, confidence, largest number of samples"""
    weights = mask[..., None].to(points_w.dtype)
    center = (points_w * weights).sum(1) / weights.sum(1).clamp_min(1.0)
    camera = camera.with_params(camera.params.detach().expand(len(points_w), -1))
    xy = camera.normalize(pixels)
    data = _Search.of(points_w - center[:, None], xy, camera.pixel_scale(xy) / threshold, mask)
    P = data.fit(data.best_pose(*effort)[:, None], FINAL_ITERATIONS, FINAL_WIDTH)[0][:, 0]
    if camera.model == "pinhole":  # whose undistorted coordinates are pixels up to their scale
        squared = data.squared_errors(P)
    else:

        def evaluate(P: Tensor) -> tuple[Tensor, Tensor]:
            points_c = (P @ data.homogeneous).mT
            projected, valid, J = camera.project_with_point_jacobians(points_c)
            residual = projected - pixels
            squared = (residual * residual).sum(-1).masked_fill(~valid, torch.inf) / threshold**2
            used, cost = truncated_rows(squared[:, None], mask, FINAL_WIDTH)
            rows = (
                torch.cat((pose_rows(J, points_c), residual[..., None]), dim=-1) * used[:, 0, :, None, None]
            )
            rows = rows.flatten(1, 2)
            return torch.bmm(rows.mT, rows), cost[:, 0]

        (P,), _ = levenberg_marquardt((P,), evaluate, retract_pose, FINAL_ITERATIONS)
        projected, valid = camera.project((P @ data.homogeneous).mT)
        # Infinite also beyond the monotone part of the distortion.
        squared = ((projected - pixels) / threshold).square().sum(-1).masked_fill(~valid, torch.inf)
    success = data.is_success(P, (squared < 1) & mask, camera.size, threshold)
    score = torch.where(mask, (1 - squared).clamp_min(0.0), 0.0).sum(-1)
    R, t = P[..., :3], P[..., 3]
    T_cw = rigid(R, t - (R @ center[..., None]).squeeze(-1))
    eye = torch.eye(4, dtype=P.dtype, device=P.device)
    return torch.where(success[:, None, None], T_cw, eye), success, squared, score


@dataclass(frozen=True)
class _Search:
    """The data of B searches in undistorted coordinates; points are about their mean: float32 is enough for scores.

    scale: thresholds per unit of xy, of one direction or of both; is_single: one problem in which all rows count
    """

    points: Float[Tensor, "B N 3"]
    rays: Float[Tensor, "B N 3"]
    homogeneous: Float[Tensor, "B 4 N"]
    xy: Float[Tensor, "B N 2"]
    scale: Float[Tensor, "B N _"]
    mask: Bool[Tensor, "B N"]
    is_single: bool

    @classmethod
    def of(cls, points: Tensor, xy: Tensor, scale: Tensor, mask: Tensor, is_single: bool = False) -> _Search:
        rays = homogeneous(xy)
        rays = rays / torch.linalg.vector_norm(rays, dim=-1, keepdim=True)
        return cls(points, rays, homogeneous(points).mT, xy, scale, mask, is_single)

    def select(self, rows: Tensor) -> _Search:
        """Some of the problems."""
        return self if len(rows) == len(self.points) else some_problems(self, rows)

    def best_pose(self, seed: int, confidence: float, max_samples: int) -> Float[Tensor, "B 3 4"]:
        """The pose of each problem with most support."""
        generator = torch.Generator().manual_seed(seed)
        (P,) = search(
            lambda rows, count: self.select(rows).propose(count, generator),
            self.mask.sum(-1),
            3,
            confidence,
            FIRST_ROUND,
            max_samples,
        )
        return P

    def propose(self, count: int, generator: torch.Generator) -> tuple[ModelState, Tensor, Tensor]:
        """The best pose from `count` minimal samples, locally optimized, its score and its support."""
        P = (self._candidates_of_one if self.is_single else self._candidates)(count, generator)
        if P.shape[1] == 0:
            none = torch.zeros_like(self.xy[:, 0, 0])
            return (P.new_zeros(len(P), 3, 4),), none - torch.inf, none
        P, cost = self.fit(P, LOCAL_ITERATIONS)
        (P,), cost = best_of((P,), cost)
        near = (self.squared_errors(P) < SUPPORT_WIDTH**2) & self.mask
        return (P,), self.mask.sum(-1) - cost, near.sum(-1)

    def _candidates(self, count: int, generator: torch.Generator) -> Float[Tensor, "B K 3 4"]:
        """The poses of best score from `count` minimal samples."""
        sample = sample_minimal(self.mask, 3, count, generator)
        R, t, valid = p3p(gather_rows(self.rays, sample), gather_rows(self.points, sample))
        R, t, valid = R.flatten(1, 2), t.flatten(1, 2), valid.flatten(1, 2)
        first = valid_first(valid)
        P = gather_rows(torch.cat((R, t[..., None]), dim=-1).flatten(2), first)
        count = min(CANDIDATES, P.shape[1])
        best = best_models(self.score, P, valid.gather(1, first), self.mask, count, generator)
        return gather_rows(P, best).unflatten(-1, (3, 4))

    def _candidates_of_one(self, count: int, generator: torch.Generator) -> Float[Tensor, "1 K 3 4"]:
        """`_candidates` of one problem in which all rows count, scored on all of them."""
        rows = sample_minimal_of_all(self.points.shape[1], 3, count, generator).to(self.points.device)
        R, t, valid = p3p(self.rays[0][rows], self.points[0][rows])
        P = torch.cat((R, t[..., None]), dim=-1)[valid]
        squared = squared_projections(
            P.float()[None], self.homogeneous.float(), self.xy.float(), self.scale.float()
        )
        costs = squared[0].clamp_max_(1.0).nan_to_num_(1.0).sum(1)
        return P[costs.topk(min(CANDIDATES, len(P)), largest=False).indices][None]

    def score(self, P: Float[Tensor, "B K 12"], rows: Int[Tensor, "B n"] | None) -> Float[Tensor, "B K"]:
        """Truncated scores of many poses on some of the points, or all, in float32."""
        homogeneous, xy, scale, mask = self.homogeneous.mT, self.xy, self.scale, self.mask
        if rows is not None:
            homogeneous, xy, scale = (gather_rows(values, rows) for values in (homogeneous, xy, scale))
            mask = mask.gather(1, rows)
        P = P.float().unflatten(-1, (3, 4))
        return truncated_score(squared_projections(P, homogeneous.mT.float(), xy.float(), scale), mask)

    def fit(
        self, P: Float[Tensor, "B K 3 4"], iterations: int, width: float = 1.0
    ) -> tuple[Float[Tensor, "B K 3 4"], Float[Tensor, "B K"]]:
        """Poses of least truncated error, and their costs; width: of the kernel, in thresholds."""
        tangent = pose_tangent(P.dtype, P.device)
        return fit_projections(
            P, tangent, self.homogeneous, self.xy, self.scale, self.mask, iterations, width
        )

    def squared_errors(self, P: Float[Tensor, "B 3 4"]) -> Float[Tensor, "B N"]:
        """Squared errors in thresholds of one pose per problem; infinite behind the camera."""
        squared = squared_projections(P[:, None], self.homogeneous, self.xy, self.scale)
        return squared[:, 0].nan_to_num(torch.inf)

    def is_success(
        self, P: Float[Tensor, "B 3 4"], inliers: Bool[Tensor, "B N"], size: tuple[int, int], threshold: float
    ) -> Bool[Tensor, " B"]:
        """Test whether inliers are significant and determine the rotation: repeated points count once."""
        points_c = torch.where(inliers[..., None], (P @ self.homogeneous).mT, 1.0)
        depth = points_c[..., 2:]
        xy, scale = points_c[..., :2] / depth, self.scale.mean(-1, keepdim=True)
        # Thresholds in the image, and as much in depth.
        distinct, available = count_distinct(
            torch.cat((xy, depth.log()), dim=-1) * scale, inliers, self.mask.sum(-1)
        )
        chance = torch.full_like(
            inliers[:, 0], math.pi * threshold**2 / (size[0] * size[1]), dtype=torch.float64
        )
        significant = is_significant(distinct, available, 3, chance, solutions=4)
        # Information of the inliers in thresholds, with the mean depth as the unit, and a prior of one on everything.
        count = inliers.sum(-1)[:, None, None].clamp_min(1)
        eye = torch.eye(6, dtype=P.dtype, device=P.device)
        unit = (depth * inliers[..., None]).sum(1, keepdim=True) / count
        J = torch.cat((eye[:2, :2].expand(*xy.shape, 2), -xy[..., None]), dim=-1) * (unit / depth)[..., None]
        rows = pose_rows(J, points_c / unit) * (scale * inliers[..., None])[..., None]
        rows = rows.flatten(1, 2)
        information = rows.mT @ rows * (distinct[:, None, None] / count)
        covariance = torch.linalg.inv_ex(information + eye)[0]  # NaN without a pose, which is not below
        return significant & (covariance[:, range(3, 6), range(3, 6)].sum(-1).sqrt() < 2 * MAX_TURN_STD)
