"""The relative pose of two views from their matches, some of them wrong, and the model that explains them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple, get_args

import torch
from torch import Tensor

from torchslam.geometry.camera import Camera
from torchslam.geometry.essential import essential_from_pose, sampson_errors
from torchslam.geometry.estimate_gradients import implicit_step, needs_gradient
from torchslam.geometry.homography import transfer_errors
from torchslam.geometry.lie import rigid, so3_exp
from torchslam.geometry.motion_models import (
    ESSENTIAL,
    FINAL_ITERATIONS,
    FINAL_WIDTH,
    HOMOGRAPHY,
    MODELS,
    NOISE_WIDTH,
    ROTATION,
    choose,
    fit_models,
    in_front,
    is_no_accident,
    noise_variance,
    pose_of,
)
from torchslam.geometry.precision import full_precision
from torchslam.geometry.ransac import search
from torchslam.geometry.robust import Kernel, robustify
from torchslam.geometry.two_view import (
    TwoViews,
    fit_essential,
    propose_essential,
    sampson_squared,
    tangent_basis,
)

Model = Literal["auto", "essential"]
# Here, as compiled graphs of older torch cannot look them up.
_MODELS, _KERNELS = get_args(Model), get_args(Kernel)

_KERNEL_WIDTH = (
    1.5  # deviations of the noise, which for keypoints has a long tail, at which the kernel begins
)
_KERNEL_ITERATIONS = 20
_LEAST_NOISE = 1 / 64  # thresholds; of exact matches


@dataclass(frozen=True)
class RelativePose:
    """Relative poses of B pairs of views.

    T_21:      (B, 4, 4) from camera 1 to camera 2, translation of length one; zero for "rotation". The likeliest
               also where there is no `success`; the identity for fewer than six matches
    inliers:   (B, N) matches within the threshold of the chosen model
    success:   (B,) rotation and direction are determined: no accident, no pure rotation, no ambiguous plane
    model:     per pair "essential", "homography" (the scene is a plane, as far as one can tell) or "rotation": as
               strings, and as indices (B,) int64 of these, in `model_index`
    ambiguous: (B,) the matches lie on a plane and two motions explain them; T_21 is the likelier
    score_essential, score_homography, score_rotation: (B,) sum over the matches of 1 - min((error / threshold)^2, 1);
               zero for models that were not asked for
    T_21_essential: (B, 4, 4) the pose of the essential matrix, whatever was chosen, without gradient; for those who
               want a pose also where there is no `success`: of real pairs that were refused it is right now and then
    """

    T_21: Tensor
    inliers: Tensor
    success: Tensor
    model_index: Tensor
    ambiguous: Tensor
    score_essential: Tensor
    score_homography: Tensor
    score_rotation: Tensor
    T_21_essential: Tensor

    @property
    def model(self) -> tuple[str, ...]:
        return tuple(MODELS[index] for index in self.model_index.tolist())


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
    *,
    model: Model = "auto",
    kernel: Kernel = "cauchy",
    weights: Tensor | None = None,
    min_samples: int = 512,
) -> RelativePose:
    """Relative poses of B pairs of views by RANSAC over five-point essential matrices, with model selection.

    pixels_1, pixels_2: (B, N, 2) matches
    threshold: pixels, about the noise of one coordinate, or somewhat more, for matches of weight one
    mask:      (B, N), rows outside it, or with NaN, are ignored
    model:     "auto" fits a homography and a pure rotation as well. The richer model is chosen only where matches
               that it explains contradict the simpler one, more of them than accident would bring; or, but with the
               kernel "truncated", all together by the noise that it leaves, or because what it explains is an accident.
               A pure rotation or a plane with two valid motions give `success` False. "essential" asks no such thing
    kernel:    of the final refinement of the essential matrix, over the matches that it may explain. Its scale, and
               what contradicts a model, then go by the noise that the matches show, so that the threshold only has to
               tell wrong ones from right ones; in the search, matches behind a camera count as wrong. "truncated":
               both go by the threshold, and the search does not ask where matches lie
    weights:   (B, N) information of the matches, in which squared errors count; the threshold of a match is
               `threshold / sqrt(weight)`. Zero, infinity or NaN is no match
    min_samples, max_samples: of five matches, that are tried at least and at most
    The same arguments and seed give the same result. Too few matches and pure noise give `success` False for that
    pair. Raises ValueError for wrong shapes, and for an unknown model or kernel.

    `torch.compile(fullgraph=True)` takes it as one operator, with the same bits: how many samples it draws depends on
    the data, which no graph may ask. There, ask for `model_index` in place of `model`.

    Where an input requires a gradient, T_21 carries that of the final least squares of the chosen model with
    respect to pixels, weights and camera parameters, with the set of matches it uses and the level of the noise fixed
    (implicit function theorem, exact Hessian).
    Sources: Nister, 2004; Chum et al., "Locally optimized RANSAC", 2003; Torr, "An assessment of information
    criteria for motion model selection", 1997, for the problem of choosing.
    """
    _check(pixels_1, pixels_2, weights, model, kernel)
    if 0 in pixels_1.shape or pixels_1.shape[1] < 5:
        return _nothing(pixels_1)
    finite = torch.isfinite(pixels_1).all(-1) & torch.isfinite(pixels_2).all(-1)
    finite = finite if weights is None else finite & (weights > 0) & torch.isfinite(weights)
    mask = finite if mask is None else mask & finite
    pixels_1, pixels_2 = (torch.where(mask[..., None], pixels, 0.0) for pixels in (pixels_1, pixels_2))
    cameras = camera_1.model, list(camera_1.size), camera_2.model, list(camera_2.size)
    inputs = [pixels_1, pixels_2, camera_1.params, camera_2.params, *([] if weights is None else [weights])]
    effort = seed, confidence, min_samples, max_samples
    compiling = torch.compiler.is_compiling()
    find = torch.ops.torchslam.relative_pose if compiling else find_relative_pose
    found = FoundPose(*find([x.detach() for x in inputs], mask, *cameras, threshold, kernel, model, *effort))
    T_21, others = found.T_21, [mask, found.normal, found.model, found.noise, found.used]
    if compiling:
        T_21 = torch.ops.torchslam.attached_relative_pose(T_21, inputs, others, *cameras, threshold, kernel)
    elif needs_gradient(*inputs):
        T_21 = attach_relative_pose(T_21, inputs, others, *cameras, threshold, kernel)
    return RelativePose(
        T_21,
        found.inliers,
        found.significant & (found.model != ROTATION) & ~found.ambiguous,
        found.model,
        found.ambiguous & found.significant,
        found.scores[0],
        found.scores[1],
        found.scores[2],
        found.T_essential,
    )


def _check(pixels_1: Tensor, pixels_2: Tensor, weights: Tensor | None, model: str, kernel: str) -> None:
    if pixels_1.dim() != 3 or pixels_1.shape != pixels_2.shape or pixels_1.shape[-1] != 2:
        shapes = f"{tuple(pixels_1.shape)} and {tuple(pixels_2.shape)}"
        raise ValueError(f"pixels_1 and pixels_2 must both be (B, N, 2), not {shapes}")
    if weights is not None and weights.shape != pixels_1.shape[:2]:
        raise ValueError(f"weights must be {tuple(pixels_1.shape[:2])}, not {tuple(weights.shape)}")
    for name, value, known in (("model", model, _MODELS), ("kernel", kernel, _KERNELS)):
        if value not in known:
            raise ValueError(f"unknown {name} {value!r}; known are {', '.join(known)}")


class _Effort(NamedTuple):
    """How long to look for a motion: as the arguments of `estimate_relative_pose`."""

    seed: int
    confidence: float
    min_samples: int
    max_samples: int


class FoundPose(NamedTuple):
    """T_21 (B, 4, 4) of the chosen model (B,), `normal` (B, 3) of its plane, and what it rests on.

    noise: (B,) thresholds, the unit of the fits; significant: (B,) no accident; used: (B, N) matches that the final
    fit saw; scores: (3, B); T_essential: (B, 4, 4)
    """

    T_21: Tensor
    normal: Tensor
    model: Tensor
    noise: Tensor
    significant: Tensor
    ambiguous: Tensor
    inliers: Tensor
    used: Tensor
    scores: Tensor
    T_essential: Tensor


def _views(
    inputs: Sequence[Tensor],
    mask: Tensor,
    cameras: tuple[str, Sequence[int], str, Sequence[int]],
    threshold: float,
) -> TwoViews:
    """What `estimate_relative_pose` is given: pixels, parameters of both cameras, and weights if there are any."""
    pixels_1, pixels_2, params_1, params_2, *weights = inputs
    model_1, (width_1, height_1), model_2, (width_2, height_2) = cameras
    camera_1 = Camera(model_1, params_1, (width_1, height_1))
    camera_2 = Camera(model_2, params_2, (width_2, height_2))
    weight = weights[0] if weights else None
    return TwoViews.of(pixels_1, pixels_2, camera_1, camera_2, threshold, mask, weight)


def find_relative_pose(
    inputs: Sequence[Tensor],
    mask: Tensor,
    model_1: str,
    size_1: Sequence[int],
    model_2: str,
    size_2: Sequence[int],
    threshold: float,
    kernel: Kernel,
    wanted: Model,
    *effort: Any,
) -> FoundPose:
    """What `estimate_relative_pose` finds, without gradient; inputs as of `_views`, the rest as its arguments."""
    with torch.no_grad():
        views = _views(inputs, mask, (model_1, size_1, model_2, size_2), threshold)
        # The probability that a wrong match is within the threshold of an epipolar line.
        chance = 2 * threshold * math.hypot(*size_2) / (size_2[0] * size_2[1])
        weights = inputs[4] if len(inputs) > 4 else None
        chances = chance * _mean_width(mask, weights, views.x_1.dtype)
        return _search(views, chances, wanted, kernel, _Effort(*effort))


def _search(views: TwoViews, chance: Tensor, wanted: Model, kernel: Kernel, effort: _Effort) -> FoundPose:
    """Fit all models, choose one per pair, and take the pose from it."""
    mask, B = views.mask, len(views.mask)
    generator = torch.Generator().manual_seed(effort.seed)
    R, t, noise, near = _fit_motion(views, kernel, effort, generator)
    views = views.in_units(noise[:, None])
    by_noise = kernel != "truncated"
    width = NOISE_WIDTH if by_noise else FINAL_WIDTH
    if wanted == "essential":
        squared = sampson_squared(views, R[:, None], t[:, None]).transpose(0, 1)
        model, ambiguous = torch.zeros_like(mask[:, 0], dtype=torch.int64), torch.zeros_like(mask[:, 0])
        R, t = R_E, t_E = in_front(views, R, t, mask & (squared[ESSENTIAL] < FINAL_WIDTH**2))
        normal = torch.zeros_like(t)
    else:
        fits = fit_models(views, R, t, generator, by_noise)
        model = choose(fits, mask, chance * noise, by_noise)
        if bool((model != ESSENTIAL).any()):
            rough, fits = fits.squared, fits.finished(views, width)
            if by_noise:
                # As alone, whoever else is in the batch.
                simple = (model != ESSENTIAL)[:, None]
                fits = replace(fits, squared=torch.where(simple, fits.squared, rough))
                # One that explains no more than accident does is the simplest of all, and hides what can be used.
                of_model = fits.squared[model, torch.arange(B, device=mask.device)]
                certain = is_no_accident(views, of_model, noise, chance, by_noise)
                model = torch.where(certain, model, ESSENTIAL)
        squared = fits.squared
        R_E, t_E = in_front(views, R, t, mask & (squared[ESSENTIAL] < FINAL_WIDTH**2))
        if by_noise and not bool((model != ESSENTIAL).any()):
            R, t, normal, ambiguous = R_E, t_E, torch.zeros_like(t), torch.zeros_like(mask[:, 0])
        else:
            R, t, normal, ambiguous = pose_of(views, fits, model)
            if by_noise:  # as alone, whoever else is in the batch
                is_essential = (model == ESSENTIAL)[:, None]
                R, t = torch.where(is_essential[..., None], R_E, R), torch.where(is_essential, t_E, t)
    chosen = squared[model, torch.arange(B, device=mask.device)]
    in_thresholds = squared * noise[:, None].square()
    inliers = (chosen * noise[:, None].square() < 1) & mask
    significant = is_no_accident(views, chosen, noise, chance, by_noise)
    used = torch.where((model == ESSENTIAL)[:, None], near, (chosen < width**2) & mask)
    scores = torch.where(mask, (1 - in_thresholds).clamp_min(0.0), 0.0).sum(-1)
    found, eye = (mask.sum(-1) > 5)[:, None, None], torch.eye(4, dtype=R.dtype, device=R.device)
    return FoundPose(
        torch.where(found, rigid(R, t), eye),
        normal,
        model,
        noise,
        significant,
        ambiguous,
        inliers & significant[:, None],
        used & significant[:, None],
        torch.nn.functional.pad(scores, (0, 0, 0, len(MODELS) - len(scores))),
        torch.where(found, rigid(R_E, t_E), eye),
    )


def _fit_motion(
    views: TwoViews, kernel: Kernel, effort: _Effort, generator: torch.Generator
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """R (B, 3, 3) and t (B, 3) of essential matrices, their unit (B,), thresholds, and the matches (B, N) fitted."""
    R, t = search(
        lambda rows, count: propose_essential(views.select(rows), count, generator, kernel != "truncated"),
        views.mask.sum(-1),
        5,
        effort.confidence,
        effort.min_samples,
        effort.max_samples,
    )
    R, t, one = R[:, None], t[:, None], R.new_ones(len(R))
    if kernel == "truncated":
        R, t, _ = fit_essential(views, R, t, FINAL_ITERATIONS, FINAL_WIDTH * one)
        return R[:, 0], t[:, 0], one, views.mask & (sampson_squared(views, R, t)[:, 0] < FINAL_WIDTH**2)
    squared = sampson_squared(views, R, t)[:, 0]
    # A power of two: the level does not change with the matches, and has no gradient, but where it jumps.
    noise = torch.exp2((0.5 * noise_variance(squared, views.mask).log2()).ceil()).clamp_min(_LEAST_NOISE)
    views = views.in_units(noise[:, None])
    # Of many wrong matches, even a kernel leaves the sum of their pulls.
    near = views.mask & (squared < (NOISE_WIDTH * noise[:, None]) ** 2)
    R, t, _ = fit_essential(replace(views, mask=near), R, t, _KERNEL_ITERATIONS, _KERNEL_WIDTH * one, kernel)
    return R[:, 0], t[:, 0], noise, near


def _mean_width(mask: Tensor, weights: Tensor | None, dtype: torch.dtype) -> Tensor:
    """(B,) the mean of the matches' thresholds, in units of that of weight one."""
    if weights is None:
        return torch.ones_like(mask[:, 0], dtype=dtype)
    widths = torch.where(mask, torch.where(mask, weights, 1.0).rsqrt(), 0.0)
    return widths.sum(-1) / mask.sum(-1).clamp_min(1)


