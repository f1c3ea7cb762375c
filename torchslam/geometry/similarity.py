"""The similarity between two maps, from pairs of points in the coordinates of two cameras, some of them wrong."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchslam.geometry.absolute_pose import CANDIDATES, FINAL_ITERATIONS, FINAL_WIDTH, FIRST_ROUND
from torchslam.geometry.camera import Camera
from torchslam.geometry.estimate_gradients import needs_gradient, refuse_transforms
from torchslam.geometry.lie import homogeneous, rigid, se3_inverse, sim3_inverse, so3_exp, transform, vee
from torchslam.geometry.precision import check_positive, full_precision
from torchslam.geometry.projections import squared_projections
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
    leave_a_line,
    levenberg_marquardt,
    pose_rows,
    retract_pose,
    sample_minimal,
    search,
    some_problems,
    truncated_rows,
    truncated_score,
)
from torchslam.geometry.transforms import without_scale
from torchslam.utils.by_value import ByValue


@full_precision
def umeyama(
    source: Float[Tensor, "*#batch N 3"],
    target: Float[Tensor, "*#batch N 3"],
    weights: Float[Tensor, "*#batch N"] | Bool[Tensor, "*#batch N"] | None = None,
    with_scale: bool = True,
) -> tuple[Float[Tensor, "*#batch"], Float[Tensor, "*#batch 3 3"], Float[Tensor, "*#batch 3"]]:
    """Align points by the similarity that minimizes sum_i w_i |target_i - (s R source_i + t)|^2.

    Differentiable up to the third order in points and weights, on exact data and at repeated singular values too: the
    rotation's gradients come from the optimality condition, not from the singular vectors.
    With fewer than three points, or collinear ones, the result is finite and one of many minimizers, and its
    gradient leaves out the free direction. Points at one place up to rounding have scale one and the identity as
    rotation, without gradient. Source: Umeyama, "Least-squares estimation of transformation parameters
    between two point patterns", 1991.

    Args:
        weights: weights or a boolean mask; rows without a finite weight above zero do not count and may hold anything.
        with_scale: False fixes the scale to one.

    Returns:
        Scale, rotation and translation; NaN, with a gradient of zero, where a row that counts is not finite.
    """
    w = torch.ones_like(source[..., 0]) if weights is None else weights.to(source.dtype)
    w = torch.where((w > 0) & torch.isfinite(w), w, 0.0)
    used = (w > 0)[..., None]
    rows = used & torch.isfinite(source) & torch.isfinite(target)
    finite = (rows.all(-1) | ~used[..., 0]).all(-1)
    used, w = used & finite[..., None, None], torch.where(finite[..., None], w, 0.0)
    source, target = torch.where(used, source, 0.0), torch.where(used, target, 0.0)
    w = (w / w.sum(-1, keepdim=True).clamp_min(torch.finfo(w.dtype).tiny))[..., None]
    mean_source, mean_target = (w * source).sum(-2), (w * target).sum(-2)
    spread_source, spread_target = _is_spread(w, source, mean_source), _is_spread(w, target, mean_target)
    x = torch.where(spread_source, source - mean_source[..., None, :], 0.0)
    y = torch.where(spread_target, target - mean_target[..., None, :], 0.0)
    covariance = (w * y).mT @ x
    R = nearest_rotation(covariance)
    if with_scale:
        variance = (w * x * x).sum((-2, -1))
        spread = spread_source[..., 0, 0]
        scale = (R * covariance).sum((-2, -1)) / torch.where(spread, variance, 1.0)
        scale = torch.where(spread, scale, 1.0)
    else:
        scale = torch.ones_like(mean_source[..., 0])
    t = mean_target - scale[..., None] * (R @ mean_source[..., None]).squeeze(-1)
    finite = finite[..., None, None]
    scale, R = torch.where(finite[..., 0, 0], scale, torch.nan), torch.where(finite, R, torch.nan)
    return scale, R, torch.where(finite[..., 0], t, torch.nan)


def _is_spread(
    w: Float[Tensor, "*batch N 1"], points: Float[Tensor, "*batch N 3"], mean: Float[Tensor, "*batch 3"]
) -> Bool[Tensor, "*batch 1 1"]:
    """Test whether points differ from their weighted mean by more than rounding."""
    variance = (w * (points - mean[..., None, :]).detach().square()).sum((-2, -1))
    eps, size = torch.finfo(w.dtype).eps, (w * points.detach().square()).sum((-2, -1))
    return (variance > (16 * eps) ** 2 * size + torch.finfo(w.dtype).tiny)[..., None, None]


def align_poses(
    T_ac: Float[Tensor, "N 4 4"], T_bc: Float[Tensor, "N 4 4"], use_centers: bool = False
) -> Float[Tensor, "4 4"]:
    """Compute the similarity S_ba from poses of cameras in one world to the same cameras' poses in another.

    Its rotation is the mean of those of the cameras, so that centers on a line, or close to each other, determine it
    too. Its scale is the ratio of the spreads of the centers, one where those of either world are at one place.

    Args:
        use_centers: let centers and orientations count equally in the rotation.
    """
    M = (T_bc[:, :3, :3] @ T_ac[:, :3, :3].mT).sum(0)
    a, b = T_ac[:, :3, 3], T_bc[:, :3, 3]
    mean_a, mean_b = a.mean(0), b.mean(0)
    spread_a, spread_b = ((x - m).square().sum().sqrt() for x, m in ((a, mean_a), (b, mean_b)))
    least = torch.finfo(a.dtype).tiny
    rounding = 16 * torch.finfo(a.dtype).eps
    have_extent = (spread_a > rounding * a.norm() + least) & (spread_b > rounding * b.norm() + least)
    if use_centers:
        M = M / len(T_ac) + (b - mean_b).mT @ (a - mean_a) / (spread_a * spread_b).clamp_min(least)
    R = nearest_rotation(M)
    scale = torch.where(have_extent, spread_b / spread_a.clamp_min(least), 1.0)
    return rigid(scale * R, mean_b - scale * R @ mean_a)


def in_place_of(
    T_cb: Float[Tensor, "N 4 4"], T_ca: Float[Tensor, "N 4 4"], points_a: Float[Tensor, "P 3"]
) -> tuple[Float[Tensor, "N 4 4"], Float[Tensor, "P 3"]]:
    """Poses T_ca and points with the place and the unit that poses T_cb of the same cameras have, see `align_poses`."""
    S_ba = align_poses(se3_inverse(T_ca), se3_inverse(T_cb))
    return without_scale(T_ca @ sim3_inverse(S_ba)), transform(S_ba, points_a)


_ORDERS = 3
"""Of derivatives of a rotation that are right: a Newton step of a loss whose gradient is trained takes as many. Tried
at 2 and 3."""


def nearest_rotation(M: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The rotation that maximizes tr(R^T M), with finite gradients that are right up to the third order.

    At the maximum S = M R^T is symmetric; for a change of M the rotation moves by exp(omega) with
    (tr(S) I - S) omega = vee(2 antisymmetric part of dM R^T). This is a step of Newton's method with a fixed matrix:
    each one makes the derivatives of one more order right.
    """
    fixed = M.detach()
    U, singular, Vh = torch.linalg.svd(fixed)
    sign = torch.ones_like(singular)
    sign[..., 2] = torch.where(torch.linalg.det(U @ Vh) < 0, -1.0, 1.0)
    R = (U * sign[..., None, :]) @ Vh
    if not needs_gradient(M):
        return R
    # In the basis U, S is diag(singular * sign) and the system is diagonal.
    s = singular * sign
    stiffness = torch.stack((s[..., 1] + s[..., 2], s[..., 0] + s[..., 2], s[..., 0] + s[..., 1]), dim=-1)
    free = stiffness <= 1e-12 * singular[..., :1] + torch.finfo(M.dtype).tiny
    for _ in range(_ORDERS):
        residual = 2 * vee(M @ R.mT)
        in_basis = (U.mT @ residual[..., None]).squeeze(-1)
        omega = torch.where(free, 0.0, in_basis / torch.where(free, 1.0, stiffness))
        omega = (U @ omega[..., None]).squeeze(-1)
        R = so3_exp(omega - omega.detach()) @ R
    return R


