"""Matches of two views, and the fits of their three models: essential matrix, homography and pure rotation.

Each model has minimal samples, scores, and truncated least squares over many candidates at once. Residuals are in units
of the threshold: to first order, the distance by which the match would have to move in both images together.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchslam.geometry.camera import Camera
from torchslam.geometry.lie import cayley_rotation, generators, homogeneous, skew
from torchslam.geometry.projections import (
    Tangent,
    fit_projections,
    homography_tangent,
    rotation_tangent,
    squared_projections,
)
from torchslam.geometry.ransac import (
    SUPPORT_WIDTH,
    ModelState,
    best_models,
    best_of,
    gather_rows,
    in_chunks,
    levenberg_marquardt,
    pad_groups,
    sample_minimal,
    some_problems,
    truncated_score,
)
from torchslam.geometry.robust import NORMAL_MEDIAN, Kernel, median_scale, robustify
from torchslam.geometry.two_view_matrices import (
    essential_from_pose,
    five_point,
    homography_from_matches,
    motions_of_essential,
    rotation_from_matches,
    transfer_errors,
)

# Thresholds: a two-dimensional error so large is as probable as a one-dimensional one of one.
TRANSFER_WIDTH = 1.5


@dataclass(frozen=True)
class TwoViews:
    """Matches of B pairs of views in undistorted image coordinates, and the mask of those in use.

    scale_1, scale_2: thresholds per unit of x_1 and x_2
    """

    x_1: Float[Tensor, "B N 2"]
    x_2: Float[Tensor, "B N 2"]
    scale_1: Float[Tensor, "B N"]
    scale_2: Float[Tensor, "B N"]
    mask: Bool[Tensor, "B N"]

    @staticmethod
    def of(
        pixels_1: Float[Tensor, "B N 2"],
        pixels_2: Float[Tensor, "B N 2"],
        camera_1: Camera,
        camera_2: Camera,
        threshold: float,
        mask: Bool[Tensor, "B N"],
        weights: Float[Tensor, "B N"] | None,
    ) -> TwoViews:
        """Undistort pixels; the threshold of a match is `threshold / sqrt(weight)` pixels."""
        x_1, x_2 = camera_1.normalize(pixels_1), camera_2.normalize(pixels_2)
        scale_1, scale_2 = (
            camera.pixel_scale(x).prod(-1).sqrt() / threshold
            for camera, x in ((camera_1, x_1), (camera_2, x_2))
        )
        views = TwoViews(x_1, x_2, scale_1, scale_2, mask)
        return views if weights is None else views.in_units(torch.where(mask, weights, 1.0).rsqrt())

    def in_units(self, thresholds: Float[Tensor, "B #N"]) -> TwoViews:
        """The matches with thresholds scaled by factors."""
        return replace(self, scale_1=self.scale_1 / thresholds, scale_2=self.scale_2 / thresholds)

    def select(self, rows: Int[Tensor, " R"]) -> TwoViews:
        """Some of the problems."""
        return self if len(rows) == len(self.mask) else some_problems(self, rows)

    def rows(self, rows: Int[Tensor, "B n"]) -> TwoViews:
        """Some of the matches of each problem, by row number."""
        x_1, x_2 = gather_rows(self.x_1, rows), gather_rows(self.x_2, rows)
        return TwoViews(x_1, x_2, *(x.gather(1, rows) for x in (self.scale_1, self.scale_2, self.mask)))

    @cached_property
    def h_1(self) -> Float[Tensor, "B N 3"]:
        """Homogeneous x_1."""
        return homogeneous(self.x_1)

    @cached_property
    def h_2(self) -> Float[Tensor, "B N 3"]:
        """Homogeneous x_2."""
        return homogeneous(self.x_2)

    @cached_property
    def epipolar(self) -> tuple[Float[Tensor, "B 9 N"], Float[Tensor, "B 18 N"]]:
        """Terms in which the Sampson error is linear, for the constraint and for its variance.

        The constraint is E times h_2 h_1^T; its variance (E E^T and E^T E without the last row and column) times
        h_1 h_1^T and h_2 h_2^T, over the squared scale of the other image.
        """
        h_1, h_2 = self.h_1.mT, self.h_2.mT
        outer_1 = h_1[:, :, None] * (h_1 * self.scale_2.square().reciprocal()[:, None])[:, None]
        outer_2 = h_2[:, :, None] * (h_2 * self.scale_1.square().reciprocal()[:, None])[:, None]
        constraint = (h_2[:, :, None] * h_1[:, None]).flatten(1, 2)
        return constraint, torch.cat((outer_1, outer_2), dim=1).flatten(1, 2)

    @cached_property
    def transfer_scale(self) -> Float[Tensor, "B N"]:
        """Thresholds per unit of a difference H(x_1) - x_2, which has the noise of both images.

        Two-dimensional errors get a threshold of their own, see `TRANSFER_WIDTH`.
        """
        both = self.scale_1.square().reciprocal() + self.scale_2.square().reciprocal()
        return both.rsqrt() / TRANSFER_WIDTH


# Essential matrices of each round that are optimized; if matches have to be in front of the cameras, more, of so many;
# and the iterations of their local optimization.
_CANDIDATES, _MORE_CANDIDATES, _CHECKED_CANDIDATES, _ITERATIONS = 4, 8, 24, 4
# Deviations of the noise at which a match supports a candidate half, and thresholds between which that is: a threshold
# far from the noise still ranks the samples, but discriminates poorly between the best ones.
_SUPPORT_DEVIATIONS, _LEAST_UNIT, _LARGEST_UNIT = 1.5, 1 / 16, 4.0
NOISE_WIDTH = 4.0  # thresholds within which the noise is estimated


def sampson_squared(
    views: TwoViews, R: Float[Tensor, "B K 3 3"], t: Float[Tensor, "B K 3"]
) -> Float[Tensor, "B K N"]:
    """Squared Sampson errors in thresholds of poses."""
    E = essential_from_pose(R, t)
    constraint, variance = views.epipolar
    squared = (E.flatten(-2) @ constraint).square()
    return squared / (_variance_form(E) @ variance).clamp_min(torch.finfo(R.dtype).tiny)


def _variance_form(E: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 18"]:
    """The coefficients of the variance of the constraint."""
    rows, columns = E[..., :2, :].mT @ E[..., :2, :], E[..., :2] @ E[..., :2].mT
    return torch.cat((rows, columns), dim=-2).flatten(-2)


@lru_cache(maxsize=16)
def _essential_tables(
    dtype: torch.dtype, device: torch.device
) -> tuple[Float[Tensor, "9 54"], Float[Tensor, "9 162"]]:
    """Two linear maps that make E, its derivatives and those of its variance matrix products.

    The first goes from the frame of the direction (t, a, b, as rows) to the left factors of the derivatives of E = L R
    by the rotation (three) and by turning the frame about its b and a, and to L itself; the second from E to the
    (9, 18) matrix that takes dE to half the derivative of `_variance_form`.
    """
    axes = generators(dtype, device)
    units = torch.eye(9, dtype=dtype, device=device).unflatten(-1, (3, 3))
    crosses = skew(units)  # (9, row of the frame, 3, 3)
    left = torch.cat((crosses[:, :1] @ axes, crosses[:, 1:2], -crosses[:, 2:], crosses[:, :1]), dim=1)
    bilinear = [[_variance_form(E + F) - _variance_form(E) - _variance_form(F) for F in units] for E in units]
    return left.flatten(1), 0.5 * torch.stack([torch.stack(row) for row in bilinear]).flatten(1)


def tangent_basis(t: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2 3"]:
    """Two unit vectors perpendicular to t and to each other."""
    axis = torch.nn.functional.one_hot(t.abs().argmin(-1), 3).to(t.dtype)
    a = torch.linalg.cross(t, axis, dim=-1)
    a = a / a.norm(dim=-1, keepdim=True)
    return torch.stack((a, torch.linalg.cross(t, a, dim=-1)), dim=-2)


def _retract_essential(state: ModelState, step: Tensor) -> ModelState:
    """Turns R from the left and the frame of t, whose rows are t, a, b, about its own b and a."""
    zero, (a, b) = torch.zeros_like(step[:, :1]), step[:, 3:].split(1, dim=-1)
    turns = torch.cat((step[:, :3], zero, -b, -a), dim=-1)
    return (torch.bmm(cayley_rotation(turns.view(-1, 3)), state[0].view(-1, 3, 3)).view_as(state[0]),)


def fit_essential(
    views: TwoViews,
    R: Float[Tensor, "B K 3 3"],
    t: Float[Tensor, "B K 3"],
    iterations: int,
    scales: Float[Tensor, " B"],
    kernel: Kernel = "truncated",
) -> tuple[Float[Tensor, "B K 3 3"], Float[Tensor, "B K 3"], Float[Tensor, "B K"]]:
    """Optimize poses with |t| = 1; also return their robust costs. scales: of the kernel, in thresholds."""
    K, N = t.shape[1], views.mask.shape[1]
    left_table, variance_table = _essential_tables(R.dtype, R.device)

    def fit(
        R: Tensor, t: Tensor, constraint: Tensor, variance: Tensor, mask: Tensor, scales: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        B = len(R)

        def evaluate(pose: Tensor) -> tuple[Tensor, Tensor]:
            left = (pose[:, 1].reshape(B * K, 9) @ left_table).view(B * K, 18, 3)
            E = torch.bmm(left, pose[:, 0]).view(B * K, 6, 9)
            form = torch.bmm(E, (E[:, -1] @ variance_table).view(B * K, 9, 18))
            value = torch.bmm(E.view(B, K * 6, 9), constraint).view(B, K, 6, N)
            spread = torch.bmm(form.view(B, K * 6, 18), variance).view(B, K, 6, N)
            inverse = spread[:, :, -1:].clamp_min(torch.finfo(pose.dtype).tiny).rsqrt_()
            # r = c / s has the derivative dc / s - r (s ds) / s^2, and s ds is what `spread` holds
            rows = value.mul_(inverse)
            residual = rows[:, :, -1:]
            rows[:, :, :-1].addcmul_(residual * inverse.square_(), spread[:, :, :-1], value=-1)
            robust = robustify(residual.squeeze(2).square(), kernel, scales[:, None, None])
            cost = torch.where(mask[:, None], robust.rho, 0.0).sum(-1)
            weight = torch.where(mask[:, None], robust.weight, 0.0).sqrt_()
            rows = rows.mul_(weight[:, :, None]).view(B * K, 6, N)
            return torch.bmm(rows, rows.mT), cost.view(-1)

        frame = torch.cat((t[..., None, :], tangent_basis(t)), dim=-2)
        start = torch.stack((R, frame), dim=2).view(B * K, 2, 3, 3)
        (pose,), cost = levenberg_marquardt((start,), evaluate, _retract_essential, iterations)
        pose = pose.view(B, K, 2, 3, 3)
        return pose[:, :, 0], pose[:, :, 1, 0], cost.view(B, K)

    R, t, cost = in_chunks(fit, K * 6 * N, R, t, *views.epipolar, views.mask, scales)
    return R, t, cost


def noise_variance(squared: Float[Tensor, "B N"], mask: Bool[Tensor, "B N"]) -> Float[Tensor, " B"]:
    """Variance of the noise, in squared thresholds, by the squared Sampson errors of a pose."""
    near = (squared < NOISE_WIDTH**2) & mask
    return median_scale(squared, NORMAL_MEDIAN**2, near).nan_to_num(NORMAL_MEDIAN**-2)


def propose_essential(
    views: TwoViews, count: int, generator: torch.Generator, by_noise: bool
) -> tuple[ModelState, Tensor, Tensor]:
    """The best (R, t) of `count` samples of five matches, locally optimized, its score and its support.

    by_noise: matches count the more the closer they are, in units of the noise that the best sample shows; those that
    lie behind a camera count as wrong
    """
    B = len(views.mask)
    sample = sample_minimal(views.mask, 5, count, generator)
    x_1, x_2 = gather_rows(views.x_1, sample), gather_rows(views.x_2, sample)
    E, row = five_point(x_1.flatten(0, 1), x_2.flatten(0, 1))
    candidates = _CHECKED_CANDIDATES if by_noise else _CANDIDATES
    E, valid = pad_groups(E.flatten(1), row // count, B, candidates)

    def score(E: Tensor, rows: Tensor | None) -> Tensor:
        """In float32. By noise, matches beyond the threshold count too: the sum of 1 / (1 + r^2)."""
        some = views if rows is None else views.rows(rows)
        constraint, variance = (terms.float() for terms in some.epipolar)
        squared = (E.float() @ constraint).square_()
        spread = (_variance_form(E.unflatten(-1, (3, 3))).float() @ variance).clamp_min_(1e-20)
        if not by_noise:
            return truncated_score(squared.div_(spread), some.mask)
        support = spread.div_(squared.add_(spread)).nan_to_num_(0.0)
        return (support @ some.mask.to(support.dtype)[..., None]).squeeze(-1)

    best = best_models(score, E, valid, views.mask, candidates, generator)
    R, t = motions_of_essential(gather_rows(E, best).unflatten(-1, (3, 3)))
    # Padding has no pose; start it from the identity.
    valid, eye = valid.gather(1, best)[..., None], torch.eye(3, dtype=R.dtype, device=R.device)
    R, t = torch.where(valid[..., None], R[:, :, 0], eye), torch.where(valid, t, eye[2])
    R, t, cost = _optimized(views, R, t, by_noise)
    near = (sampson_squared(views, R[:, None], t[:, None])[:, 0] < SUPPORT_WIDTH**2) & views.mask
    return (R, t), views.mask.sum(-1) - cost, near.sum(-1)


def _optimized(
    views: TwoViews, R: Float[Tensor, "B K 3 3"], t: Float[Tensor, "B K 3"], by_noise: bool
) -> tuple[Float[Tensor, "B 3 3"], Float[Tensor, "B 3"], Float[Tensor, " B"]]:
    """The best of candidates, the first of which scored best, locally optimized: R, t, cost."""
    if not by_noise:
        R, t, cost = fit_essential(views, R, t, _ITERATIONS, t.new_ones(len(t)))
        (R, t), cost = best_of((R, t), cost)
        return R, t, cost
    R, t, cost = best_in_front(views, R, t)
    best = cost.topk(_MORE_CANDIDATES, dim=1, largest=False).indices
    R, t = gather_rows(R.flatten(2), best).unflatten(-1, (3, 3)), gather_rows(t, best)
    noise = noise_variance(sampson_squared(views, R[:, :1], t[:, :1])[:, 0], views.mask).sqrt()
    unit = (_SUPPORT_DEVIATIONS * noise).clamp(_LEAST_UNIT, _LARGEST_UNIT)
    in_units = views.in_units(unit[:, None])
    R, t, _ = fit_essential(in_units, R, t, _ITERATIONS, t.new_ones(len(t)))
    R, t, cost = best_in_front(in_units, R, t)
    (R, t), _ = best_of((R, t), cost)
    # Rounds are compared in thresholds, which are the same for all of them.
    _, _, cost = best_in_front(views, R[:, None], t[:, None])
    return R, t, cost[:, 0]


def twisted(
    R: Float[Tensor, "B 3 3"], t: Float[Tensor, "B 3"]
) -> tuple[Float[Tensor, "B 4 3 3"], Float[Tensor, "B 4 3"]]:
    """The four poses of each essential matrix, from one of them."""
    turn = 2 * t[..., :, None] * t[..., None, :] - torch.eye(3, dtype=t.dtype, device=t.device)
    return torch.stack((R, R, turn @ R, turn @ R), dim=1), torch.stack((t, -t, t, -t), dim=1)


def ahead_and_parallax(
    views: TwoViews, R: Float[Tensor, "B K 3 3"], t: Float[Tensor, "B K 3"]
) -> tuple[Bool[Tensor, "B K N"], Float[Tensor, "B K N"]]:
    """Matches in front of both cameras of each pose, and their parallax in thresholds."""
    ray_1 = views.h_1[:, None] @ R.mT
    ray_2 = views.h_2[:, None].expand_as(ray_1)
    normal = torch.linalg.cross(ray_1, ray_2, dim=-1)
    t_rows = t[:, :, None].expand_as(ray_1)
    depth_1 = -(torch.linalg.cross(t_rows, ray_2, dim=-1) * normal).sum(-1)
    depth_2 = -(torch.linalg.cross(t_rows, ray_1, dim=-1) * normal).sum(-1)
    parallax = normal.norm(dim=-1) * torch.minimum(views.scale_1, views.scale_2)[:, None]
    return (depth_1 > 0) & (depth_2 > 0), parallax


def best_in_front(
    views: TwoViews, R: Float[Tensor, "B K 3 3"], t: Float[Tensor, "B K 3"]
) -> tuple[Float[Tensor, "B K 3 3"], Float[Tensor, "B K 3"], Float[Tensor, "B K"]]:
    """The pose of least cost among the four of each essential matrix, and that cost.

    The cost of a match is r^2 / (1 + r^2), by Geman and McClure. Matches behind a camera count as wrong, but where
    their parallax is within the threshold.
    """
    support = torch.where(views.mask[:, None], 1 / (1 + sampson_squared(views, R, t)), 0.0)
    score = torch.where(possible_matches(views, R, t), support[:, :, None], 0.0).sum(-1)
    score, best = score.max(dim=-1)
    four = (x.unflatten(0, best.shape) for x in twisted(R.flatten(0, 1), t.flatten(0, 1)))
    R, t = (x.flatten(3).take_along_dim(best[..., None, None], 2)[:, :, 0] for x in four)
    return R.unflatten(-1, (3, 3)), t, views.mask.sum(-1, keepdim=True) - score


def possible_matches(
    views: TwoViews, R: Float[Tensor, "B K 3 3"], t: Float[Tensor, "B K 3"]
) -> Bool[Tensor, "B K 4 N"]:
    """Matches that by each of the `twisted` poses lie in front of both cameras, or too far to tell.

    As `ahead_and_parallax`, but from the products of the rays r_1, r_2 and t alone, which the four poses share.
    """
    t_1, t_2 = (t[:, :, None] @ R).squeeze(2) @ views.h_1.mT, t @ views.h_2.mT
    r_12 = R.flatten(2) @ views.epipolar[0]
    r_12 = torch.stack((r_12, 2 * t_1 * t_2 - r_12), dim=2)
    t_1, t_2 = t_1[:, :, None], t_2[:, :, None]
    r_11, r_22 = (h.square().sum(-1)[:, None, None] for h in (views.h_1, views.h_2))
    depth_1, depth_2 = t_2 * r_12 - t_1 * r_22, t_2 * r_11 - t_1 * r_12
    scale = torch.minimum(views.scale_1, views.scale_2)[:, None, None]
    far = (r_11 * r_22 - r_12.square()) * scale.square() < 1
    ahead = torch.stack(((depth_1 > 0) & (depth_2 > 0), (depth_1 < 0) & (depth_2 < 0)), dim=3)
    return (ahead | far[:, :, :, None]).flatten(2, 3)


def transfer_squared(views: TwoViews, H: Float[Tensor, "B K 3 3"]) -> Float[Tensor, "B K N"]:
    """Squared transfer errors in thresholds of homographies or rotations."""
    difference = transfer_errors(H, views.x_1[:, None], views.x_2[:, None])
    return difference.square().sum(-1) * views.transfer_scale[:, None].square()


def fit_mappings(
    tangent: Callable[[torch.dtype, torch.device], Tangent],
    views: TwoViews,
    H: Float[Tensor, "B K 3 3"],
    iterations: int,
    width: float = 1.0,
) -> tuple[ModelState, Float[Tensor, "B K"]]:
    """Optimize homographies with H_33 = 1, or rotations, by their tangent; also return their truncated costs."""
    H, cost = fit_projections(H, tangent(H.dtype, H.device), *_transfer(views), iterations, width)
    return (H,), cost


fit_homography, fit_rotation = (
    partial(fit_mappings, homography_tangent),
    partial(fit_mappings, rotation_tangent),
)


def _transfer(views: TwoViews) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The matches as a problem for `fit_projections`."""
    return views.h_1.mT, views.x_2, views.transfer_scale[..., None], views.mask