def _nothing(pixels: Tensor) -> RelativePose:
    """The answer where there is nothing to sample from."""
    B, N = pixels.shape[:2]
    T_21 = torch.eye(4, dtype=pixels.dtype, device=pixels.device).expand(B, 4, 4)
    score = torch.zeros(B, dtype=pixels.dtype, device=pixels.device)
    model = torch.full((B,), ROTATION, device=pixels.device)
    no = torch.zeros(B, N + 1, dtype=torch.bool, device=pixels.device)
    return RelativePose(T_21, no[:, :N], no[:, N], model, no[:, N], score, score, score, T_21)


def attach_relative_pose(
    T_21: Tensor,
    inputs: Sequence[Tensor],
    others: Sequence[Tensor],
    model_1: str,
    size_1: Sequence[int],
    model_2: str,
    size_2: Sequence[int],
    threshold: float,
    kernel: Kernel,
) -> Tensor:
    """The same poses, with the gradient of the minimiser of the chosen model's errors over the rows in use.

    inputs: as of `_views`; others: its mask, and normal, model, noise and used of what was found
    """
    mask, normal, model, noise, used = others
    views = _views(inputs, mask, (model_1, size_1, model_2, size_2), threshold).in_units(noise[:, None])
    R, t = T_21[:, :3, :3], T_21[:, :3, 3]
    # Parameters that the chosen model does not have must not bring NaN.
    forward = t.new_tensor((0.0, 0.0, 1.0))
    t = torch.where((model == ROTATION)[:, None] | (t == 0).all(-1, keepdim=True), forward, t)
    normal = torch.where((model == HOMOGRAPHY)[:, None], normal, forward)
    basis_t, basis_n = tangent_basis(t), tangent_basis(normal)
    variance_1, variance_2 = views.scale_1.square().reciprocal(), views.scale_2.square().reciprocal()
    weight = (variance_1 + variance_2).rsqrt()

    def direction(step: Tensor) -> Tensor:
        moved = t + (step[:, None] @ basis_t).squeeze(1)
        return moved / moved.norm(dim=-1, keepdim=True)

    def essential(step: Tensor) -> Tensor:
        E = essential_from_pose(so3_exp(step[:, :3]) @ R, direction(step[:, 3:]))
        squared = sampson_errors(E, views.x_1, views.x_2, variance_1, variance_2).square()
        if kernel != "truncated":
            squared = robustify(squared, kernel, squared.new_tensor(_KERNEL_WIDTH)).rho
        return torch.where(used & (model == ESSENTIAL)[:, None], squared, 0.0).sum(-1)

    def mapping(H: Tensor, rows: Tensor) -> Tensor:
        error = transfer_errors(H, views.x_1, views.x_2).square().sum(-1) * weight.square()
        return torch.where(used & rows[:, None], error, 0.0).sum(-1)

    def homography(step: Tensor) -> Tensor:
        plane = normal * (1 + step[:, 5:6]) + (step[:, None, 6:] @ basis_n).squeeze(1)
        H = so3_exp(step[:, :3]) @ R + direction(step[:, 3:5])[:, :, None] * plane[:, None]
        return mapping(H, model == HOMOGRAPHY)

    def rotation(step: Tensor) -> Tensor:
        return mapping(so3_exp(step) @ R, model == ROTATION)

    steps = (
        implicit_step(essential, R.new_zeros(len(R), 5)),
        implicit_step(homography, R.new_zeros(len(R), 8))[:, :5],
        torch.nn.functional.pad(implicit_step(rotation, R.new_zeros(len(R), 3)), (0, 2)),
    )
    step = steps[0] + steps[1] + steps[2]
    moving = (T_21[:, :3, 3] != 0).any(-1, keepdim=True)
    return rigid(so3_exp(step[:, :3]) @ R, torch.where(moving, direction(step[:, 3:]), 0.0))