_DISTINCT = 2.0  # thresholds, in both images together, up to which pairs may be one that is repeated
_LOCAL_ITERATIONS = 2
"""Of a hypothesis within the search, which only ranks it. Tried at this value only."""


@dataclass(frozen=True, eq=False)
class Similarity(ByValue):
    """Similarities between the coordinates of B pairs of cameras.

    Attributes:
        S_21: from camera 1 to camera 2; the identity where there is none.
        inliers: pairs of points within the threshold of their pixels in both images.
        success: whether the inliers are significant and not all on one line.
        score: sum over the pairs of 1 - min((larger error / threshold)^2, 1).
    """

    S_21: Float[Tensor, "B 4 4"]
    inliers: Bool[Tensor, "B N"]
    success: Bool[Tensor, " B"]
    score: Float[Tensor, " B"]


@full_precision
def estimate_similarity(
    points_1: Float[Tensor, "B N 3"],
    points_2: Float[Tensor, "B N 3"],
    pixels_1: Float[Tensor, "B N 2"],
    pixels_2: Float[Tensor, "B N 2"],
    *,
    camera_1: Camera,
    camera_2: Camera,
    sigmas_1: Float[Tensor, "B N"] | None = None,
    sigmas_2: Float[Tensor, "B N"] | None = None,
    threshold: float = 3.035,
    depth_sigma: float = 0.1,
    mask: Bool[Tensor, "B N"] | None = None,
    seed: int = 0,
    with_scale: bool = True,
    confidence: float = CONFIDENCE,
    max_samples: int = 3000,
) -> Similarity:
    """Estimate similarities of B pairs of cameras by RANSAC over three pairs of points, with a refinement in pixels.

    The same arguments and seed give the same result, which is detached. Too few pairs, points on a line, or pure
    noise give `success` False for that pair of cameras. Sources: Horn, "Closed-form solution of absolute
    orientation using unit quaternions", 1987; Mur-Artal et al., "ORB-SLAM: a versatile and accurate monocular SLAM
    system", 2015, section VII-B; for the minimal solution `umeyama`.

    Args:
        points_1: points in the coordinates of camera 1; `points_2`: the same ones in those of camera 2.
        pixels_1: where camera 1 saw them; `pixels_2`: where camera 2 did.
        camera_1: one or B, as `camera_2`.
        sigmas_1: standard deviations of `pixels_1`, pixels; None: one. `sigmas_2`: of `pixels_2`.
        threshold: reprojection error of an inlier in standard deviations, of the points of each camera in the other
            image; 99 % of two-dimensional normal errors are below 3.035.
        depth_sigma: relative standard deviation of the depths in camera 2. They determine the scale where both
            cameras are at one place, as in a loop closure, and pixels do not depend on it.
        mask: pairs in use; pairs that are not finite, behind their camera, or with a sigma not above zero
            are never used.
        with_scale: False fixes the scale to one.
        confidence: probability that some sample has no outlier.
        max_samples: largest number of samples per pair of cameras.

    Raises:
        ValueError: A shape or a dtype does not fit.
        RuntimeError: It is called within a transform of `torch.func`.
    """
    refuse_transforms("estimate_similarity")
    check_search(threshold, confidence, max_samples)
    check_positive(depth_sigma=depth_sigma)
    given = points_1, points_2, pixels_1, pixels_2
    sigmas = tuple(torch.ones_like(points_1[..., 0]) if s is None else s for s in (sigmas_1, sigmas_2))
    positive = torch.stack((points_1[..., 2], points_2[..., 2], *sigmas), dim=-1)
    use = (positive > 0).all(-1) & torch.isfinite(torch.cat((*given, positive), dim=-1)).all(-1)
    use = use if mask is None else use & mask
    B, N = use.shape
    if B == 0 or N < 3:
        S_21 = torch.eye(4, dtype=points_1.dtype, device=points_1.device).repeat(B, 1, 1)
        score = torch.zeros_like(S_21[:, 0, 0])
        return Similarity(S_21, torch.zeros_like(use), score > 0, score)
    points_1, points_2, pixels_1, pixels_2 = (torch.where(use[..., None], x, 0.0).detach() for x in given)
    sigmas = tuple(torch.where(use, sigma, 1.0).detach() for sigma in sigmas)
    with torch.inference_mode():  # less work per operation than without gradients only
        forward = _View.of(points_1, pixels_2, sigmas[1], camera_2, threshold)
        backward = _View.of(points_2, pixels_1, sigmas[0], camera_1, threshold)
        problem = _Problem(forward, backward, use, with_scale, threshold * depth_sigma)
        results = problem.solve(seed, confidence, max_samples)
    S_21, success, squared, score = (result.clone() for result in results)  # fit for graphs
    return Similarity(S_21, (squared < 1) & use & success[:, None], success, score)


