"""The search behind `estimate_relative_pose`: an essential matrix, the choice of a model, and the pose it gives."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchslam.geometry.camera import Camera
from torchslam.geometry.lie import matrix_from_quaternion, quaternion_from_matrix, rigid
from torchslam.geometry.motion_models import (
    ESSENTIAL,
    FINAL_ITERATIONS,
    FINAL_WIDTH,
    HOMOGRAPHY,
    MODELS,
    ROTATION,
    Fits,
    PlaneMotions,
    choose,
    fit_models,
    in_front,
    is_no_accident,
    plane_holds,
    pose_of,
)
from torchslam.geometry.ransac import search
from torchslam.geometry.robust import Kernel
from torchslam.geometry.two_view import (
    NOISE_WIDTH,
    TwoViews,
    fit_essential,
    noise_variance,
    propose_essential,
    sampson_squared,
)

Model = Literal["auto", "essential"]

KERNEL_WIDTH = 1.5  # deviations of the noise, which for keypoints has a long tail, at which the kernel begins
_KERNEL_ITERATIONS = 20
"""Of Levenberg-Marquardt with the robust kernel. Tried at this value only."""
_LEAST_NOISE = 1 / 64  # thresholds; of exact matches


class FoundPose(NamedTuple):
    """The pose of the chosen model, and what it is based on.

    Attributes:
        T_21: from camera 1 to camera 2.
        normal: of the plane of a homography.
        model: index of the chosen model.
        noise: thresholds, the unit of the fits.
        significant: whether the inliers are no accident.
        ambiguous: whether a plane leaves two motions.
        inliers: matches within the threshold.
        used: matches of the final fit.
        scores: of the three models.
        T_essential: the pose of the essential matrix.
    """

    T_21: Float[Tensor, "B 4 4"]
    normal: Float[Tensor, "B 3"]
    model: Int[Tensor, " B"]
    noise: Float[Tensor, " B"]
    significant: Bool[Tensor, " B"]
    ambiguous: Bool[Tensor, " B"]
    inliers: Bool[Tensor, "B N"]
    used: Bool[Tensor, "B N"]
    scores: Float[Tensor, "3 B"]
    T_essential: Float[Tensor, "B 4 4"]


def find_relative_pose(
    views: TwoViews,
    weights: Float[Tensor, "B N"] | None,
    camera_2: Camera,
    threshold: float,
    kernel: Kernel,
    wanted: Model,
    seed: int,
    effort: tuple[float, int, int],
) -> FoundPose:
    """Fit all models, choose one per pair, and take the pose from it.

    weights, kernel, wanted model and seed are as of `estimate_relative_pose`; effort: its confidence, min_samples and
    max_samples.
    """
    width, height = camera_2.size
    mask = views.mask
    # The probability that a wrong match is within the threshold of an epipolar line.
    by_area = 2 * threshold * math.hypot(width, height) / (width * height)
    chance = by_area * _mean_width(mask, None if weights is None else weights.detach(), views.x_1.dtype)
    generator = torch.Generator().manual_seed(seed)
    R, t, noise, near = _fit_motion(views, kernel, effort, generator)
    views, by_noise = views.in_units(noise[:, None]), kernel != "truncated"
    if wanted == "essential":
        chosen = _essential(views, R, t)
    else:
        chosen = _choose(views, fit_models(views, R, t, generator, by_noise), noise, chance, by_noise)
    model = chosen.model
    squared = chosen.squared[model, torch.arange(len(mask), device=mask.device)]
    in_thresholds = chosen.squared * noise[:, None].square()
    inliers = (squared * noise[:, None].square() < 1) & mask
    significant = is_no_accident(views, squared, model, noise, chance, by_noise)
    used = torch.where((model == ESSENTIAL)[:, None], near, (squared < _width(by_noise) ** 2) & mask)
    scores = torch.where(mask, (1 - in_thresholds).clamp_min(0.0), 0.0).sum(-1)
    found, eye = (mask.sum(-1) > 5)[:, None, None], torch.eye(4, dtype=R.dtype, device=R.device)
    return FoundPose(
        torch.where(found, rigid(chosen.R, chosen.t), eye),
        chosen.normal,
        model,
        noise,
        significant,
        chosen.ambiguous,
        inliers & significant[:, None],
        used & significant[:, None],
        torch.nn.functional.pad(scores, (0, 0, 0, len(MODELS) - len(scores))),
        torch.where(found, rigid(chosen.R_E, chosen.t_E), eye),
    )


class _Chosen(NamedTuple):
    """R, t of the chosen model, and `normal` of its plane, which leaves two motions where it is `ambiguous`.

    R_E, t_E: of the essential matrix; squared: errors of the three models, or of the first, in units of the noise
    """

    R: Float[Tensor, "B 3 3"]
    t: Float[Tensor, "B 3"]
    normal: Float[Tensor, "B 3"]
    model: Int[Tensor, " B"]
    ambiguous: Bool[Tensor, " B"]
    R_E: Float[Tensor, "B 3 3"]
    t_E: Float[Tensor, "B 3"]
    squared: Float[Tensor, "_ B N"]


def _width(by_noise: bool) -> float:
    """Thresholds within which matches count in the final fit of a homography or a rotation."""
    return NOISE_WIDTH if by_noise else FINAL_WIDTH


def _essential(views: TwoViews, R: Float[Tensor, "B 3 3"], t: Float[Tensor, "B 3"]) -> _Chosen:
    """Nothing but the essential matrix."""
    squared = sampson_squared(views, R[:, None], t[:, None]).transpose(0, 1)
    R, t = in_front(views, R, t, views.mask & (squared[ESSENTIAL] < FINAL_WIDTH**2))
    no = torch.zeros_like(views.mask[:, 0])
    return _Chosen(R, t, torch.zeros_like(t), no.to(torch.int64), no, R, t, squared)


def _choose(
    views: TwoViews, fits: Fits, noise: Float[Tensor, " B"], chance: Float[Tensor, " B"], by_noise: bool
) -> _Chosen:
    """The model that the matches call for, and its pose. views: in units of the noise, thresholds"""
    mask = views.mask
    R_E, t_E = in_front(views, fits.R, fits.t, mask & (fits.squared[ESSENTIAL] < FINAL_WIDTH**2))
    facing = replace(fits, R=R_E, t=t_E) if by_noise else fits
    model, flat = choose(views, facing, chance * noise, by_noise)
    simple, plane = model != ESSENTIAL, None
    if bool(simple.any()):
        rough, fits = fits.squared, fits.finished(views, _width(by_noise))
        plane = PlaneMotions.of(views, fits)
        if by_noise:
            # Independent of the other elements of the batch.
            fits = replace(fits, squared=torch.where(simple[:, None], fits.squared, rough))

            def is_certain(model: Int[Tensor, " B"]) -> Bool[Tensor, " B"]:
                of_model = fits.squared[model, torch.arange(len(mask), device=mask.device)]
                return is_no_accident(views, of_model, model, noise, chance, by_noise)

            # One that explains no more than accident does is the simplest of all, and hides what can be used.
            certain = is_certain(model)
            richer = ~certain & (model == ROTATION) & flat
            if bool(richer.any()):
                model = torch.where(richer, HOMOGRAPHY, model)
                certain = is_certain(model)
            certain &= (model != HOMOGRAPHY) | plane_holds(views, fits, plane)
            model = torch.where(certain, model, ESSENTIAL)
    if by_noise and not bool((model != ESSENTIAL).any()):
        zero = torch.zeros_like(t_E)
        return _Chosen(R_E, t_E, zero, model, torch.zeros_like(mask[:, 0]), R_E, t_E, fits.squared)
    plane = PlaneMotions.of(views, fits) if plane is None else plane
    R, t, normal, ambiguous = pose_of(views, fits, model, plane, by_noise)
    if by_noise:  # independent of the other elements of the batch
        is_essential = (model == ESSENTIAL)[:, None]
        R, t = torch.where(is_essential[..., None], R_E, R), torch.where(is_essential, t_E, t)
    return _Chosen(R, t, normal, model, ambiguous, R_E, t_E, fits.squared)


def _fit_motion(
    views: TwoViews, kernel: Kernel, effort: tuple[float, int, int], generator: torch.Generator
) -> tuple[Float[Tensor, "B 3 3"], Float[Tensor, "B 3"], Float[Tensor, " B"], Bool[Tensor, "B N"]]:
    """R and t of essential matrices, their unit in thresholds, and the matches of the fit."""
    R, t = search(
        lambda rows, count: propose_essential(views.select(rows), count, generator, kernel != "truncated"),
        views.mask.sum(-1),
        5,
        *effort,
        as_needed=kernel != "truncated",
    )
    R, t, one = _rotations(R)[:, None], t[:, None], R.new_ones(len(R))
    if kernel == "truncated":
        R, t, _ = fit_essential(views, R, t, FINAL_ITERATIONS, FINAL_WIDTH * one)
        return R[:, 0], t[:, 0], one, views.mask & (sampson_squared(views, R, t)[:, 0] < FINAL_WIDTH**2)
    squared = sampson_squared(views, R, t)[:, 0]
    # A power of two: the level does not change with the matches, and has no gradient, but where it jumps.
    noise = torch.exp2((0.5 * noise_variance(squared, views.mask).log2()).ceil()).clamp_min(_LEAST_NOISE)
    views = views.in_units(noise[:, None])
    # Of many wrong matches, even a kernel leaves the sum of their pulls.
    near = views.mask & (squared < (NOISE_WIDTH * noise[:, None]) ** 2)
    R, t, _ = fit_essential(replace(views, mask=near), R, t, _KERNEL_ITERATIONS, KERNEL_WIDTH * one, kernel)
    return R[:, 0], t[:, 0], noise, near


def _rotations(R: Float[Tensor, "B 3 3"]) -> Float[Tensor, "B 3 3"]:
    """The rotations closest to matrices.

    Where the root of E was not found exactly, R is a rotation only to 1e-4; the others keep their bits.
    """
    eye, rounding = torch.eye(3, dtype=R.dtype, device=R.device), torch.finfo(R.dtype).eps ** 0.6
    good = ((R.mT @ R - eye).abs() < rounding).all(-1).all(-1)
    if good.all():
        return R
    return torch.where(good[:, None, None], R, matrix_from_quaternion(quaternion_from_matrix(R)))


def _mean_width(
    mask: Bool[Tensor, "B N"], weights: Float[Tensor, "B N"] | None, dtype: torch.dtype
) -> Float[Tensor, " B"]:
    """The mean of the matches' thresholds, in units of that of weight one."""
    if weights is None:
        return torch.ones_like(mask[:, 0], dtype=dtype)
    widths = torch.where(mask, torch.where(mask, weights, 1.0).rsqrt(), 0.0)
    return widths.sum(-1) / mask.sum(-1).clamp_min(1)