def _best_mappings(views: TwoViews, H: Float[Tensor, "B K 3 3"]) -> Float[Tensor, "B 2 3 3"]:
    """The homographies or rotations of best truncated score, in float32, which are worth a fit."""
    h_1, x_2, scale, mask = _transfer(views)

    def score(H: Tensor, h_1: Tensor, x_2: Tensor, scale: Tensor, mask: Tensor) -> tuple[Tensor]:
        return (truncated_score(squared_projections(H, h_1, x_2, scale), mask),)

    numbers = 3 * H.shape[1] * mask.shape[1]
    (scores,) = in_chunks(score, numbers, H.float(), h_1.float(), x_2.float(), scale, mask)
    best = scores.topk(2, dim=1).indices
    return gather_rows(H.flatten(2), best).unflatten(-1, (3, 3))


def propose_homography(views: TwoViews, count: int, generator: torch.Generator) -> Float[Tensor, "B K 3 3"]:
    """The best homographies of `count` samples of four matches."""
    sample = sample_minimal(views.mask, 4, count, generator)
    H = homography_from_matches(gather_rows(views.x_1, sample), gather_rows(views.x_2, sample))
    return _best_mappings(views, H)


def propose_rotation(views: TwoViews, count: int, generator: torch.Generator) -> Float[Tensor, "B K 3 3"]:
    """The best pure rotations of `count` samples of two matches."""
    sample = sample_minimal(views.mask, 2, count, generator)
    R = rotation_from_matches(gather_rows(views.h_1, sample), gather_rows(views.h_2, sample))
    regular = torch.isfinite(R).all((-2, -1))[..., None, None]
    return _best_mappings(views, torch.where(regular, R, torch.eye(3, dtype=R.dtype, device=R.device)))