@dataclass(frozen=True)
class _View:
    """One direction: points of the other camera, and where this one saw them; sigmas are thresholds in pixels.

    normalized: undistorted pixels; scale: thresholds per unit of them
    """

    points: Float[Tensor, "B N 3"]
    pixels: Float[Tensor, "B N 2"]
    sigmas: Float[Tensor, "B N"]
    camera: Camera
    normalized: Float[Tensor, "B N 2"]
    scale: Float[Tensor, "B N 2"]

    @staticmethod
    def of(points: Tensor, pixels: Tensor, sigmas: Tensor, camera: Camera, threshold: float) -> _View:
        camera = camera.with_params(camera.params.detach().expand(len(points), -1))
        normalized, sigmas = camera.normalize(pixels), threshold * sigmas
        scale = camera.pixel_scale(normalized) / sigmas[..., None]
        return _View(points, pixels, sigmas, camera, normalized, scale)

    def undistorted_errors(
        self, P: Float[Tensor, "B K 3 4"], rows: Int[Tensor, "B n"] | None = None
    ) -> Float[Tensor, "B K _"]:
        """Squared errors of many mappings in thresholds; infinite or NaN behind the camera."""
        points, x, scale = self.points, self.normalized, self.scale
        if rows is not None:
            points, x, scale = (gather_rows(values, rows) for values in (points, x, scale))
        return squared_projections(P, homogeneous(points).mT.to(P.dtype), x.to(P.dtype), scale)

    def residuals(
        self, P: Float[Tensor, "B 3 4"]
    ) -> tuple[Float[Tensor, "B N 3"], Float[Tensor, "B N 2"], Float[Tensor, "B N 2 3"], Bool[Tensor, "B N"]]:
        """Moved points, residuals in thresholds, their derivatives in the moved points, and validity."""
        moved = transform(P, self.points)
        projected, valid, J = self.camera.project_with_point_jacobians(moved)
        inverse = 1 / self.sigmas[..., None]
        return moved, (projected - self.pixels) * inverse, J * inverse[..., None], valid


