"""The relative pose of two views from their matches, some of them wrong, and the model that explains them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, get_args

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
from torchslam.geometry.lie import matrix_from_quaternion, quaternion_from_matrix, rigid, so3_exp
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
from torchslam.geometry.precision import full_precision
from torchslam.geometry.ransac import CONFIDENCE, check_search, search
from torchslam.geometry.robust import Kernel, robustify
from torchslam.geometry.two_view import (
    NOISE_WIDTH,
    TwoViews,
    fit_essential,
    noise_variance,
    propose_essential,
    sampson_squared,
    tangent_basis,
)
from torchslam.geometry.two_view_matrices import essential_from_pose, sampson_errors, transfer_errors
from torchslam.utils.by_value import ByValue

Model = Literal["auto", "essential"]

# Deviations of the noise, which for keypoints has a long tail, at which the kernel begins; iterations of
# Levenberg-Marquardt with it; and the least noise, thresholds, as of exact matches. Tried at these values only.
_KERNEL_WIDTH, _KERNEL_ITERATIONS, _LEAST_NOISE = 1.5, 20, 1 / 64


@dataclass(frozen=True, eq=False)
class RelativePose(ByValue):
    """Relative poses of B pairs of views.

    Attributes:
        T_21: from camera 1 to camera 2, translation of length one, or zero for "rotation"; the identity, without
            gradient, where the inliers may be an accident. Where it is `ambiguous`, or a "rotation", which does not
            determine the direction, this is the more likely pose or the rotation, with its gradient, though
            `success` is False.
        inliers: matches within the threshold of the chosen model.
        success: whether rotation and direction are determined: the inliers are significant, the motion is no
            pure rotation, and the plane, if any, is not ambiguous.
        model_index: 0 "essential", 1 "homography" (a plane explains the matches), 2 "rotation"; see `model`.
        ambiguous: whether the matches lie on a plane and two motions explain them; T_21 is the more likely one.
        score_essential: sum over the matches of 1 - min((error / threshold)^2, 1); zero if not requested. Those of
            the other models, `score_homography` and `score_rotation`, are alike.
        T_21_essential: the pose of the essential matrix, whatever was chosen, without gradient: a guess
            where there is no `success`.
    """

    T_21: Float[Tensor, "B 4 4"]
    inliers: Bool[Tensor, "B N"]
    success: Bool[Tensor, " B"]
    model_index: Int[Tensor, " B"]
    ambiguous: Bool[Tensor, " B"]
    score_essential: Float[Tensor, " B"]
    score_homography: Float[Tensor, " B"]
    score_rotation: Float[Tensor, " B"]
    T_21_essential: Float[Tensor, "B 4 4"]

    @property
    def model(self) -> tuple[str, ...]:
        """Names of the models, one for each pair."""
        return tuple(MODELS[index] for index in self.model_index.tolist())


@full_precision
def estimate_relative_pose(
    pixels_1: Float[Tensor, "B N 2"],
    pixels_2: Float[Tensor, "B N 2"],
    *,
    camera_1: Camera,
    camera_2: Camera,
    threshold: float = 1.0,
    mask: Bool[Tensor, "B N"] | None = None,
    seed: int = 0,
    confidence: float = CONFIDENCE,
    max_samples: int = 4000,
    model: Model = "auto",
    kernel: Kernel = "cauchy",
    weights: Float[Tensor, "B N"] | None = None,
    min_samples: int = 512,
) -> RelativePose:
    """Estimate relative poses of B pairs of views by RANSAC over five-point essential matrices, with model selection.

    With `model="auto"` a homography and a pure rotation are fitted as well. The richer model is chosen only if
    matches that it explains contradict the simpler one, by one of these criteria (all but the first need another
    kernel than "truncated"):

    1. There are more such matches than chance would bring.
    2. All together lie to one side of the simpler model, along their epipolar lines. Noise of any size has no
       direction; that of edges has one, but goes both ways, so that as many matches end up behind the cameras.
    3. What the simpler model explains is accidental.
    4. No motion in front of the plane explains the matches as well as the essential matrix.

    A pure rotation, or a plane with two valid motions, gives `success` False; so do too few matches and pure noise.
    The same arguments and seed give the same result. Where an input requires a gradient, T_21 carries that of the
    final least squares of the chosen model with respect to pixels, weights and camera parameters, with the matches
    in use and the noise level fixed (implicit function theorem). Sources: Nister, 2004; Chum et al., "Locally
    optimized RANSAC", 2003; Torr, "An assessment of information criteria for motion model selection", 1997.

    Args:
        camera_1: of the first view, one or B; `camera_2`: of the second one.
        threshold: pixels, about the noise of one coordinate or somewhat more, for matches of weight one.
        mask: matches in use; those with NaN are never used.
        confidence: probability that some sample has no outlier.
        max_samples: largest number of samples of five matches.
        model: "auto", or "essential" to skip model selection.
        kernel: of the final refinement of the essential matrix. With all but "truncated", its scale, the model
            selection and the search use the noise level estimated from the matches, the threshold only separates
            wrong matches, and the search counts matches behind a camera as wrong. With "truncated" the threshold
            sets all of that.
        weights: information of the matches; the threshold of a match is `threshold / sqrt(weight)`. A weight
            of zero, infinity or NaN excludes the match.
        min_samples: smallest number of samples of five matches.

    Raises:
        ValueError: A shape or a dtype does not fit, or an unknown model or kernel.
        RuntimeError: It is called within a transform of `torch.func`.
    """
    refuse_transforms("estimate_relative_pose")
    check_search(threshold, confidence, max_samples, min_samples)
    for name, value, known in (("model", model, get_args(Model)), ("kernel", kernel, get_args(Kernel))):
        if value not in known:
            raise ValueError(f"unknown {name} {value!r}; known are {', '.join(known)}")
    inputs = [pixels_1, pixels_2, camera_1.params, camera_2.params, *([] if weights is None else [weights])]
    if 0 in pixels_1.shape or pixels_1.shape[1] < 5:
        return _nothing(pixels_1, inputs)
    finite = torch.isfinite(pixels_1).all(-1) & torch.isfinite(pixels_2).all(-1)
    finite = finite if weights is None else finite & (weights > 0) & torch.isfinite(weights)
    mask = finite if mask is None else mask & finite
    inputs[:2] = (torch.where(mask[..., None], pixels, 0.0) for pixels in (pixels_1, pixels_2))

    def views(
        pixels_1: Tensor, pixels_2: Tensor, params_1: Tensor, params_2: Tensor, weights: Tensor | None = None
    ) -> TwoViews:
        cameras = camera_1.with_params(params_1), camera_2.with_params(params_2)
        return TwoViews.of(pixels_1, pixels_2, *cameras, threshold, mask, weights)

    width, height = camera_2.size
    # The probability that a wrong match is within the threshold of an epipolar line.
    chance = 2 * threshold * math.hypot(width, height) / (width * height)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        if weights is None:
            chances = torch.full_like(pixels_1[:, 0, 0], chance)
        else:  # by the mean of the matches' thresholds, in units of that of weight one
            widths = torch.where(mask, torch.where(mask, weights, 1.0).rsqrt(), 0.0)
            chances = chance * (widths.sum(-1) / mask.sum(-1).clamp_min(1))
        detached = views(*(x.detach() for x in inputs))
        motion = _fit_motion(detached, kernel, (confidence, min_samples, max_samples), generator)
        found, normal, used = _pose(detached, motion, chances, kernel, model, generator)
    if not needs_gradient(*inputs):
        return found
    noise = motion[2]
    T_21 = _attach(found, normal, used, views(*inputs).in_units(noise[:, None]), kernel)
    return replace(found, T_21=T_21)


def _nothing(pixels: Float[Tensor, "B N 2"], given: list[Tensor]) -> RelativePose:
    """The answer where there is nothing to sample from."""
    B, N = pixels.shape[:2]
    T_21 = torch.eye(4, dtype=pixels.dtype, device=pixels.device).repeat(B, 1, 1)
    essential, homography, rotation = torch.zeros(3, B, dtype=T_21.dtype, device=T_21.device)
    model = torch.full((B,), ROTATION, device=pixels.device)
    inliers, success, ambiguous = (pixels.new_zeros(shape, dtype=torch.bool) for shape in ((B, N), B, B))
    T_21, guess = with_zero_gradient(T_21, *given), T_21.clone()
    return RelativePose(T_21, inliers, success, model, ambiguous, essential, homography, rotation, guess)


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
    # Where the root of E was not found exactly, R is a rotation only to 1e-4; the others keep their bits.
    eye, rounding = torch.eye(3, dtype=R.dtype, device=R.device), torch.finfo(R.dtype).eps ** 0.6
    good = ((R.mT @ R - eye).abs() < rounding).all(-1).all(-1)
    if not good.all():
        nearest = matrix_from_quaternion(quaternion_from_matrix(R))
        R = torch.where(good[:, None, None], R, nearest)
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


def _pose(
    views: TwoViews,
    motion: tuple[Tensor, Tensor, Tensor, Tensor],
    chance: Float[Tensor, " B"],
    kernel: Kernel,
    wanted: Model,
    generator: torch.Generator,
) -> tuple[RelativePose, Float[Tensor, "B 3"], Bool[Tensor, "B N"]]:
    """The pose of the model that is chosen, the normal of its plane, and the matches of its final fit.

    motion: as `_fit_motion` returns it; chance: that a wrong match is within the threshold of an epipolar line
    """
    R, t, noise, near = motion
    mask, views, by_noise = views.mask, views.in_units(noise[:, None]), kernel != "truncated"
    width = (
        NOISE_WIDTH if by_noise else FINAL_WIDTH
    )  # thresholds of the final fit of a homography or rotation
    if wanted == "essential":
        squared = sampson_squared(views, R[:, None], t[:, None]).transpose(0, 1)
        R, t = in_front(views, R, t, mask & (squared[ESSENTIAL] < FINAL_WIDTH**2))
        no = torch.zeros_like(mask[:, 0])
        chosen = _Chosen(R, t, torch.zeros_like(t), no.to(torch.int64), no, R, t, squared)
    else:
        fits = fit_models(views, R, t, generator, by_noise)
        chosen = _choose(views, fits, noise, chance, width, by_noise)
    model = chosen.model
    squared = chosen.squared[model, torch.arange(len(mask), device=mask.device)]
    inliers = (squared * noise[:, None].square() < 1) & mask
    significant = is_no_accident(views, squared, model, noise, chance, by_noise)
    used = torch.where((model == ESSENTIAL)[:, None], near, (squared < width**2) & mask)
    in_thresholds = chosen.squared * noise[:, None].square()
    scores = torch.where(mask, (1 - in_thresholds).clamp_min(0.0), 0.0).sum(-1)
    scores = torch.nn.functional.pad(scores, (0, 0, 0, len(MODELS) - len(scores)))
    enough, eye = (mask.sum(-1) > 5)[:, None, None], torch.eye(4, dtype=R.dtype, device=R.device)
    found = RelativePose(
        torch.where(enough & significant[:, None, None], rigid(chosen.R, chosen.t), eye),
        inliers & significant[:, None],
        significant & (model != ROTATION) & ~chosen.ambiguous,
        model,
        chosen.ambiguous & significant,
        scores[0],
        scores[1],
        scores[2],
        torch.where(enough, rigid(chosen.R_E, chosen.t_E), eye),
    )
    return found, chosen.normal, used & significant[:, None]


def _choose(
    views: TwoViews,
    fits: Fits,
    noise: Float[Tensor, " B"],
    chance: Float[Tensor, " B"],
    width: float,
    by_noise: bool,
) -> _Chosen:
    """The model that the matches call for, and its pose. views: in units of the noise, thresholds"""
    mask = views.mask
    R_E, t_E = in_front(views, fits.R, fits.t, mask & (fits.squared[ESSENTIAL] < FINAL_WIDTH**2))
    model, flat = choose(views, replace(fits, R=R_E, t=t_E) if by_noise else fits, chance * noise, by_noise)
    simple, plane = model != ESSENTIAL, None
    if bool(simple.any()):
        rough, fits = fits.squared, fits.finished(views, width)
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
        no = torch.zeros_like(mask[:, 0])
        return _Chosen(R_E, t_E, torch.zeros_like(t_E), model, no, R_E, t_E, fits.squared)
    plane = PlaneMotions.of(views, fits) if plane is None else plane
    front = R_E, t_E
    if not by_noise:
        front = in_front(views, fits.R, fits.t, mask & (fits.squared[ESSENTIAL] < 1))
    R, t, normal, ambiguous = pose_of(views, fits, front, model, plane, by_noise)
    return _Chosen(R, t, normal, model, ambiguous, R_E, t_E, fits.squared)


def _attach(
    found: RelativePose,
    normal: Float[Tensor, "B 3"],
    used: Bool[Tensor, "B N"],
    views: TwoViews,
    kernel: Kernel,
) -> Float[Tensor, "B 4 4"]:
    """The poses found, with the gradient of the minimizer of the chosen model's errors over the rows in use.

    normal: of the plane of a homography; views: in units of the noise
    """
    T_21, model = found.T_21, found.model_index
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
