"""The relative pose of two views from their matches, some of them wrong, and the model that explains them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchslam.geometry.camera import Camera
from torchslam.geometry.essential import essential_from_pose, sampson_errors
from torchslam.geometry.homography import decompose_homography, transfer_errors
from torchslam.geometry.implicit import implicit_step, needs_gradient
from torchslam.geometry.lie import rigid, so3_exp
from torchslam.geometry.precision import full_precision
from torchslam.geometry.ransac import SUPPORT_WIDTH, is_significant, search
from torchslam.geometry.two_view import (
    TwoViews,
    best_of,
    fit_essential,
    fit_homography,
    fit_rotation,
    propose_essential,
    propose_homography,
    propose_rotation,
    sampson_squared,
    tangent_basis,
    transfer_squared,
)

MODELS = ("essential", "homography", "rotation")
_ESSENTIAL, _HOMOGRAPHY, _ROTATION = range(3)

_FIRST_ROUND = 64  # samples of five; of the cheaper models a fixed number
_HOMOGRAPHY_SAMPLES, _ROTATION_SAMPLES = 64, 16
_TRIAL_ITERATIONS = 5  # of a homography or rotation that may not be needed
_FINAL_ITERATIONS = 12
_FINAL_WIDTH = 2.0  # thresholds; the refinement uses the tail of the noise too
_CLEARLY_OFF = 2.0  # thresholds of the transfer error: three deviations of noise as large as the threshold
_LEAST_SPREAD = 3.0  # thresholds by which the inliers must leave a line
_NOISE_WIDTH = 4.0  # thresholds within which the noise is estimated
_LEAST_SHARE = 0.05  # of the matches that must contradict the simpler model for the richer one to be chosen


@dataclass(frozen=True)
class RelativePose:
    """Relative poses of B pairs of views.

    T_21:      (B, 4, 4) from camera 1 to camera 2, translation of length one; zero for "rotation"; the identity
               where nothing was found
    inliers:   (B, N) matches within the threshold of the chosen model
    success:   (B,) rotation and direction are determined: no accident, no pure rotation, no ambiguous plane
    model:     per pair "essential", "homography" (the scene is a plane, as far as one can tell) or "rotation"
    ambiguous: (B,) the matches lie on a plane and two motions explain them; T_21 is the likelier
    score_essential, score_homography, score_rotation: (B,) sum over the matches of 1 - min((error / threshold)^2, 1)
    """

    T_21: Tensor
    inliers: Tensor
    success: Tensor
    model: tuple[str, ...]
    ambiguous: Tensor
    score_essential: Tensor
    score_homography: Tensor
    score_rotation: Tensor


@full_precision
def estimate_relative_pose(
    pixels_1: Tensor,
    pixels_2: Tensor,
    camera_1: Camera,
    camera_2: Camera,
    threshold: float = 1.0,
    mask: Tensor | None = None,
    seed: int = 0,
    confidence: float = 0.9999,
    max_samples: int = 4000,
) -> RelativePose:
    """Relative poses of B pairs of views by RANSAC over five-point essential matrices, with model selection.

    pixels_1, pixels_2: (B, N, 2) matches; mask: (B, N), rows outside it, or with NaN, are ignored; threshold: in
    pixels, about the noise of one coordinate. The same arguments and seed give the same result.

    A homography and a pure rotation are fitted as well. The richer model is chosen only where matches that it
    explains contradict the simpler one, more of them than accident would bring. Too few matches, pure noise, a
    pure rotation or a plane with two valid motions give `success` False for that pair.

    Where an input requires a gradient, T_21 carries that of the final least squares of the chosen model with
    respect to pixels and camera parameters, with the set of matches it uses fixed (implicit function theorem,
    exact Hessian).
    Sources: Nister, 2004; Chum et al., "Locally optimized RANSAC", 2003; Torr, "An assessment of information
    criteria for motion model selection", 1997, for the problem of choosing.
    """
    if pixels_1.dim() != 3 or pixels_1.shape != pixels_2.shape or pixels_1.shape[-1] != 2:
        shapes = f"{tuple(pixels_1.shape)} and {tuple(pixels_2.shape)}"
        raise ValueError(f"pixels_1 and pixels_2 must both be (B, N, 2), not {shapes}")
    if 0 in pixels_1.shape or pixels_1.shape[1] < 5:
        return _nothing(pixels_1)
    finite = torch.isfinite(pixels_1).all(-1) & torch.isfinite(pixels_2).all(-1)
    mask = finite if mask is None else mask & finite
    pixels_1, pixels_2 = (torch.where(mask[..., None], pixels, 0.0) for pixels in (pixels_1, pixels_2))
    with torch.no_grad():
        views = TwoViews.of(pixels_1, pixels_2, camera_1, camera_2, threshold, mask)
        # The probability that a wrong match is within the threshold of an epipolar line.
        chance = 2 * threshold * math.hypot(*camera_2.size) / (camera_2.width * camera_2.height)
        found = _search(views, mask, chance, seed, confidence, max_samples)
    T_21 = found.T_21
    if needs_gradient(pixels_1, pixels_2, camera_1.params, camera_2.params):
        graph_views = TwoViews.of(pixels_1, pixels_2, camera_1, camera_2, threshold, mask)
        T_21 = _with_gradient(T_21, found.normal, graph_views, found.used, found.model)
    return RelativePose(
        T_21,
        found.inliers,
        found.significant & (found.model != _ROTATION) & ~found.ambiguous,
        tuple(MODELS[index] for index in found.model.tolist()),
        found.ambiguous & found.significant,
        *found.scores.unbind(0),
    )


@dataclass(frozen=True)
class _Found:
    """T_21 (B, 4, 4) of the chosen model (B,), `normal` (B, 3) of its plane, and what it rests on.

    significant: (B,) no accident; used: (B, N) matches that the final fit saw; scores: (3, B)
    """

    T_21: Tensor
    normal: Tensor
    model: Tensor
    significant: Tensor
    ambiguous: Tensor
    inliers: Tensor
    used: Tensor
    scores: Tensor


def _search(
    views: TwoViews, mask: Tensor, chance: float, seed: int, confidence: float, max_samples: int
) -> _Found:
    """Fit all models, choose one per pair, and take the pose from it."""
    fits = _fit_models(views, seed, confidence, max_samples)
    model = _choose(fits, mask, chance)
    if bool((model != _ESSENTIAL).any()):
        fits = fits.finished(views)
    R, t, normal, ambiguous = _pose(views, fits, model)
    squared = fits.squared[model, torch.arange(len(model), device=model.device)]
    inliers = (squared < 1) & mask
    significant = is_significant(inliers.sum(-1), mask.sum(-1), 5, torch.full_like(t[:, 0], chance), 10)
    significant = significant & _is_spread(views, inliers)
    found = significant[:, None]
    return _Found(
        torch.where(found[..., None], rigid(R, t), torch.eye(4, dtype=R.dtype, device=R.device)),
        normal,
        model,
        significant,
        ambiguous,
        inliers & found,
        (squared < _FINAL_WIDTH**2) & mask & found,
        torch.where(mask, (1 - fits.squared).clamp_min(0.0), 0.0).sum(-1),
    )


@dataclass(frozen=True)
class _Fits:
    """The best fit of each model. R, t: (B, ...) of the essential matrix; H; R_only; squared: (3, B, N) errors."""

    R: Tensor
    t: Tensor
    H: Tensor
    R_only: Tensor
    squared: Tensor

    def with_mappings(self, views: TwoViews) -> _Fits:
        """The same with the errors of homography and rotation brought up to date."""
        mapped = transfer_squared(views, torch.stack((self.H, self.R_only), dim=1)).transpose(0, 1)
        return replace(self, squared=torch.cat((self.squared[:1], mapped)).nan_to_num(torch.inf))

    def finished(self, views: TwoViews) -> _Fits:
        """The same with homography and rotation at their minimum."""
        (H,), _ = fit_homography(views, self.H[:, None], _FINAL_ITERATIONS, _FINAL_WIDTH)
        (R_only,), _ = fit_rotation(views, self.R_only[:, None], _FINAL_ITERATIONS, _FINAL_WIDTH)
        return replace(self, H=H[:, 0], R_only=R_only[:, 0]).with_mappings(views)


def _nothing(pixels: Tensor) -> RelativePose:
    """The answer where there is nothing to sample from."""
    B, N = pixels.shape[:2]
    T_21 = torch.eye(4, dtype=pixels.dtype, device=pixels.device).expand(B, 4, 4)
    score = torch.zeros(B, dtype=pixels.dtype, device=pixels.device)
    no = torch.zeros(B, N + 1, dtype=torch.bool, device=pixels.device)
    return RelativePose(T_21, no[:, :N], no[:, N], B * (MODELS[_ROTATION],), no[:, N], score, score, score)


def _fit_models(views: TwoViews, seed: int, confidence: float, max_samples: int) -> _Fits:
    generator = torch.Generator().manual_seed(seed)
    R, t = search(
        lambda rows, count: propose_essential(views.select(rows), count, generator),
        views.mask.sum(-1),
        5,
        confidence,
        _FIRST_ROUND,
        max_samples,
    )
    R, t, _ = fit_essential(views, R[:, None], t[:, None], _FINAL_ITERATIONS, _FINAL_WIDTH)
    essential = sampson_squared(views, R, t)
    # The matches of a plane, or of a pure rotation, are among those that fit the essential matrix.
    near = replace(views, mask=views.mask & (essential[:, 0] < SUPPORT_WIDTH**2))
    R_only = propose_rotation(near, _ROTATION_SAMPLES, generator)
    (R_only,), _ = best_of(*fit_rotation(views, R_only, _TRIAL_ITERATIONS, _FINAL_WIDTH))
    H = propose_homography(near, _HOMOGRAPHY_SAMPLES, generator)
    H = torch.cat((H, (R_only / R_only[:, 2:, 2:])[:, None]), dim=1)
    (H,), _ = best_of(*fit_homography(views, H, _TRIAL_ITERATIONS, _FINAL_WIDTH))
    fits = _Fits(R[:, 0], t[:, 0], H, R_only, essential[:, 0].expand(3, -1, -1))
    return fits.with_mappings(views)


def _choose(fits: _Fits, mask: Tensor, chance: float) -> Tensor:
    """The index of the simplest model that no significant number of matches contradicts. (B,)"""
    essential, homography, rotation = fits.squared
    # Noise beyond the threshold must not look like parallax: the distances from the epipolar lines, which depth
    # does not touch, show how large it is.
    near = (essential < _NOISE_WIDTH**2) & mask
    noise = essential.masked_fill(~near, torch.nan).nanmedian(dim=-1).values.nan_to_num(1.0) / 0.6745**2
    noise = noise.clamp_min(1.0)[:, None]
    explained = (torch.minimum(essential, homography) < noise) & mask

    def contradicted(simple: Tensor, rich: Tensor) -> Tensor:
        off = (simple > _CLEARLY_OFF**2 * noise) & mask
        against = (off & (rich < noise)).sum(-1)
        accident = ~is_significant(against, off.sum(-1), 2, chance * noise[:, 0].sqrt(), 1)
        return ~accident & (against > _LEAST_SHARE * explained.sum(-1))

    plane = ~contradicted(homography, essential)
    still = ~contradicted(rotation, essential)
    return torch.where(still, _ROTATION, torch.where(plane, _HOMOGRAPHY, _ESSENTIAL))


def _pose(views: TwoViews, fits: _Fits, model: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """R (B, 3, 3), t (B, 3), plane normal (B, 3), and whether a plane leaves two motions (B,)."""
    inliers = fits.squared < 1
    R_E, t_E, _ = _in_front(views, *_twisted(fits.R, fits.t), views.mask & inliers[_ESSENTIAL])
    R_H, t_H, normals = decompose_homography(fits.H)
    # All of the plane must be in front of the first camera, and then is in front of the second.
    plane = views.mask & inliers[_HOMOGRAPHY]
    ahead = ((views.h_1 @ normals.mT) > 0) & plane[..., None]
    share = ahead.sum(1) / plane.sum(1, keepdim=True).clamp_min(1)
    length = t_H.norm(dim=-1, keepdim=True)
    direction = t_H / length.clamp_min(1e-12)
    squared = sampson_squared(views, R_H, direction)
    support = torch.where(views.mask[:, None], (1 - squared).clamp_min(0.0), 0.0).sum(-1)
    support = torch.where(share > 0.9, support, -1.0)
    (first, second), order = (part.unbind(-1) for part in support.topk(2, dim=-1))
    ambiguous = second > 0.8 * first.clamp_min(0.0)
    index = torch.arange(len(model), device=model.device)
    best = order[0]
    flat = model == _HOMOGRAPHY
    apart = (R_H[index, order[0]] - R_H[index, order[1]]).abs().amax((-2, -1)) > 1e-3
    R = torch.where(flat[:, None, None], R_H[index, best], R_E)
    t = torch.where(flat[:, None], direction[index, best], t_E)
    still = model == _ROTATION
    R = torch.where(still[:, None, None], fits.R_only, R)
    t = torch.where(still[:, None], 0.0, t)
    return R, t, (normals * length)[index, best], flat & ambiguous & apart


def _is_spread(views: TwoViews, inliers: Tensor) -> Tensor:
    """Whether the inliers leave a line in both images, by some thresholds. (B,)"""
    weights = inliers[..., None].to(views.x_1.dtype)
    weights = weights / weights.sum(1, keepdim=True).clamp_min(1.0)
    spread = torch.ones_like(inliers[:, 0])
    for x, scale in ((views.x_1, views.scale_1), (views.x_2, views.scale_2)):
        centred = (x - (weights * x).sum(1, keepdim=True)) * scale[..., None]
        xx, xy, _, yy = ((weights * centred).mT @ centred).flatten(1).unbind(-1)
        smaller = 0.5 * (xx + yy) - (0.25 * (xx - yy).square() + xy.square()).sqrt()
        spread = spread & (smaller > _LEAST_SPREAD**2)
    return spread


def _twisted(R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """The four poses of one essential matrix. (B, 3, 3), (B, 3) -> (B, 4, 3, 3), (B, 4, 3)."""
    turn = 2 * t[..., :, None] * t[..., None, :] - torch.eye(3, dtype=t.dtype, device=t.device)
    return torch.stack((R, R, turn @ R, turn @ R), dim=1), torch.stack((t, -t, t, -t), dim=1)


def _in_front(views: TwoViews, R: Tensor, t: Tensor, inliers: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The pose (B, 3, 3), (B, 3) out of (B, K) that has most inliers in front of both cameras, and their share.

    A match counts by its parallax in thresholds, up to one: the depth of far points says nothing.
    """
    ray_1 = views.h_1[:, None] @ R.mT
    ray_2 = views.h_2[:, None].expand_as(ray_1)
    normal = torch.linalg.cross(ray_1, ray_2, dim=-1)
    t_rows = t[:, :, None].expand_as(ray_1)
    depth_1 = -(torch.linalg.cross(t_rows, ray_2, dim=-1) * normal).sum(-1)
    depth_2 = -(torch.linalg.cross(t_rows, ray_1, dim=-1) * normal).sum(-1)
    parallax = normal.norm(dim=-1) * torch.minimum(views.scale_1, views.scale_2)[:, None]
    weight = torch.where(inliers[:, None], parallax.clamp_max(1.0), 0.0)
    ahead = torch.where((depth_1 > 0) & (depth_2 > 0), weight, 0.0).sum(-1)
    best = ahead.argmax(-1)
    index = torch.arange(len(best), device=best.device)
    return R[index, best], t[index, best], ahead[index, best] / weight[index, best].sum(-1).clamp_min(1e-12)