@dataclass(frozen=True)
class _Problem:
    """Camera 1's points in camera 2, and the reverse. depth_sigma: threshold of relative differences in depth"""

    forward: _View
    backward: _View
    mask: Bool[Tensor, "B N"]
    with_scale: bool
    depth_sigma: float

    def select(self, rows: Tensor) -> _Problem:
        """Some of the problems."""
        forward, backward = some_problems(self.forward, rows), some_problems(self.backward, rows)
        return replace(self, forward=forward, backward=backward, mask=self.mask[rows])

    def solve(
        self, seed: int, confidence: float, max_samples: int
    ) -> tuple[Float[Tensor, "B 4 4"], Bool[Tensor, " B"], Float[Tensor, "B N"], Float[Tensor, " B"]]:
        """S_21, success, squared errors in thresholds and score."""
        generator = torch.Generator().manual_seed(seed)
        (P,) = search(
            lambda rows, count: self.select(rows).propose(count, generator),
            self.mask.sum(-1),
            3,
            confidence,
            FIRST_ROUND,
            max_samples,
        )
        P, _ = self.fit(P, FINAL_ITERATIONS, FINAL_WIDTH)
        squared = self.larger_errors(P)
        # A wrong pair has to fit in both images, but the one makes the other more likely: only one is counted.
        inliers, count = (squared < 1) & self.mask, self.mask.sum(-1)
        areas = [
            (view.sigmas.square() * self.mask).sum(-1) * math.pi / (view.camera.width * view.camera.height)
            for view in (self.forward, self.backward)
        ]
        chance = torch.maximum(*areas).double() / count.clamp_min(1)
        views = self.forward, self.backward
        places = torch.cat([view.normalized * view.scale for view in views], dim=-1) / _DISTINCT
        success = is_significant(*count_distinct(places, inliers, count), 3, chance, solutions=1)
        for view in (self.forward, self.backward):
            success = success & leave_a_line(view.points, inliers)
        score = torch.where(self.mask, (1 - squared).clamp_min(0.0), 0.0).sum(-1)
        eye = torch.eye(4, dtype=P.dtype, device=P.device)
        S_21 = torch.where(success[:, None, None], rigid(P[..., :3], P[..., 3]), eye)
        return S_21, success, squared, score

    def propose(self, count: int, generator: torch.Generator) -> tuple[ModelState, Tensor, Tensor]:
        """The best similarity from `count` minimal samples, locally optimized, its score and its support."""
        sample = sample_minimal(self.mask, 3, count, generator)
        source, target = (gather_rows(view.points, sample) for view in (self.forward, self.backward))
        scale, R, t = umeyama(source, target, with_scale=self.with_scale)
        P = torch.cat((scale[..., None, None] * R, t[..., None]), dim=-1).flatten(2)
        valid = torch.isfinite(P).all(-1) & (scale > torch.finfo(P.dtype).eps)
        best = best_models(self.score, P, valid, self.mask, CANDIDATES, generator)
        # Samples of equal points have no scale; what stands in for them is finite.
        safe = torch.eye(3, 4, dtype=P.dtype, device=P.device).flatten()
        P = gather_rows(torch.where(valid[..., None], P, safe), best).flatten(0, 1).unflatten(-1, (3, 4))
        each = self.select(torch.arange(len(self.mask), device=P.device).repeat_interleave(CANDIDATES))
        P, cost = each.fit(P, _LOCAL_ITERATIONS, 1.0)
        (P,), cost = best_of((P.unflatten(0, (-1, CANDIDATES)),), cost.unflatten(0, (-1, CANDIDATES)))
        near = (self.larger_errors(P) < SUPPORT_WIDTH**2) & self.mask
        return (P,), self.mask.sum(-1) - cost, near.sum(-1)

    def score(self, P: Float[Tensor, "B K 12"], rows: Int[Tensor, "B n"] | None) -> Float[Tensor, "B K"]:
        """Truncated scores of many similarities on some of the pairs, or all, in float32."""
        P = P.unflatten(-1, (3, 4))
        there = self.forward.undistorted_errors(P.float(), rows)
        back = self.backward.undistorted_errors(_inverse(P).float(), rows)
        mask = self.mask if rows is None else self.mask.gather(1, rows)
        return truncated_score(torch.maximum(there, back), mask)

    def larger_errors(self, P: Float[Tensor, "B 3 4"]) -> Float[Tensor, "B N"]:
        """The larger of both squared errors in thresholds; infinite where a point cannot be seen."""
        squared = []
        for view, mapping in ((self.forward, P), (self.backward, _inverse(P))):
            _, residual, _, valid = view.residuals(mapping)
            squared.append(residual.square().sum(-1).masked_fill(~valid, torch.inf))
        return torch.maximum(*squared).nan_to_num(torch.inf)

    def fit(
        self, P: Float[Tensor, "B 3 4"], iterations: int, width: float
    ) -> tuple[Float[Tensor, "B 3 4"], Float[Tensor, " B"]]:
        """Similarities of least truncated squared error in both images and in depth, and their costs."""

        def in_step(J: Tensor, points: Tensor) -> Tensor:
            rows = pose_rows(J, points)
            return torch.cat((rows, J @ points[..., None]), dim=-1) if self.with_scale else rows

        def evaluate(P: Tensor) -> tuple[Tensor, Tensor]:
            inverse = _inverse(P)
            moved, there, J, valid = self.forward.residuals(P)
            _, back, J_back, valid_back = self.backward.residuals(inverse)
            # Differences of the logarithms of depths in camera 2; none where a depth is not positive.
            front = (moved[..., 2:] > 0) & (self.backward.points[..., 2:] > 0)
            depth, known = (torch.where(front, x[..., 2:], 1.0) for x in (moved, self.backward.points))
            deeper = (depth / known).log() / self.depth_sigma
            slope = torch.where(front, 1 / (self.depth_sigma * depth), 0.0)
            J = torch.cat((J, torch.nn.functional.pad(slope[..., None], (2, 0))), dim=-2)
            # Moving S from the left moves the points of camera 2 against it before the inverse maps them.
            slopes = in_step(J, moved), -in_step(J_back @ inverse[:, None, :, :3], self.backward.points)
            residual = torch.cat((there, deeper, back), dim=-1)
            squared = 0.5 * residual.square().sum(-1)  # as large as in each image, where both are alike
            squared = squared.masked_fill(~(valid & valid_back), torch.inf)
            used, cost = truncated_rows(squared[:, None], self.mask, width)
            rows = torch.cat((torch.cat(slopes, dim=-2), residual[..., None]), dim=-1)
            rows = torch.where(used[:, 0, :, None, None], rows, 0.0).flatten(1, 2)
            return 0.5 * torch.bmm(rows.mT, rows), cost[:, 0]

        (P,), cost = levenberg_marquardt((P,), evaluate, retract_pose, iterations)
        return P, cost


def _inverse(P: Float[Tensor, "*batch 3 4"]) -> Float[Tensor, "*batch 3 4"]:
    """Inverse of similarities [sR t]."""
    linear = P[..., :3].mT / P[..., :1, :3].square().sum(-1, keepdim=True)
    return torch.cat((linear, -linear @ P[..., 3:]), dim=-1)