def _with_gradient(T_21: Tensor, normal: Tensor, views: TwoViews, used: Tensor, model: Tensor) -> Tensor:
    """The same poses, with the gradient of the minimiser of the chosen model's squared errors over the rows in use."""
    R, t = T_21[:, :3, :3], T_21[:, :3, 3]
    # Parameters that the chosen model does not have must not bring NaN.
    forward = t.new_tensor((0.0, 0.0, 1.0))
    t = torch.where((model == _ROTATION)[:, None] | (t == 0).all(-1, keepdim=True), forward, t)
    normal = torch.where((model == _HOMOGRAPHY)[:, None], normal, forward)
    basis_t, basis_n = tangent_basis(t), tangent_basis(normal)
    variance_1, variance_2 = views.scale_1.square().reciprocal(), views.scale_2.square().reciprocal()
    weight = (variance_1 + variance_2).rsqrt()

    def direction(step: Tensor) -> Tensor:
        moved = t + (step[:, None] @ basis_t).squeeze(1)
        return moved / moved.norm(dim=-1, keepdim=True)

    def essential(step: Tensor) -> Tensor:
        E = essential_from_pose(so3_exp(step[:, :3]) @ R, direction(step[:, 3:]))
        error = sampson_errors(E, views.x_1, views.x_2, variance_1, variance_2)
        return torch.where(used & (model == _ESSENTIAL)[:, None], error.square(), 0.0).sum(-1)

    def mapping(H: Tensor, rows: Tensor) -> Tensor:
        error = transfer_errors(H, views.x_1, views.x_2).square().sum(-1) * weight.square()
        return torch.where(used & rows[:, None], error, 0.0).sum(-1)

    def homography(step: Tensor) -> Tensor:
        plane = normal * (1 + step[:, 5:6]) + (step[:, None, 6:] @ basis_n).squeeze(1)
        H = so3_exp(step[:, :3]) @ R + direction(step[:, 3:5])[:, :, None] * plane[:, None]
        return mapping(H, model == _HOMOGRAPHY)

    def rotation(step: Tensor) -> Tensor:
        return mapping(so3_exp(step) @ R, model == _ROTATION)

    steps = (
        implicit_step(essential, R.new_zeros(len(R), 5)),
        implicit_step(homography, R.new_zeros(len(R), 8))[:, :5],
        torch.nn.functional.pad(implicit_step(rotation, R.new_zeros(len(R), 3)), (0, 2)),
    )
    step = steps[0] + steps[1] + steps[2]
    moving = (T_21[:, :3, 3] != 0).any(-1, keepdim=True)
    return rigid(so3_exp(step[:, :3]) @ R, torch.where(moving, direction(step[:, 3:]), 0.0))
